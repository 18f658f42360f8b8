"""Training views on the device."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, partial
from itertools import chain
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from warpgs.cache import cache_folder
from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.data.capture import Capture, Frame
from warpgs.data.read_ahead import ReadAhead
from warpgs.data.resized import resize_inverse
from warpgs.data.sampling import evenly_spaced
from warpgs.model.poses import PoseCorrections
from warpgs.runtime.graphs import GraphCache

from .glance import Glance, glance_at
from .pixels import BYTES_PER_PIXEL, Pixels
from .stacked_cameras import LensRays, StackedCameras
from .view_cache import ViewCache
from .view_reader import Slot, ViewReader

Result = TypeVar("Result")

LONG = 1_000
"""Number of views above which the file of decoded ones is written while training runs, and progress is shown."""

MANY, SAMPLED = 4_000, 1_000
"""Number of views above which steps that look at all of them look at some, and at how many of them: only of videos are
there so many, in which each part of the scene is seen in many frames."""

MAX_RAY_BYTES = 1 << 30
"""Maximum memory of the rays of lenses on the device [bytes]; rays of more are found again in each step."""


class View(NamedTuple):
    """One training view on the device.

    Attributes:
        camera: The camera. Use ``time`` instead of ``camera.time``, which is not on the device.
        time: [1] time in [0, 1].
        image: [H, W, 3] ground truth in [0, 1], without jumps of exposure if they are divided out.
        static_mask: [H, W] M of the paper, true where static.
        mask_border: [H, W] true within the margin of a border of the mask; None without a margin.
        inverse_depth: [H, W] inverse depth up to a scale and an offset, NaN where unknown.
        shown: [H, W] ``Camera.shown``: whether a pixel shows anything; None if all do.
        mask_trust: Factor of the terms that follow the mask: 1, or 0 if the mask is not trusted.
    """

    camera: Camera
    time: Float[Tensor, "1"]
    image: Float[Tensor, "H W 3"]
    static_mask: Bool[Tensor, "H W"]
    mask_border: Bool[Tensor, "H W"] | None
    inverse_depth: Float[Tensor, "H W"]
    shown: Bool[Tensor, "H W"] | None
    mask_trust: Float[Tensor, ""]


def sample_of(videos: list[list[int]]) -> list[int]:
    """``Views.sample`` of views whose ``Views.videos`` these are."""
    indices = [index for video in videos for index in video]
    return sorted(evenly_spaced(indices, SAMPLED) if len(indices) > MANY else indices)


class Views:
    """The training frames of a capture.

    Frames of one size that fit into ``resident_bytes`` are kept on the device. Others are decoded once into a file and
    read from there, by threads that are ahead of training where they are told what comes next.

    A step of training trains on the selected view. That is one index or one slot on the device, so that steps on
    frames of one size can be CUDA graphs.

    Args:
        capture: Source of the frames.
        device: Device of the views.
        resident_bytes: Maximum memory for views on the device [bytes].
        mask_margin: Half width of the borders of masks, as a fraction of the image's larger side. Masks that are where
            frames are not empty have none: they are exact.
        poses: Corrections of the cameras; none if None.
        graph: Whether work on the views may be captured in CUDA graphs.

    Attributes:
        poses: The corrections.
        background: Colour behind everything.
        resident: Whether all views are on the device.
        cache: The file of those that are not resident, so that each is decoded once; None if all are.
        uses_graphs: Whether work on the selected view is captured in CUDA graphs: only if all views have one size,
            and lenses of one kind and limit that show the same pixels, which are constants of a graph.
        index: [1] index of the selected view, on the device.
        mask_trust: [T] ``View.mask_trust`` of each view, at first 1; on the device.
        num_pixels: Number of pixels of all views.

    Raises:
        ValueError: If a frame has no mask; the message names it.
    """

    def __init__(
        self,
        capture: Capture,
        device: torch.device,
        resident_bytes: int,
        mask_margin: float = 0.0,
        poses: PoseCorrections | None = None,
        graph: bool = True,
    ) -> None:
        self.device, self.poses = device, poses
        self._capture, self.background = capture, capture.background
        cameras = [capture.cameras[name] for name in capture.train]
        self._cameras = StackedCameras(cameras, device)
        self._times = torch.tensor([[camera.time] for camera in cameras], dtype=torch.float32, device=device)
        self._gains: Float[Tensor, "T 3"] | None = None
        self._reader = ViewReader(capture, mask_margin, pinned=device.type == "cuda")
        # New threads would use the first GPU, whatever the rank.
        self._setup = partial(torch.cuda.set_device, torch.cuda.current_device()) if device.type == "cuda" else None
        self._read_ahead, self._slot = ReadAhead(self._reader.read, self._setup), Slot(device)
        self.index, self._number = torch.zeros(1, dtype=torch.int64, device=device), 0
        self.mask_trust = torch.ones(len(capture.train), dtype=torch.float32, device=device)
        sizes = [camera.size for camera in cameras]
        self.num_pixels = sum(width * height for width, height in sizes)
        have_one_size = len(set(sizes)) == 1
        self.uses_graphs = graph and have_one_size and self._cameras.have_one_lens and device.type == "cuda"
        bytes_per_pixel = BYTES_PER_PIXEL + (mask_margin > 0.0)
        self.resident = have_one_size and self.num_pixels * bytes_per_pixel <= resident_bytes
        self._reader.cache = self.cache = None if self.resident else ViewCache(cache_folder("decoded views"), sizes)
        first = self._reader.read(0)  # also where none is resident: captures without masks are refused at once
        if self.resident:
            self._all = first.map(lambda tensor: tensor.new_empty((len(self), *tensor.shape), device=device))
            for index, pixels in enumerate(chain([first], self._read_ahead.each(range(1, len(self))))):
                self._at(index).copy_(pixels)

    def __len__(self) -> int:
        return len(self._capture.train)

    def __getitem__(self, index: int) -> View:
        on_device = self._pixels(index).map(lambda tensor: tensor.to(self.device))
        return self._view(on_device, torch.full((1,), index, device=self.device), index)

    def _pixels(self, index: int) -> Pixels:
        """The pixels of a view, on the device if they are resident, else in host memory."""
        return self._at(index) if self.resident else self._read_ahead.take(index)

    def _at(self, index: int) -> Pixels:
        """The memory of a resident view."""
        return self._all.map(lambda tensors: tensors[index])

    def __iter__(self) -> Iterator[View]:
        return self.each(range(len(self)))

    def each(self, indices: Sequence[int]) -> Iterator[View]:
        """The views of these indices, one after the other."""
        return (self[index] for index in self._announced(indices))

    def _announced(self, indices: Sequence[int]) -> Iterator[int]:
        """These indices, one after the other, while the views of the next ones are read ahead."""
        for position, index in enumerate(indices):
            self.announce(indices[position:])
            yield index

    @torch.no_grad()
    def map(self, work: Callable[[View], tuple[Tensor, ...]]) -> Iterator[tuple[Tensor, ...]]:
        """The results of work on every view of the ``sample``, without gradients; each is valid until the next.

        Args:
            work: Returns tensors, and has no other effect: it may be captured in a CUDA graph.
        """
        graphs: GraphCache[str] | None = GraphCache(max_graphs=1, repeatable=True) if self.uses_graphs else None
        for index in self._announced(self.sample):
            self.select(index)
            yield graphs.run("view", lambda: work(self.selected())) if graphs else work(self.selected())

    def in_threads(self, work: Callable[[int], Result], indices: Sequence[int]) -> Iterator[Result]:
        """The results of work on views of these indices, one after the other; it may change the depth of its view."""
        return ReadAhead(work, self._setup).each(indices)

    @cached_property
    def glances(self) -> list[Glance]:
        """Each view at a glance: all frames are read once, by threads."""
        indices = progress(range(len(self)), "looking at the views", quiet=len(self) <= LONG)
        return [glance for _, glance in zip(indices, self.in_threads(self._glance, range(len(self))), strict=True)]

    def _glance(self, index: int) -> Glance:
        # A large file is written while training runs, and not before it.
        if self.resident:
            pixels = self._at(index).map(Tensor.cpu)
        else:
            pixels = self._reader.read_once(index, keep=len(self) <= LONG)
        return glance_at(pixels, self.camera(index))

    @cached_property
    def sample(self) -> Sequence[int]:
        """The indices of all views, or of ``SAMPLED`` of more than ``MANY``: spread over cameras and times."""
        return sample_of(self.videos)

    @property
    def videos(self) -> list[list[int]]:
        """The indices of the views of each camera, in the order of time; see ``Capture.videos``."""
        index = {name: k for k, name in enumerate(self._capture.train)}
        return [[index[name] for name in names] for names in self._capture.videos(self._capture.train)]

    def frames(self, indices: Sequence[int]) -> Iterator[Frame]:
        """The frames of these indices, on the CPU, with jumps of exposure and without depth; not to be changed."""
        return (self.frame(index) for index in self._announced(indices))

    def frame(self, index: int) -> Frame:
        """The frame of an index, as ``frames`` gives it."""
        pixels = self._pixels(index)
        return Frame(self._capture.train[index], self.camera(index), pixels.image.cpu(), pixels.static_mask.cpu())

    def camera(self, index: int) -> Camera:
        """The camera of a view as the capture has it, on the CPU."""
        return self._capture.cameras[self._capture.train[index]]

    def time(self, index: int) -> Float[Tensor, "1"]:
        """[1] time of a view in [0, 1], on the device."""
        return self._times[index]

    def announce(self, indices: Iterable[int]) -> None:
        """Says which views come next, so that those that are not resident are read ahead."""
        if not self.resident:
            self._read_ahead.announce(indices)

    def select(self, index: int) -> None:
        """Selects the view of an index, in the order of the current stream."""
        self.index.fill_(index)
        self._number = index
        if not self.resident:
            self._slot.fill(self._read_ahead.take(index))

    def selected(self) -> View:
        """The selected view, read from addresses that stay the same if ``uses_graphs``."""
        if not self.resident:
            return self._view(self._slot.pixels, self.index, self._number)
        return self._view(
            self._all.map(lambda tensors: tensors.index_select(0, self.index)[0]), self.index, self._number
        )

    def divide_by(self, gains: Float[Tensor, "T 3"]) -> None:
        """Divides images by a factor per channel."""
        self._gains = gains.to(self.device)

    def set_depth_factor(self, index: int, alignment: Float[Tensor, "2"], factor: Float[Tensor, "H W"]) -> None:
        """Multiplies the aligned inverse depth of a view by a factor, once; the alignment stays the same."""
        (scale, offset), factor = alignment.cpu(), factor.half().cpu()
        self.change_depth(index, lambda depth, static_mask: ((scale * depth + offset) * factor - offset) / scale)

    def set_object_depth(self, index: int, alignment: Float[Tensor, "2"], depths: Float[Tensor, "h w"]) -> None:
        """Sets the aligned depth of a view's dynamic pixels whose depth is unknown.

        Args:
            index: Index of the view.
            alignment: [2] scale and offset of its inverse depth; they stay the same.
            depths: [h, w] depth [scene units] of any size, NaN where unknown.
        """
        scale, offset = alignment.cpu()
        inverse = ((1.0 / depths - offset) / scale).numpy()
        is_known = np.isfinite(inverse)
        # Kept until the view is read: only what is known.
        values, known, shape = inverse[is_known], np.packbits(is_known), inverse.shape

        def change(depth: Tensor, static_mask: Tensor) -> Tensor:
            small = np.full(shape, np.nan, np.float32)
            small[np.unpackbits(known, count=small.size).view(bool).reshape(shape)] = values
            found = resize_inverse(small, (depth.shape[1], depth.shape[0]))
            return torch.where(depth.isnan() & ~static_mask, torch.from_numpy(found), depth)

        if self.resident:
            self.change_depth(index, change)
        else:
            self._reader.change_depth_later(index, change)
            self._read_ahead.discard(index)

    def change_depth(self, index: int, change: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Replaces the inverse depth of a view by a function of it and of its static mask, on the CPU."""
        if self.resident:
            depth, static_mask = (values[index].cpu() for values in (self._all.inverse_depth, self._all.static_mask))
            self._all.inverse_depth[index] = change(depth.float(), static_mask).half()
        else:
            self._reader.change_depth(index, change)
            self._read_ahead.discard(index)

    @cached_property
    def interval(self) -> float:
        """See ``Capture.interval``."""
        return self._capture.interval

    @torch.no_grad()
    def cameras(self) -> list[Camera]:
        """The corrected cameras of the views of the ``sample``, on the device."""
        cameras = [self.camera(index).to(self.device) for index in self.sample]
        indices = torch.tensor(self.sample, device=self.device).split(1)
        return [self._corrected(*pair) for pair in zip(cameras, indices, strict=True)]

    def lens_rays(self) -> LensRays | None:
        """What each pixel of the views sees; None for pinholes, images of several sizes, and too many lenses."""
        cameras = [self._capture.cameras[name] for name in self._capture.train]
        is_pinhole = all(camera.distortion is None for camera in cameras)
        have_one_size = len({camera.size for camera in cameras}) == 1
        is_kept = have_one_size and not is_pinhole and LensRays.nbytes(cameras) <= MAX_RAY_BYTES
        return LensRays(cameras, self.device) if is_kept else None

    def _corrected(self, camera: Camera, index: Int64[Tensor, "1"]) -> Camera:
        return camera if self.poses is None else self.poses.moved(camera, index)

    def _view(self, pixels: Pixels, index: Int64[Tensor, "1"], number: int) -> View:
        """A view on the device; ``number`` is its index, or with CUDA graphs any: its camera has the same lens."""
        time, mask_trust = (values.index_select(0, index)[0] for values in (self._times, self.mask_trust))
        height, width = pixels.static_mask.shape
        image = pixels.image.float() / 255.0
        camera = self._cameras.at(index, number, (width, height))
        return View(
            self._corrected(camera, index),
            time,
            image if self._gains is None else image / self._gains.index_select(0, index)[0],
            pixels.static_mask,
            pixels.mask_border,
            pixels.inverse_depth.float(),
            self._cameras.shown[number],
            mask_trust,
        )
