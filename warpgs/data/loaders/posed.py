"""What loaders of other programs' layouts share: frames that come with cameras, from any world to scene units.

A loader makes a ``PosedFrame`` of every image, with functions that read its parts in any size, and a ``World``;
``posed_capture`` makes the ``Capture``.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from warpgs.cameras import Camera
from warpgs.config import Background, MaskPerturbation
from warpgs.data.camera_files import MAX_ROTATION_ERROR, is_rotation
from warpgs.data.capture import Assumption, Capture, Conventions, Frame
from warpgs.data.depth_points import DepthView, points_of_views
from warpgs.data.lens import Lens
from warpgs.data.masks import perturb
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.data.time_source import TimeSource
from warpgs.data.units import SceneUnits, scene_units, units_around
from warpgs.files import MAX_NUMBER

from .listed import without_image_suffix
from .matrices import scale_note, scale_of_rotations, without_scale
from .options import LoadOptions

HOLDOUT = 8
"""Every eighth frame is for evaluation where the files do not say which ones are."""

MAX_DEPTH_FRAMES, DEPTH_SIDE = 24, 320
"""Number of frames that points are taken from where there are none, and longest side of their images [px]."""

IN_ORDER = TimeSource("times from the order of the frames")
"""Times of layouts whose frames are numbered."""

Size = tuple[int, int]
"""(width, height) that a part of a frame is read in [px]."""


@dataclass(frozen=True)
class PosedFrame:
    """A frame of another program's layout.

    Attributes:
        name: Id, a plain file name.
        lens: Intrinsics of the full-size image.
        pose: [3, 4] world to camera, OpenCV axes, in world units.
        time: Time in any unit.
        image: Reads the RGB image in a size; a fourth channel is 0 where it shows the world's background alone.
        static_mask: Reads the static mask; None if the frame has none.
        inverse_depth: Reads inverse depth along the optical axis, NaN where unknown; None if the frame has none.
        camera: See ``Camera.id``.
    """

    name: str
    lens: Lens
    pose: Float[np.ndarray, "3 4"]
    time: float
    image: Callable[[Size], UInt8[np.ndarray, "H W C"]]
    static_mask: Callable[[Size], Bool[np.ndarray, "H W"]] | None = None
    inverse_depth: Callable[[Size], Float[np.ndarray, "H W"]] | None = None
    camera: int = 0

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """[3] centre of the camera in the world."""
        return -self.pose[:, :3].T @ self.pose[:, 3]


@dataclass(frozen=True)
class World:
    """The world of a layout.

    Attributes:
        points: [P, 3] static points, P may be 0; None to unproject them from the depth of the frames, which must have
            the units of their cameras then.
        colors: [P, 3] 8-bit RGB; None if unknown.
        units: Scene units; around points and cameras if None, and wider than the cameras without points.
        assumption: What is dynamic where the frames have no masks.
        time_source: Where the times come from.
        own_times: Whether times are in [0, 1] already.
        background, notes, conventions: See ``Capture``.
    """

    points: Float[np.ndarray, "P 3"] | None
    colors: UInt8[np.ndarray, "P 3"] | None = None
    units: SceneUnits | None = None
    assumption: Assumption = "masks"
    time_source: TimeSource = IN_ORDER
    own_times: bool = False
    background: Background = "black"
    notes: Sequence[str] = ()
    conventions: Conventions = field(default_factory=Conventions)


def posed_capture(
    root: Path, frames: Sequence[PosedFrame], val: Collection[str], world: World, options: LoadOptions
) -> Capture:
    """The capture of posed frames, in scene units, with times in [0, 1].

    Args:
        root: Folder of the capture, for messages.
        frames: All frames.
        val: Names of those to evaluate on.
        world: Points and units.
        options: How they are read; ``factor`` is 1 if None. Without ``depth``, that of the frames is ignored.

    Raises:
        ValueError: If there are no frames, two have one name, or a camera is invalid.
    """
    _check_names(root, [frame.name for frame in frames])
    frames = [_as_asked(frame, options) for frame in frames]
    by_name = {frame.name: frame for frame in frames}
    points, colors = _points(world, frames)
    units = world.units or _units(frames, points)
    cameras, lenses = _cameras(root, frames, units, world.own_times, options)
    train, evaluated = ([name for name in by_name if (name in val) == is_val] for is_val in (False, True))
    reader = _FrameReader(by_name, cameras, lenses, units.scale, frozenset(train), options.perturbation)
    return Capture(
        root.resolve().name,
        cameras,
        train,
        evaluated,
        torch.tensor(_in_scene(root, units, points), dtype=torch.float32),
        None if colors is None else torch.tensor(colors),
        reader.read,
        options.cache_frames,
        world.assumption,
        background=world.background,
        notes=world.notes,
        time_source=world.time_source,
        conventions=world.conventions,
    )


def _as_asked(frame: PosedFrame, options: LoadOptions) -> PosedFrame:
    """The frame without its depth or the distortion of its lens, if they are not asked for."""
    frame = frame if options.depth else replace(frame, inverse_depth=None)
    return frame if options.distortion else replace(frame, lens=replace(frame.lens, coefficients=(), model="radial"))


def _points(
    world: World, frames: Sequence[PosedFrame]
) -> tuple[Float[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None]:
    return points_of_depth(frames) if world.points is None else (world.points, world.colors)


def _units(frames: Sequence[PosedFrame], points: Float[np.ndarray, "P 3"]) -> SceneUnits:
    centers = np.array([frame.center for frame in frames])
    return scene_units(points, centers) if len(points) else units_around(centers)


def _in_scene(root: Path, units: SceneUnits, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    try:
        return units.from_world(points)
    except ValueError as error:
        raise ValueError(f"{root}: points: {error}") from error


def _check_names(root: Path, names: Sequence[str]) -> None:
    if not names:
        raise ValueError(f"{root} has no frames")
    if len(set(names)) < len(names):
        raise ValueError(f"{root}: two frames are called {next(name for name in names if names.count(name) > 1)}")


def _cameras(
    root: Path, frames: Sequence[PosedFrame], units: SceneUnits, own_times: bool, options: LoadOptions
) -> tuple[dict[str, Camera], dict[str, Lens]]:
    """The camera of each frame, and the lens of its image."""
    times = [frame.time for frame in frames]
    start, length = (0.0, 1.0) if own_times else (min(times), (max(times) - min(times)) or 1.0)
    cameras, lenses = {}, {}
    for frame in frames:
        lens = reduced(frame.lens, options.factor or 1)
        try:
            lenses[frame.name] = lens if options.distortion else lens.centered_pinhole
            cameras[frame.name] = _camera(frame, lenses[frame.name], units, (frame.time - start) / length)
        except ValueError as error:
            raise ValueError(f"{root}: frame {frame.name}: {error}") from error
    return cameras, lenses


def reduced(lens: Lens, factor: int) -> Lens:
    """The lens of images scaled down by a factor; sides are rounded."""
    return lens.resized(max(1, round(lens.width / factor)), max(1, round(lens.height / factor)))


def world_to_camera(camera_to_world: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    """The inverse of a rigid [3, 4] camera-to-world matrix.

    Raises:
        ValueError: If a number is not finite or larger than ``files.MAX_NUMBER``, or its first three columns are not a
            rotation.
    """
    rotation = camera_to_world[:, :3].T
    if not (np.abs(camera_to_world) <= MAX_NUMBER).all():
        raise ValueError(f"the pose is not finite, or its numbers are larger than {MAX_NUMBER:g}")
    if not is_rotation(rotation):
        raise ValueError(f"the pose is not a rotation and a translation: {_flaw(rotation)}")
    return np.hstack([rotation, -rotation @ camera_to_world[:, 3:]])


def world_to_cameras(
    path: Path, camera_to_worlds: Float[np.ndarray, "N 3 4"]
) -> tuple[list[Float[np.ndarray, "3 4"]], tuple[str, ...]]:
    """``world_to_camera`` of the poses of a file, whose rotations may have one scale, and the note on it.

    Raises:
        ValueError: As there; the message names the file.
    """
    try:
        scale = scale_of_rotations(camera_to_worlds)
        poses = [world_to_camera(without_scale(pose, scale)) for pose in camera_to_worlds]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return poses, scale_note(path.name, scale)


def _flaw(matrix: Float[np.ndarray, "3 3"]) -> str:
    """What is wrong with a matrix that should be a rotation."""
    lengths = np.linalg.norm(matrix, axis=1)
    if np.abs(lengths - 1.0).max() > MAX_ROTATION_ERROR:
        return f"the axes of the camera have lengths {', '.join(f'{length:.4g}' for length in lengths)}, expected 1"
    return "its axes are mirrored" if np.linalg.det(matrix) < 0 else "its axes are not at right angles"


def opencv_from_opengl(camera_to_world: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    """A camera-to-world matrix with OpenCV axes of one with OpenGL axes (x right, y up, z backward)."""
    return camera_to_world * np.array([1.0, -1.0, -1.0, 1.0])


def every_eighth(names: Sequence[str]) -> list[str]:
    """The frames for evaluation where the files do not say which ones are: every eighth, from the fifth on."""
    return list(names[HOLDOUT // 2 :: HOLDOUT])


def plain_names(paths: Sequence[str]) -> list[str]:
    """Ids of images: their paths without suffixes and folders that all share, with underscores for slashes.

    Suffixes are kept if there would be two of one name otherwise, such as a.png and a.jpg.
    """
    plain = [path.replace("\\", "/").replace("\0", "").strip() for path in paths]
    names = _joined([without_image_suffix(path) for path in plain])
    return names if len(set(names)) == len(names) else _joined(plain)


def _joined(paths: Sequence[str]) -> list[str]:
    found = [[part for part in Path(path).parts if part not in ("/", "..", ".")] for path in paths]
    while all(len(parts) > 1 and parts[0] == found[0][0] for parts in found):
        found = [parts[1:] for parts in found]
    return ["_".join(parts) for parts in found]


def points_of_depth(
    frames: Sequence[PosedFrame],
) -> tuple[Float[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Points and their colours from frames whose depth has the units of their cameras; none without depth.

    Raises:
        ValueError: If a file of a frame is missing or damaged, or a lens folds back inside its image.
    """
    known = [frame for frame in frames if frame.inverse_depth is not None]
    chosen = evenly_spaced_indices(len(known), MAX_DEPTH_FRAMES)
    return points_of_views([_depth_view(known[k]) for k in chosen])


