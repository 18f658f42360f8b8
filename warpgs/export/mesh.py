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
from warpgs.errors import counted
from warpgs.files import remove_numbered
from warpgs.formats.mesh import Mesh, write_mesh_ply
from warpgs.formats.mesh_gltf import write_mesh_glb
from warpgs.meshing.depth_views import DepthView, depth_view
from warpgs.meshing.surface import mesh_of
from warpgs.meshing.tsdf import coarsened_blocks, finest, fitting_blocks, fuse
from warpgs.model.splats import Splats
from warpgs.video.camera_paths import evenly_spaced as evenly_spaced_times

from .job import Job, Writer
from .moving import KEYS, SECONDS
from .options import Export

NAME, STATIC = "mesh.glb", "static_mesh.ply"
"""Files: of all, and with ``--frames`` of what is static."""

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
            + ": use --format ply or glb, which hold the Gaussians themselves"
        )
    if times and not count and options.voxel:
        raise ValueError(
            f"--voxel {options.voxel:g} is too large for what moves, whose voxels have {maker.usual(times):.2g} scene "
            "units by default: use a smaller one, or --layers static"
        )
    summary = counted(0 if static is None else len(static.faces), "static triangle")
    if times:
        summary += f" and {count:,} dynamic ones at {counted(len(times), 'time')}"
    former = _remove_former(job)
    if options.frames is None:
        path = str(job.file(NAME))
        size = write_mesh_glb(job.file(NAME), static, frames, options.seconds or SECONDS)
    else:
        path, size = _write_sequence(job.folder, static, frames)
    gone = [path.name for path in former if not path.exists()]
    told = f"\nremoved, as of an earlier export: {_listed(gone)}" if gone else ""
    return f"{path}: {summary}, {size / 1e6:.1f} MB\n{maker.note}\n{job.up_note}{told}"


def _check(options: Export) -> None:
    """Refuses options that contradict each other."""
    if options.layers == "apart":
        raise ValueError("--layers apart: the parts of a mesh are separate in any case, omit it")
    single = "--time" if options.time is not None else "--frames" if options.frames is not None else None
    for name in ("keys", "seconds"):
        if single and getattr(options, name) is not None and (name, options.cameras) != ("seconds", "usd"):
            raise ValueError(f"--{name} is for a mesh that moves in one file: omit it, or {single}")


def _remove_former(job: Job) -> list[Path]:
    """Removes the meshes of an earlier export to the folder: they are of another scene, or its sequence was longer."""
    if job.file(NAME) == job.folder:
        return []
    others = [path for path in (job.folder / NAME, job.folder / STATIC) if path.is_file()]
    for path in others:
        path.unlink()
    return [*others, *remove_numbered(job.folder, _numbered)]


def _listed(names: Sequence[str]) -> str:
    """Names of files, of a sequence the first and the last."""
    single = [name for name in names if name in (NAME, STATIC)]
    numbered = names[len(single) :]
    return ", ".join([*single, *([f"{numbered[0]} to {numbered[-1]}"] if len(numbered) > 1 else numbered)])


def _write_sequence(folder: Path, static: Mesh | None, frames: Sequence[Mesh]) -> tuple[str, int]:
    """Writes a PLY file of what is static and one of each frame; returns their names and their size [bytes]."""
    names, size = [] if static is None else [STATIC], 0
    if static is not None:
        size += write_mesh_ply(folder / STATIC, static)
    size += sum(write_mesh_ply(folder / _numbered(k), mesh) for k, mesh in enumerate(frames))
    if frames:
        names.append(_numbered(0) + (f" to {_numbered(len(frames) - 1)}" if len(frames) > 1 else ""))
    return f"{' and '.join(names)} in {folder}", size


def _numbered(number: int) -> str:
    return f"dynamic_mesh_{number:05d}.ply"


