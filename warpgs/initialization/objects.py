"""Dynamic objects as connected regions of the masks, followed from frame to frame."""

from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Int

from warpgs.data.dynamic_regions import MIN_FRAMES, is_cut, scaled_size
from warpgs.data.optical_flow import MIN_SIDE, even_contrast, flow_between
from warpgs.runtime.launch import on_all_cores
from warpgs.views.glance import Glance
from warpgs.views.views import Views

from .packed import packed_pixels

MIN_OVERLAP = 0.3
"""Overlap of regions of consecutive frames, relative to the smaller one, from which on they show the same object."""

MIN_VISIBLE = 0.5
"""Fraction of its last whole region from which on an object beside another one is still followed."""

SMOOTHING = 7
"""Side of the window over which borders between objects are smoothed [px]."""

NOTHING = -1
"""Label of pixels that show no object."""


@dataclass(eq=False)
class MovingObject:
    """An object in consecutive frames.

    Attributes:
        pixels: By index of the training frame, flat indices of its pixels in the scaled mask.
        whole: The frames in which it is a region by itself and not cut off by the image border.
        cut: The frames in which the image border cuts it off.
        is_mixture: Whether it is several objects that cannot be told apart.
    """

    pixels: MutableMapping[int, Int[np.ndarray, " P"]] = field(default_factory=packed_pixels)
    whole: list[int] = field(default_factory=list)
    cut: list[int] = field(default_factory=list)
    is_mixture: bool = False

    @property
    def is_mostly_cut(self) -> bool:
        """Whether too few frames show the object whole for its size to be known."""
        return len(self.whole) < MIN_FRAMES


def find_objects(views: Views, order: Sequence[int]) -> list[MovingObject]:
    """The objects that the masks of training frames show.

    Where several become one region, optical flow tells which pixels belong to which of them, until they part, or one
    hides another.

    Args:
        views: The training views.
        order: Indices of those of one camera, by time or backward in time.
    """
    follower = _Follower(views)
    for index in order:
        follower.add(index, views.glances[index].regions)
    return follower.objects


def num_cut_off(objects: Sequence[MovingObject]) -> int | None:
    """Number of frames in which the image border cuts objects off, if the size of none is known; None otherwise."""
    if not objects or not all(item.is_mostly_cut for item in objects if not item.is_mixture):
        return None
    return len({index for item in objects for index in item.cut})


def find_all_objects(views: Views) -> list[MovingObject]:
    """The objects that the masks show by time, then those backward in time: what parts later is told apart before."""
    orders = [order for video in views.videos for order in (video, video[::-1])]
    found: list[list[MovingObject]] = [[] for _ in orders]
    _ = views.glances  # before threads ask for them

    def find(k: int) -> None:
        found[k] = find_objects(views, orders[k])

    on_all_cores(find, len(orders))
    return [item for of_order in found for item in of_order]


class _Follower:
    """Follows objects from one frame to the next.

    Attributes:
        objects: All that were found.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self.objects: list[MovingObject] = []
        self._before: int | None = None
        self._labels: Int[np.ndarray, "h w"] | None = None

    def add(self, index: int, regions: list[Bool[np.ndarray, "h w"]]) -> None:
        """Goes on to the training frame of an index, which shows these regions."""
        alone, labels = set(), np.full(scaled_size(self._views.camera(index).size)[::-1], NOTHING)
        for region, candidates in zip(regions, self._candidates(regions), strict=True):
            if len(candidates) > 1 and not any(self.objects[k].is_mixture for k in candidates):
                self._divide(region, candidates, index, labels)
            else:
                label = candidates[0] if len(candidates) == 1 else self._new(is_mixture=len(candidates) > 1)
                labels[region] = label
                alone.add(label)
        for label in np.unique(labels[labels != NOTHING]):
            item, shown = self.objects[label], labels == label
            item.pixels[index] = np.flatnonzero(shown).astype(np.int32)
            if is_cut(shown):
                item.cut.append(index)
            elif label in alone:
                item.whole.append(index)
        self._before, self._labels = index, labels

    def _new(self, is_mixture: bool = False) -> int:
        self.objects.append(MovingObject(is_mixture=is_mixture))
        return len(self.objects) - 1

    def _candidates(self, regions: list[Bool[np.ndarray, "h w"]]) -> list[list[int]]:
        """For each region, the labels of the objects that it goes on with: those that overlap it and no other one."""
        if self._labels is None or not regions or self._labels.shape != regions[0].shape:
            return [[] for _ in regions]
        areas = np.bincount(self._labels[self._labels != NOTHING], minlength=len(self.objects))
        seen = [self._labels[region & (self._labels != NOTHING)] for region in regions]
        overlaps = np.array([np.bincount(labels, minlength=len(self.objects)) for labels in seen])
        smaller = np.minimum(areas, np.array([region.sum() for region in regions])[:, None])
        linked = overlaps > MIN_OVERLAP * smaller
        linked[:, linked.sum(0) > 1] = False  # it falls apart
        return [np.flatnonzero(row).tolist() for row in linked]

    def _divide(
        self, region: Bool[np.ndarray, "h w"], candidates: list[int], index: int, labels: Int[np.ndarray, "h w"]
    ) -> None:
        """Labels the pixels of a region of several objects by where optical flow leads to in the frame before."""
        assert self._before is not None
        assert self._labels is not None
        before, after = (self._views.glances[k] for k in (self._before, index))
        carried = np.where(region, _carried(self._labels, before, after), NOTHING)
        distances = [cv2.distanceTransform((carried != k).astype(np.uint8), cv2.DIST_L2, 5) for k in candidates]
        nearest = np.argmin(distances, axis=0)
        near = [(region & (nearest == k)).astype(np.float32) for k in range(len(candidates))]
        parts = np.argmax([cv2.blur(part, (SMOOTHING, SMOOTHING)) for part in near], axis=0)[region]
        if any(self._is_lost(label, int((parts == k).sum())) for k, label in enumerate(candidates)):
            labels[region] = self._new(is_mixture=True)
        else:
            labels[region] = np.array(candidates)[parts]

    def _is_lost(self, label: int, area: int) -> bool:
        item = self.objects[label]
        last = item.whole[-1] if item.whole else next(iter(item.pixels))
        return area < MIN_VISIBLE * len(item.pixels[last])


def _carried(labels: Int[np.ndarray, "h w"], before: Glance, after: Glance) -> Int[np.ndarray, "h w"]:
    """The labels of the frame before, carried over by optical flow (DIS); ``NOTHING`` where it does not lead back."""
    height, width = labels.shape
    if min(height, width) < MIN_SIDE:
        return np.full_like(labels, NOTHING)
    flow, leads_back = flow_between(*(even_contrast(glance.grey) for glance in (after, before)))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    column, row = np.rint(x + flow[..., 0]).astype(int), np.rint(y + flow[..., 1]).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = labels[row.clip(0, height - 1), column.clip(0, width - 1)]
    return np.where(inside & leads_back, found, NOTHING)
