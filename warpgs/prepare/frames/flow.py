"""Dense optical flow between the frames of a video."""

import threading
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from warpgs.data.optical_flow import even_contrast, follow

Pair = tuple[int, int]

PATCH_STRIDE, NUM_REFINEMENTS = 4, 2
"""Distance of DIS's patches [px], and its rounds of variational refinement. With 3 px and 5 rounds, those of its medium
preset, flow takes twice as long and masks are as good."""

TOLERANCE = 0.25
"""Distance by which flow there and back may miss a visible pixel [px], besides a part of its displacement."""


class Flows:
    """Optical flow (DIS, Kroeger et al. 2016) between frames of one size. It is thread-safe.

    The flow between two frames is needed only while one of them is processed; it is computed once and kept until
    ``release`` was called for both. DIS searches near the flow that it starts from: with the flow that the cameras
    predict, it finds wide displacements that it misses otherwise. Its finest scale is that of the images, so give it
    images of half the size at which flow is wanted: DIS would compute it at half the size anyway, and interpolate.

    Attributes:
        grey: [H, W] grey levels of every frame.
        planes: [H, W] the same with local contrast equalized, so that dark regions count as much as bright ones.
        x, y: [H, W] column and row of every pixel.
    """

    def __init__(
        self,
        images: Sequence[UInt8[np.ndarray, "H W 3"]],
        expected: Callable[[int, int], Float[np.ndarray, "H W 2"]] | None = None,
    ) -> None:
        """Prepares the images.

        Args:
            images: [H, W, 3] of every frame.
            expected: The flow from one frame to another to start from; from none if None.
        """
        self._expected = expected
        self.grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
        self.planes = [even_contrast(plane) for plane in self.grey]
        height, width = self.planes[0].shape
        self.x, self.y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        self._engines = threading.local()
        self._flows: dict[Pair, np.ndarray] = {}
        self._locks: dict[Pair, threading.Lock] = {}
        self._lock = threading.Lock()
        self._released: set[int] = set()

    def compute(
        self,
        a: UInt8[np.ndarray, "H W"],
        b: UInt8[np.ndarray, "H W"],
        start: Float[np.ndarray, "H W 2"] | None = None,
        *,
        coarse: bool = False,
    ) -> Float[np.ndarray, "H W 2"]:
        """[H, W, 2] displacement of every pixel of plane a in plane b [px], found from ``start`` on.

        ``coarse`` computes it at half the size and interpolates, in 0.3 times the time.
        """
        name = "coarse" if coarse else "fine"
        if not hasattr(self._engines, name):
            engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
            engine.setFinestScale(int(coarse))
            engine.setPatchStride(PATCH_STRIDE)
            engine.setVariationalRefinementIterations(NUM_REFINEMENTS)
            setattr(self._engines, name, engine)
        return getattr(self._engines, name).calc(a, b, start)

    def flow(self, a: int, b: int) -> Float[np.ndarray, "H W 2"]:
        """[H, W, 2] displacement of every pixel of frame a in frame b [px]."""
        with self._lock:
            lock = self._locks.setdefault((a, b), threading.Lock())
        with lock:  # another thread may be computing this flow
            flow = self._flows.get((a, b))
            if flow is None:
                start = None if self._expected is None else self._expected(a, b)
                flow = self.compute(self.planes[a], self.planes[b], start).astype(np.float16)
                self._flows[a, b] = flow
        return flow.astype(np.float32)

    def release(self, frame: int) -> None:
        """Marks a frame as processed: drops the flows between it and other processed frames."""
        with self._lock:
            self._released.add(frame)
            for pair in [pair for pair in self._locks if self._released.issuperset(pair)]:
                del self._locks[pair]
                self._flows.pop(pair, None)

    def track(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "H W"]]:
        """Column and row in b of every pixel of a, and whether the flow from there leads back to it (it is visible)."""
        return follow(self.flow(a, b), self.flow(b, a), TOLERANCE)
