"""Superpixels of all frames as one graph, over which evidence of motion spreads.

A superpixel is connected to its neighbours in the image, more strongly the more similar their colour and depth, and to
those that optical flow carries it to in the next frame. With s, m the evidence that a superpixel is static or dynamic,
its dynamic probability x minimises

    Σ (s_i x_i² + m_i (1 − x_i)²) + Σ w_ij (x_i − x_j)²,

the random walker of Grady (2006) with soft seeds: one sparse linear system. Then the colours of the static and the
dynamic superpixels of the whole sequence serve as further evidence, and the system is solved again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy import sparse
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import cg

SIDE = 12
"""Side of a superpixel [px]."""

INNER, MIN_INNER = 0.7, 0.25
"""Fraction of a superpixel that is inside of its border, usually, and the least from which evidence counts for all of
it."""

COLOR_WEIGHTS = np.array([0.7, 2.0, 2.0])
"""Weights of lightness and of the two colour axes in differences: shading changes lightness."""

COLOR_SCALE = 10.0
"""Colour difference that separates superpixels, in levels of 8-bit Lab."""

DEPTH_SCALE = 0.12
"""Difference of log inverse depth that separates superpixels."""

TIME_WEIGHT = 0.1
"""Weight of an edge to the next frame per pixel that flow carries over it, in pixels of shared border."""

TRUST = 0.5
"""Weight of the evidence on a pixel, in pixels of border."""

PRIOR = 0.02
"""Prior evidence per pixel that it is static."""

COLOR_TRUST = 0.05
"""Evidence of colour per pixel and unit of log odds."""

HALVING_EVIDENCE = 0.05
"""Evidence per pixel that a superpixel is static, at which a dynamic colour counts half."""

MAX_LOG_ODDS = 2.5

NUM_COLOR_ROUNDS = 2

BINS = 20
"""Bins per axis of the colour histograms; the axes are ranks, so that all bins are used."""

_Edges = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Segments:
    """The superpixels of one frame.

    Attributes:
        labels: [H, W] index of each pixel's superpixel.
        sizes: [S] number of pixels.
        colors: [S, 3] mean Lab colours.
        log_inverse_depth: [S] means.
        static, dynamic: [E, S] evidence of each kind, in pixels.
    """

    labels: Int[np.ndarray, "H W"]
    sizes: Float[np.ndarray, " S"]
    colors: Float[np.ndarray, "S 3"]
    log_inverse_depth: Float[np.ndarray, " S"]
    static: Float[np.ndarray, "E S"]
    dynamic: Float[np.ndarray, "E S"]


def segment(
    lab: UInt8[np.ndarray, "H W 3"],
    inverse_depth: Float[np.ndarray, "H W"],
    static: Float[np.ndarray, "E H W"],
    dynamic: Float[np.ndarray, "E H W"],
) -> Segments:
    """Superpixels (SLIC) of a frame with the evidence on their inner pixels.

    A patch on a border shows both sides, so its evidence is not used: that on the inner pixels counts for all, because
    arms and legs are thin and have few.

    Args:
        lab: [H, W, 3] image in 8-bit Lab.
        inverse_depth: [H, W], positive.
        static, dynamic: [E, H, W] evidence of each kind.
    """
    slic = cv2.ximgproc.createSuperpixelSLIC(cv2.GaussianBlur(lab, (0, 0), 0.8), cv2.ximgproc.SLIC, SIDE, 15.0)
    slic.iterate(5)
    slic.enforceLabelConnectivity(25)
    labels, count = slic.getLabels(), slic.getNumberOfSuperpixels()
    numbers, cross = labels.astype(np.float32), np.ones((3, 3), np.uint8)
    inner = cv2.erode(numbers, cross) == cv2.dilate(numbers, cross)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(labels.ravel(), values.ravel(), count)

    sizes = total(np.ones(labels.shape))
    weights = INNER * sizes / np.maximum(total(inner), MIN_INNER * sizes)
    return Segments(
        labels,
        sizes,
        np.stack([total(lab[..., c]) / sizes for c in range(3)], 1),
        total(np.log(np.maximum(inverse_depth, 1e-6))) / sizes,
        np.stack([weights * total(plane * inner) for plane in static]),
        np.stack([weights * total(plane * inner) for plane in dynamic]),
    )


def _count_pairs(a: np.ndarray, b: np.ndarray, count: int) -> _Edges:
    """The distinct pairs, and how often each occurs."""
    key, times = np.unique(a.astype(np.int64) * count + b, return_counts=True)
    return key // count, key % count, times.astype(np.float64)


def _similarity(colors: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    difference = (colors[i] - colors[j]) * COLOR_WEIGHTS
    return np.exp(-(difference**2).sum(1) / (2.0 * COLOR_SCALE**2))


class Graph:
    """The superpixels of all frames and their connections.

    Attributes:
        starts: [F + 1] index of each frame's first superpixel in the graph.
    """

    def __init__(self, frames: Sequence[Segments], carried: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        """Connects the frames.

        Args:
            frames: Superpixels of each frame.
            carried: For each frame but the last, flat indices of pixels, and their indices in the next frame.
        """
        self.frames = frames
        self.starts = np.cumsum([0, *(len(f.sizes) for f in frames)])
        self._sizes, self._colors, self._depths = (
            np.concatenate(parts)
            for parts in zip(*((f.sizes, f.colors, f.log_inverse_depth) for f in frames), strict=True)
        )
        self._static = np.concatenate([f.static for f in frames], 1)
        self._dynamic = np.concatenate([f.dynamic for f in frames], 1)
        count = int(self.starts[-1])
        edges = [self._edges_within(k) for k in range(len(frames))]
        edges += [self._edges_to_next(k, *pairs) for k, pairs in enumerate(carried)]
        i, j, weights = (np.concatenate(part) for part in zip(*edges, strict=True))
        half = sparse.coo_matrix((weights, (i, j)), shape=(count, count))
        self._weights = (half + half.T).tocsr()
        self._degrees = np.asarray(self._weights.sum(1)).ravel()

    def _edges_within(self, k: int) -> _Edges:
        labels = self.frames[k].labels
        a = np.concatenate([labels[:, :-1].ravel(), labels[:-1].ravel()])
        b = np.concatenate([labels[:, 1:].ravel(), labels[1:].ravel()])
        border = a != b
        low, high = np.minimum(a, b)[border], np.maximum(a, b)[border]
        i, j, length = _count_pairs(low, high, len(self.frames[k].sizes))
        i, j = i + self.starts[k], j + self.starts[k]
        depth_similarity = np.exp(-((self._depths[i] - self._depths[j]) ** 2) / (2.0 * DEPTH_SCALE**2))
        return i, j, length * (_similarity(self._colors, i, j) * depth_similarity + 1e-3)

    def _edges_to_next(self, k: int, pixels: np.ndarray, targets: np.ndarray) -> _Edges:
        a, b = self.frames[k].labels.ravel()[pixels], self.frames[k + 1].labels.ravel()[targets]
        i, j, shared = _count_pairs(a, b, max(len(self.frames[k].sizes), len(self.frames[k + 1].sizes)))
        i, j = i + self.starts[k], j + self.starts[k + 1]
        return i, j, TIME_WEIGHT * shared * _similarity(self._colors, i, j)

    def dynamic_probabilities(self, kind: int) -> list[Float[np.ndarray, "H W"]]:
        """[H, W] probability in [0, 1] that each frame's pixels are dynamic, by one kind of evidence."""
        evidence = self._static[kind], self._dynamic[kind]
        x = self._solve(*evidence, np.zeros_like(self._sizes), np.zeros_like(self._sizes))
        cells = self._cells()
        # Agreement with far frames proves that a surface is static; its absence has other causes than motion, too. So
        # colour may outvote evidence of motion, but not evidence that a superpixel is static.
        unproven = HALVING_EVIDENCE * self._sizes / (evidence[0] + HALVING_EVIDENCE * self._sizes)
        for _ in range(NUM_COLOR_ROUNDS):
            odds = COLOR_TRUST * self._sizes * self._log_odds(cells, x)
            x = self._solve(*evidence, np.maximum(-odds, 0.0), np.maximum(odds, 0.0) * unproven)
        x = x.astype(np.float32)  # a value per pixel of all frames
        return [x[start + frame.labels] for start, frame in zip(self.starts, self.frames, strict=False)]

    def _solve(
        self, static: np.ndarray, dynamic: np.ndarray, more_static: np.ndarray, more_dynamic: np.ndarray
    ) -> np.ndarray:
        static = TRUST * static + PRIOR * self._sizes + more_static
        dynamic = TRUST * dynamic + more_dynamic
        diagonal = static + dynamic + self._degrees + 1e-9  # a superpixel without evidence and edges is static
        matrix = (sparse.diags(diagonal) - self._weights).tocsr()
        x, _ = cg(matrix, dynamic, rtol=1e-3, maxiter=300, M=sparse.diags(1.0 / diagonal))
        return x

    def _cells(self) -> tuple[np.ndarray, ...]:
        """The superpixels' bins in the colour histograms."""
        ranks = [np.searchsorted(np.sort(axis[::7]), axis) / len(axis[::7]) for axis in self._colors.T]
        return tuple(np.clip((BINS * rank).astype(int), 0, BINS - 1) for rank in ranks)

    def _log_odds(self, cells: tuple[np.ndarray, ...], x: np.ndarray) -> np.ndarray:
        """[S] log odds that superpixels of a superpixel's colour are dynamic."""
        counts = []
        for certain in (np.clip((x - 0.45) * 4.0, 0.0, 1.0), np.clip((0.45 - x) * 4.0, 0.0, 1.0)):
            histogram = np.zeros((BINS,) * 3)
            np.add.at(histogram, cells, certain * self._sizes)
            counts.append(gaussian_filter(histogram, 1.0, mode="nearest")[cells] + 5.0)
        return np.clip(np.log(counts[0] / counts[1]), -MAX_LOG_ODDS, MAX_LOG_ODDS)