def _depth_view(frame: PosedFrame) -> DepthView:
    assert frame.inverse_depth is not None
    lens = reduced(frame.lens, max(1, round(max(frame.lens.width, frame.lens.height) / DEPTH_SIDE)))
    size = lens.width, lens.height
    static = np.ones(size[::-1], bool) if frame.static_mask is None else frame.static_mask(size)
    return DepthView(frame.image(size)[..., :3], frame.inverse_depth(size), static, lens, frame.pose)


def _camera(frame: PosedFrame, lens: Lens, units: SceneUnits, time: float) -> Camera:
    camera = lens.checked().camera(frame.pose[:, :3], units.from_world(frame.center), time)
    if not camera.viewmat.isfinite().all():
        raise ValueError("the pose is not finite in scene units")
    if not 0.0 <= time <= 1.0:
        raise ValueError(f"the time {time} is not in [0, 1]")
    return replace(camera, id=frame.camera)


@dataclass(frozen=True)
class _FrameReader:
    """Reads frames; ``scale`` is the number of scene units per world unit."""

    frames: dict[str, PosedFrame]
    cameras: dict[str, Camera]
    lenses: dict[str, Lens]
    scale: float
    train: frozenset[str]
    perturbation: MaskPerturbation

    def read(self, name: str) -> Frame:
        frame, size = self.frames[name], self.cameras[name].size
        stored = frame.image(size)
        empty = None if stored.shape[2] < 4 else torch.from_numpy(stored[..., 3] == 0)
        mask = None if frame.static_mask is None else frame.static_mask(size)
        if mask is not None and name in self.train:
            mask = perturb(mask, self.perturbation, name)
        depth = None if frame.inverse_depth is None else frame.inverse_depth(size) * self.lenses[name].axial_depths()
        return Frame(
            name,
            self.cameras[name],
            torch.from_numpy(np.require(stored[..., :3], requirements=("C", "W"))),
            None if mask is None else torch.from_numpy(mask),
            None if depth is None else torch.from_numpy(depth / np.float32(self.scale)),
            empty=empty,
        )
