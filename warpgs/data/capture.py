"""A capture: posed images of a dynamic scene, read frame by frame."""

import copy
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, Literal, get_args

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import Background, Color
from warpgs.errors import suggestion

from .median_depth import median_depth
from .read_ahead import ReadAhead
from .sampling import evenly_spaced
from .time_source import AS_GIVEN, TimeSource
from .tracks import Tracks

MIN_PATH = 0.01
"""Radius of the training cameras' positions, relative to the median depth, below which depth cannot be learned: a tenth
more depth moves a point by about a thousandth of the focal length then, which is less than a pixel."""

MIN_EXTENT = 0.05
"""Minimum extent [scene units]."""

MAX_DEPTH_IMAGES = 8
"""Maximum number of depth images that tell the median depth."""

MAX_CACHE_BYTES = 1 << 30
"""Maximum memory of a capture's cache of frames."""

FRAME_BYTES_PER_PIXEL = 3 + 1 + 4
"""Memory of a cached frame per pixel [bytes]: 8-bit RGB, a mask and depth in single precision."""


Side = Literal["top", "bottom", "left", "right"]
"""A side of an image."""

SIDES: tuple[Side, ...] = get_args(Side)

Assumption = Literal["masks", "static", "dynamic"]
"""What is taken as dynamic: the region that the masks mark, nothing, or everything."""

MASKS_REMEDY = "with warpgs prepare CAPTURE --add masks, or train with --assume static or --assume dynamic"
"""How to go on without masks: the end of a message that says what to make."""

COLORS: dict[Literal["black", "white"], Color] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
"""RGB of the named backgrounds."""


def background_color(background: Background) -> Color:
    """RGB in [0, 1]; black under the sky."""
    return background if isinstance(background, tuple) else COLORS["white" if background == "white" else "black"]


def path_radius(cameras: Sequence[Camera]) -> float:
    """Largest distance of a camera from their mean position [scene units]."""
    positions = torch.stack([camera.position for camera in cameras])
    return float((positions - positions.mean(0)).norm(dim=1).max())


def extent_of(cameras: Sequence[Camera]) -> float:
    """``cameras_extent`` of 3DGS: the radius of the training cameras' path, times 1.1, at least ``MIN_EXTENT``."""
    return max(MIN_EXTENT, 1.1 * path_radius(cameras))


class UnknownFrameError(KeyError):
    """A capture has no frame of an id."""

    def __str__(self) -> str:
        return str(self.args[0])  # KeyError shows its representation


@dataclass(frozen=True)
class Frame:
    """One image and everything that is known about it, on the CPU.

    Attributes:
        name: Id in the capture.
        camera: Camera in scene units, with the distortion of its lens and the frame's time in [0, 1].
        image: [H, W, 3] 8-bit RGB.
        static_mask: [H, W] true where the scene is static; None if the frame has no mask.
        inverse_depth: [H, W] inverse of ``Camera.depths`` up to a scale and an offset per frame, NaN where unknown;
            None if the frame has no depth.
        covisible: [H, W] true where masked metrics are computed (iPhone captures); None if the frame has no such mask.
        empty: [H, W] true where the image shows the capture's ``background`` alone; None if that is not known.
    """

    name: str
    camera: Camera
    image: UInt8[Tensor, "H W 3"]
    static_mask: Bool[Tensor, "H W"] | None = None
    inverse_depth: Float[Tensor, "H W"] | None = None
    covisible: Bool[Tensor, "H W"] | None = None
    empty: Bool[Tensor, "H W"] | None = None


@dataclass(frozen=True)
class Conventions:
    """The meaning of a layout's files, for messages.

    Attributes:
        masks: How they mark what is dynamic.
        depth: Whether files hold inverse depth, larger is closer, or depth, larger is farther.
        depth_unit: Name of the unit in which depth must equal the units of the cameras; None if any will do.
    """

    masks: str = "0 must mean dynamic and 255 static"
    depth: Literal["inverse depth", "depth"] = "inverse depth"
    depth_unit: str | None = None


