"""Meshes: the surface of what is static, and one of what moves for each time.

Depth as training cameras see it is fused (``warpgs.meshing``). What moves is seen at each time by the cameras of other
times, too, as they show its other sides. One binary glTF holds all of them as an animation, or each has a PLY file of
its own. Axes are x right, y up, z towards the viewer.
"""

from collections.abc import Sequence
from pathlib import Path

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.data.sampling import evenly_spaced
from warpgs.editing.contribution import sample_cameras
from warpgs.files import remove_numbered
from warpgs.formats.mesh import Mesh, write_mesh_ply
from warpgs.formats.mesh_gltf import write_mesh_glb
from warpgs.meshing.depth_views import DepthView, depth_view
from warpgs.meshing.surface import mesh_of
from warpgs.meshing.tsdf import fitting_blocks, fuse
from warpgs.video.camera_paths import evenly_spaced as evenly_spaced_times

from .job import Job, Writer
from .moving import KEYS, SECONDS
from .options import Export

NUM_STATIC, NUM_NEAR, NUM_OTHER = 48, 4, 8
"""Numbers of training cameras: that see what is static, and, of each time, nearest in time and of all times.

On builtin:studio (quick) the nearest 8 alone leave what moves 15 to 30 % farther from the true surface at most times;
twice as many of both gain 1 %.
"""

MAX_DEFAULT, MIN_DEFAULT = 4_000_000, 100_000
"""Voxels of all times together, if ``--voxel`` is not given, and the least that each time has."""

MAX_VOXELS = 64_000_000
"""Maximum number of voxels of one time, which take 0.5 GB."""


def write_mesh(job: Job) -> str:
    """Writes a binary glTF, or PLY files with ``--frames``; returns a summary.

    Raises:
        ValueError: If options contradict each other, ``--voxel`` is too small, or there is no surface.
        OSError: If a file cannot be written; the message names it.
    """
    options = job.options
    _check(options)
    maker = _Maker(job)
    static = maker.static() if options.layers != "dynamic" else None
    times = evenly_spaced_times(options.frames or options.keys or KEYS) if options.time is None else [options.time]
    if options.layers == "static" or not maker.moves:
        times = []
    frames = maker.dynamic(times) if times else []
    count = sum(len(mesh.faces) for mesh in frames)
    if not count and (static is None or not len(static.faces)):
        raise ValueError(
            f"{options.run_folder}: no surface is opaque enough for a mesh in the training cameras"
            + (f", or none is as large as the voxels of --voxel {options.voxel:g}" if options.voxel else "")
        )
    if times and not count and options.voxel:
        raise ValueError(f"--voxel {options.voxel:g} is larger than what moves: use a smaller one, or --layers static")
    summary = f"{0 if static is None else len(static.faces):,} static triangles"
    if times:
        summary += f" and {count:,} dynamic ones at {len(times)} {'time' if len(times) == 1 else 'times'}"
    if options.frames is None:
        path = job.file("mesh.glb")
        size = write_mesh_glb(path, static, frames, options.seconds or SECONDS)
        return f"{path}: {summary}, {size / 1e6:.1f} MB\n{maker.note}\n{job.up_note}"
    size = _write_sequence(job.folder, static, frames)
    return f"{job.folder}: {summary}, {size / 1e6:.1f} MB\n{maker.note}\n{job.up_note}"


def _check(options: Export) -> None:
    """Refuses options that contradict each other."""
    if options.layers == "apart":
        raise ValueError("--layers apart: the parts of a mesh are separate in any case, omit it")
    single = "--time" if options.time is not None else "--frames" if options.frames is not None else None
    for name in ("keys", "seconds"):
        if single and getattr(options, name) is not None and (name, options.cameras) != ("seconds", "usd"):
            raise ValueError(f"--{name} is for a mesh that moves in one file: omit it, or {single}")


def _write_sequence(folder: Path, static: Mesh | None, frames: Sequence[Mesh]) -> int:
    """Writes a PLY file of what is static and one of each frame; returns their size [bytes]."""
    remove_numbered(folder, _numbered)  # an earlier sequence may have been longer
    size = write_mesh_ply(folder / "static_mesh.ply", static) if static is not None else 0
    return size + sum(write_mesh_ply(folder / _numbered(k), mesh) for k, mesh in enumerate(frames))


def _numbered(number: int) -> str:
    return f"dynamic_mesh_{number:05d}.ply"


class _Maker:
    """Makes the meshes of a job, in the coordinates of its files.

    Attributes:
        moves: Whether there are dynamic Gaussians.
        note: A line about the voxels and the cameras.
    """

    def __init__(self, job: Job) -> None:
        self._scene, self._voxel, self._quiet = job.clouds.scene, job.options.voxel, job.options.quiet
        self._rotation, self._settings = job.rotation(y_up=True), self._scene.config.render_settings
        capture = job.capture
        self._cameras = sample_cameras(self._scene, None)
        if capture is not None:
            self._cameras = [capture.cameras[name] for name in capture.in_time(capture.train)]
        self.moves = len(self._scene.scene.dynamic) > 0
        self.note = f"by {job.capture_note}; voxels have"

    def static(self) -> Mesh | None:
        """The mesh of the static Gaussians; None without any."""
        if not len(self._scene.scene.static):
            return None
        cameras = evenly_spaced(self._cameras, NUM_STATIC)
        views = [self._view(False, camera, camera.time) for camera in progress(cameras, "static mesh", self._quiet)]
        voxel = self._fitting([views], MAX_DEFAULT)
        self.note += f" {voxel:.2g} scene units (static)"
        return self._mesh(views, voxel)

    def dynamic(self, times: Sequence[float]) -> list[Mesh]:
        """The meshes of the dynamic Gaussians at times."""
        samples = [self._views_at(time) for time in evenly_spaced(times, 3)]
        voxel = self._fitting(samples, max(MIN_DEFAULT, MAX_DEFAULT // len(times)))
        self.note += f" {voxel:.2g} scene units (dynamic)"
        return [self._mesh(self._views_at(time), voxel) for time in progress(times, "dynamic meshes", self._quiet)]

    def _views_at(self, time: float) -> list[DepthView]:
        """What cameras near in time, and some of all times, see of the dynamic Gaussians at a time."""
        by_distance = sorted(self._cameras, key=lambda camera: abs(camera.time - time))
        others = sorted(by_distance[NUM_NEAR:], key=lambda camera: camera.time)
        chosen = (*by_distance[:NUM_NEAR], *evenly_spaced(others, NUM_OTHER))
        return [self._view(True, camera, time) for camera in chosen]

    def _view(self, is_dynamic: bool, camera: Camera, time: float) -> DepthView:
        return depth_view(self._scene.splats(time), is_dynamic, camera, self._settings)

    def _fitting(self, samples: Sequence[Sequence[DepthView]], max_default: int) -> float:
        """The size of voxels that is asked for, or at which all samples have few voxels [scene units]."""
        limit = max_default if self._voxel is None else MAX_VOXELS
        return max(fitting_blocks(views, limit, self._voxel)[0] for views in samples)

    def _mesh(self, views: Sequence[DepthView], voxel: float) -> Mesh:
        voxel, blocks = fitting_blocks(views, MAX_VOXELS, voxel)
        return mesh_of(fuse(views, voxel, blocks), views).rotated(self._rotation)


OPTIONS = ("time", "frames", "layers", "up", "keys", "seconds", "voxel")

MESH = Writer(write_mesh, OPTIONS, ".glb", has_background=True, y_up=True)  # nothing shines through triangles