class _Maker:
    """Makes the meshes of a job, in the coordinates of its files.

    Attributes:
        moves: Whether there are dynamic Gaussians.
    """

    def __init__(self, job: Job) -> None:
        self._capture_note = job.capture_note
        self._scene, self._voxel, self._quiet = job.clouds.scene, job.options.voxel, job.options.quiet
        self._rotation, self._settings = job.rotation(y_up=True), self._scene.config.render_settings
        capture = job.capture
        if capture is None:
            self._cameras = sample_cameras(self._scene, None)
        else:
            self._cameras = [capture.cameras[name] for name in capture.in_time(capture.train)]
        self.moves = len(self._scene.scene.dynamic) > 0
        self._voxels: list[str] = []

    @property
    def note(self) -> str:
        """A line about the cameras and the voxels."""
        return f"by {self._capture_note}; voxels have {' and '.join(self._voxels)}"

    def static(self) -> Mesh | None:
        """The mesh of the static Gaussians; None without any."""
        if not len(self._scene.scene.static):
            return None
        cameras = evenly_spaced(self._cameras, NUM_STATIC)
        views = [
            self._view(self._scene.splats(camera.time), False, camera)
            for camera in progress(cameras, "static mesh", self._quiet)
        ]
        voxel = self._fitting([views], MAX_DEFAULT, self._voxel)
        self._voxels.append(f"{voxel:.2g} scene units (static)")
        return self._mesh(views, voxel)

    def dynamic(self, times: Sequence[float]) -> list[Mesh]:
        """The meshes of the dynamic Gaussians at times."""
        voxel = self._dynamic_voxel(times, self._voxel)
        self._voxels.append(f"{voxel:.2g} scene units (dynamic)")
        return [self._mesh(self._views_at(time), voxel) for time in progress(times, "dynamic meshes", self._quiet)]

    def usual(self, times: Sequence[float]) -> float:
        """The size of the voxels of dynamic Gaussians at times, unless another one is asked for [scene units]."""
        return self._dynamic_voxel(times, None)

    def _dynamic_voxel(self, times: Sequence[float], voxel: float | None) -> float:
        samples = [self._views_at(time) for time in evenly_spaced(times, 3)]
        return self._fitting(samples, max(MIN_DEFAULT, MAX_DEFAULT // len(times)), voxel)

    def _views_at(self, time: float) -> list[DepthView]:
        """What cameras near in time, and some of all times, see of the dynamic Gaussians at a time."""
        by_distance = sorted(self._cameras, key=lambda camera: abs(camera.time - time))
        others = sorted(by_distance[NUM_NEAR:], key=lambda camera: camera.time)
        chosen, splats = (*by_distance[:NUM_NEAR], *evenly_spaced(others, NUM_OTHER)), self._scene.splats(time)
        return [self._view(splats, True, camera) for camera in chosen]

    def _view(self, splats: Splats, is_dynamic: bool, camera: Camera) -> DepthView:
        return depth_view(splats, is_dynamic, camera, self._settings)

    def _fitting(self, samples: Sequence[Sequence[DepthView]], max_default: int, voxel: float | None) -> float:
        """The size of voxels that is asked for, or at which all samples have few voxels [scene units].

        Samples in which nothing is seen say nothing about it, unless all are so.
        """
        limit = max_default if voxel is None else MAX_VOXELS
        seen = [views for views in samples if finest(views) is not None]
        return max(fitting_blocks(views, limit, voxel)[0] for views in seen or samples)

    def _mesh(self, views: Sequence[DepthView], voxel: float) -> Mesh:
        # Only a size that the user chose is refused, also at times between the samples.
        fitting = coarsened_blocks if self._voxel is None else fitting_blocks
        voxel, blocks = fitting(views, MAX_VOXELS, voxel)
        return mesh_of(fuse(views, voxel, blocks), views).rotated(self._rotation)


OPTIONS = ("time", "frames", "layers", "up", "keys", "seconds", "voxel")

MESH = Writer(write_mesh, OPTIONS, ".glb", has_background=True, y_up=True)  # nothing shines through triangles