@dataclass(eq=False, repr=False)
class Capture:
    """A capture in scene units: a position p of the files is (p − center) · scale.

    It can be pickled, without the frames that it keeps in memory: each worker of a DataLoader reads its own.

    Attributes:
        name: For messages and reports.
        cameras: The camera of each id of ``train`` and ``val``.
        train: Ids of the frames to train on.
        val: Ids of the frames to evaluate on.
        points: [P, 3] sparse static points, P may be 0.
        point_colors: [P, 3] 8-bit RGB of the points; None if the capture has none.
        read: Reads a frame; called for frames that are not among the last ``cache_frames`` read.
        cache_frames: Maximum number of frames to keep in memory, of which large ones are fewer: ``MAX_CACHE_BYTES``.
        metric_depth: Whether inverse depth has scene units and no offset, so that it is not aligned.
        estimated_masks: Whether the masks are estimates of ``warpgs prepare`` instead of given.
        background: Colour behind everything; black is also that of captures whose images show no background.
        time_source: Where the times of the cameras come from.
        readout: Time in which the rows of a frame are read from the first to the last, as a part of the median time
            between training frames; negative from the last to the first, 0 with a global shutter. See ``with_readout``.
        readout_from: Side of the images at which a positive readout begins: of upright images of a phone held upright
            it is the left or the right one, and columns are read one after another.
        layout: Name of the layout of its files, for the middle of messages; empty if it was not read from files.
        unmasked: What "masks" means for this capture: "dynamic" if it has no masks because everything moves.
        conventions: What its files mean.
        is_builtin: Whether the package makes it: then no advice to change its files makes sense.
        metres: Metres per scene unit; None if that is not known.
        read_tracks: Reads ``tracks``; None without any.
        notes: Remarks of the loader on files that it skipped or had to interpret, one sentence each.
        assumption: What is taken as dynamic; see ``assuming``.
        has_empty: Whether frames may say where they are empty: not over black; see ``over``.

    Raises:
        ValueError: If there are no training frames.
    """

    name: str
    cameras: dict[str, Camera]
    train: Sequence[str]
    val: Sequence[str]
    points: Float[Tensor, "P 3"]
    point_colors: UInt8[Tensor, "P 3"] | None
    read: Callable[[str], Frame]
    cache_frames: int = 256
    unmasked: Assumption = "masks"
    metric_depth: bool = False
    estimated_masks: bool = False
    background: Background = "black"
    is_builtin: bool = False
    notes: Sequence[str] = ()
    time_source: TimeSource = AS_GIVEN
    readout: float = 0.0
    readout_from: Side = "top"
    layout: str = ""
    read_tracks: Callable[[], Tracks | None] | None = None
    metres: float | None = None
    conventions: Conventions = field(default_factory=Conventions)
    assumption: Assumption = field(init=False)
    has_empty: bool = field(init=False)

    def __post_init__(self) -> None:
        self._choose(self.train, self.val)
        self.notes, self._moved = tuple(self.notes), frozenset[str]()
        self.assumption, self.has_empty = self.unmasked, self.background == "white"
        self._make_cache()

    def _choose(self, train: Sequence[str], val: Sequence[str]) -> None:
        if not train:
            raise ValueError(f"{self.name} has no frames to train on: give train the ids of some")
        self.train, self.val = tuple(train), tuple(val)

    def _make_cache(self) -> None:
        largest = max(camera.width * camera.height for camera in self.cameras.values())
        fitting = max(1, MAX_CACHE_BYTES // (FRAME_BYTES_PER_PIXEL * largest))
        self._cached = lru_cache(maxsize=min(self.cache_frames, fitting))(self.read)

    def __getstate__(self) -> dict[str, Any]:
        """What another process needs, such as a worker of a DataLoader: all but the cache of frames."""
        return {name: value for name, value in vars(self).items() if name != "_cached"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_cache()

    def __copy__(self) -> "Capture":
        """A copy with the same cache of frames, which ``__getstate__`` leaves out."""
        capture = object.__new__(Capture)
        vars(capture).update(vars(self))
        return capture

    def __repr__(self) -> str:
        frames = f"{len(self.train)} frames to train on, {len(self.val)} to evaluate on"
        return f"<Capture {self.name}: {frames}, {len(self.points)} points>"

    @cached_property
    def tracks(self) -> Tracks | None:
        """Points that a network followed through the frames of ``film``, read once; None without any.

        Raises:
            ValueError: If their file is damaged, or does not fit the frames.
        """
        return None if self.read_tracks is None else self.read_tracks()

    @cached_property
    def median_depth(self) -> float:
        """Median depth at which the training cameras see the scene [scene units].

        From the points, else from depth images in scene units, else from where the cameras look; see ``median_depth``.

        Raises:
            ValueError: If a depth image that is needed is missing or damaged.
        """
        cameras = [self.cameras[name] for name in self.train]
        return median_depth(cameras, self.points, self._inverse_depths() if self.metric_depth else ())

    @property
    def view_size(self) -> float:
        """Length of what an image shows at the median depth, along its larger side [scene units].

        It is the unit of what must mean the same on screen: moving by a fraction of it moves a point at that depth by
        that fraction of the image, whatever the lens, in portrait and landscape.
        """
        cameras = [self.cameras[name] for name in self.train]
        slopes = [torch.tensor(camera.size) / camera.K.diagonal()[:2] for camera in cameras]
        return self.median_depth * float(torch.stack(slopes).amax(1).median())

    def _inverse_depths(self) -> Iterator[Tensor]:
        for name in evenly_spaced(self.train, MAX_DEPTH_IMAGES):
            if (image := self.frame(name).inverse_depth) is not None:
                yield image

    @property
    def path_radius(self) -> float:
        """Largest distance of a training camera from their mean position [scene units]."""
        return path_radius([self.cameras[name] for name in self.train])

    @property
    def extent(self) -> float:
        """See ``extent_of`` [scene units]."""
        return extent_of([self.cameras[name] for name in self.train])

    @property
    def hardly_moves(self) -> bool:
        """Whether the training camera moves too little, for how far it looks, to show depth."""
        return self.path_radius < MIN_PATH * self.median_depth

    @property
    def uses_estimated_masks(self) -> bool:
        """Whether what is taken as dynamic is an estimate of ``warpgs prepare``."""
        return self.estimated_masks and self.assumption == "masks"

    def assuming(self, assumption: Assumption) -> "Capture":
        """The same capture with static masks as in the files ("masks"), all true ("static") or all false ("dynamic").

        Under "dynamic", masks are true where frames are known to be empty. ``assuming("masks")`` restores the masks of
        the files for evaluation, or ``unmasked`` if that is what the capture says of itself. The captures have one
        cache of frames.
        """
        capture = copy.copy(self)
        capture.assumption = self.unmasked if assumption == "masks" else assumption
        return capture

    def over(self, background: Background) -> "Capture":
        """The same capture with another colour behind everything, over which no pixel is known to be empty.

        The captures have one cache of frames.
        """
        capture = copy.copy(self)
        capture.background, capture.has_empty = background, self.has_empty and background == self.background
        return capture

    def with_cameras(self, cameras: Mapping[str, Camera]) -> "Capture":
        """The same capture with other cameras of the frames named; the captures have one cache of frames."""
        capture = copy.copy(self)
        capture.cameras, capture._moved = self.cameras | dict(cameras), self._moved | set(cameras)
        capture._forget_measures()
        return capture

    def split(self, train: Sequence[str], val: Sequence[str]) -> "Capture":
        """The same capture with other frames; raises as the constructor. The captures have one cache of frames."""
        capture = copy.copy(self)
        capture._choose(train, val)
        capture._forget_measures()
        return capture

    def _forget_measures(self) -> None:
        for name in ("median_depth", "moments"):
            vars(self).pop(name, None)

    def in_time(self, names: Iterable[str]) -> list[str]:
        """Names of frames in the order of their times; those of the same time in the order of the names."""
        return sorted(names, key=lambda name: (self.cameras[name].time, name))

    def by_camera(self, names: Iterable[str]) -> dict[int, list[str]]:
        """Names of the frames of each ``Camera.id``, ids in ascending order, frames as ``in_time``."""
        ordered = self.in_time(names)
        ids = sorted({self.cameras[name].id for name in ordered})
        return {i: [name for name in ordered if self.cameras[name].id == i] for i in ids}

    def videos(self, names: Iterable[str]) -> list[list[str]]:
        """Names of frames that one camera took one after the other, in the order of time: a list for each camera.

        Frames of an id that several of them share with one time are a list each: their cameras are not known.
        """
        found: list[list[str]] = []
        for frames in self.by_camera(names).values():
            is_one = len({self.cameras[name].time for name in frames}) == len(frames)
            found += [frames] if is_one else [[name] for name in frames]
        return found

    @property
    def film(self) -> list[str] | None:
        """The frames of the camera that trains, held-out ones among them, in the order of time; None if several do."""
        trained = [*self.by_camera(self.train)]
        return self.by_camera(self.cameras)[trained[0]] if len(trained) == 1 else None

    def neighbours(self, names: Iterable[str]) -> list[tuple[str, str]]:
        """Pairs of frames of one camera, one after the other in time."""
        return [pair for frames in self.videos(names) for pair in pairwise(frames)]

    @cached_property
    def moments(self) -> list[float]:
        """The times of the training frames, in order, as one camera takes them.

        They are those of the camera with the most times, and of others before and after it: cameras that film at the
        same time, with offsets in between, do not determine faster motion.
        """
        found: list[float] = []
        for times in sorted(self._times_of_cameras(), key=lambda times: (-len(times), times)):
            found = sorted([*found, *(t for t in times if not found or not found[0] <= t <= found[-1])])
        return found

    @property
    def interval(self) -> float:
        """Median time from a training frame to the next one of its camera, else of all; 0 if all have one time."""
        several = [times for times in self._times_of_cameras() if len(times) > 1] or [self.moments]
        gaps = torch.cat([torch.tensor(times, dtype=torch.float64).diff() for times in several])
        return float(gaps.median()) if len(gaps) else 0.0

    def _times_of_cameras(self) -> list[list[float]]:
        """The distinct times of the training frames of each camera, in order."""
        return [sorted({self.cameras[n].time for n in frames}) for frames in self.by_camera(self.train).values()]

    def frame(self, name: str) -> Frame:
        """A frame, from the cache if it is among the last ``cache_frames`` read.

        Raises:
            KeyError: If the capture has no frame of this id; the message has a similar one.
            ValueError: If a file of the frame is missing, damaged or of another size; the message names it.
        """
        if name not in self.cameras:
            raise UnknownFrameError(missing_view(self, name))
        frame = self._cached(name)
        if name in self._moved:
            frame = replace(frame, camera=self.cameras[name])
        if frame.empty is not None and not self.has_empty:
            frame = replace(frame, empty=None)
        if self.assumption == "masks":
            return frame
        static = torch.full(frame.image.shape[:2], self.assumption == "static")
        return replace(frame, static_mask=static if frame.empty is None else static | frame.empty)

    def forget_frames(self) -> None:
        """Drops the frames in memory, as of all captures with the same cache; they are read again when asked for."""
        self._cached.cache_clear()

    def frames(self, names: Sequence[str]) -> Iterator[Frame]:
        """Frames one after the other, read ahead by threads; raises as ``frame``."""
        return ReadAhead(self.frame).each(names)


def missing_view(capture: Capture, name: object) -> str:
    """Message that a capture has no view ``name``, and the similar one or its first."""
    first = (capture.val or capture.train)[0]
    close = suggestion(str(name), capture.cameras, repr) or f"; its first is {first!r}"
    given = repr(name) if isinstance(name, str) else reprlib.repr(name)
    return f"{capture.name} has no view {given}{close}"
