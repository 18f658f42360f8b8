"""Dynamic masks from motion, without a network: dynamic is what the motion of the camera does not explain.

Every frame is triangulated from its neighbours (``triangulation``) and compared with far frames (``revisits``). The
evidence found on textured pixels spreads over superpixels of all frames (``segments``), and GrabCut finds the outline.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from ..cameras.posed_frames import PosedFrames
from ..cameras.triangulation import fill_unknown
from ..frames.flow import Flows
from ..frames.images import brighten
from ..frames.parallel import map_frames
from .revisits import MIN_GAPS, NUM_AGREEING, Evidence, Revisits
from .segments import Graph, Segments, segment

MIN_REGION = 0.002
"""Minimum size of a dynamic region, as a fraction of the image; smaller ones are noise."""

MIN_HOLE = 0.003
"""Size below which a hole in a dynamic region is filled, as a fraction of the image."""

CERTAIN, LIKELY, POSSIBLE = 0.65, 0.5, 0.15
"""Dynamic probabilities above which GrabCut keeps the foreground, and starts from probable foreground and background.
It takes away what is only likely if the background has its colour somewhere, such as fingers before a wall, beside a
wooden door (docs/design/motion-masks.md)."""

BLUR = 2.0
"""Standard deviation of the blur that removes the steps between superpixels [px]; fingers are 10 px wide."""

MIN_CERTAIN = 0.2
"""Fraction of a region that must seem to move beside the nearer far frames, too."""

MIN_ADDED = 0.05
"""What they add to the masks, as a fraction of the masks, from which on it is outlined and added."""

GRABCUT_ROUNDS = 1
"""A second round takes a quarter to two thirds more time and changes the intersection over union by at most 0.003."""

FOREGROUND, NUM_CLUSTERS = (cv2.GC_FGD, cv2.GC_PR_FGD), 5
"""Labels of the foreground, and colour clusters of GrabCut. They start from every fourth pixel, which takes a third of
GrabCut's time away and changes the intersection over union by at most 0.003."""

UNKNOWN_RESIDUAL = 1.5
"""Residual assumed where it is unknown [px]: in favour of motion, but not certain."""

LOCAL_TOLERANCE = 0.5
"""Residual of the neighbours of a static surface [px]; slow objects have little more."""

MIN_NOISE, NUM_NOISES = 0.4, 3.0
"""Minimum of a frame's noise, which is its median residual [px], and how many times the noise a residual may be by
chance; from twice that on, it is certain evidence of motion."""

PATCH, GRADIENT_NOISE = 9, 0.3
"""Side of the patches whose directions of texture are compared [px]; noise of gradients [levels per px]."""

TEXTURE, STRONG_TEXTURE = (0.8, 2.3), (2.0, 5.0)
"""Slopes of lightness from which on texture counts, and in full; the second for evidence of motion on pixels that are
found nowhere, as of blurred asphalt [levels per px]."""

MIN_ISOTROPY, FULL_ISOTROPY = 0.1, 0.5
"""Texture across a patch's main direction over that along it, from which on evidence of motion counts, and in full."""

OWN_VOTE, VOTES = 1.5, (1.0, 0.8, 0.6)
"""Weight of a frame's own mask, and of the masks one, two and three frames away in both directions."""

Carried = tuple[np.ndarray, np.ndarray]
"""Flat indices of pixels, and their flat indices in the next frame."""


@dataclass(frozen=True)
class _Finder:
    flows: Flows
    labs: list[np.ndarray]
    revisits: Revisits

    def find(self, frame: int) -> tuple[Segments, Carried | None]:
        """A frame's superpixels with the evidence on them, and where its pixels are in the next frame."""
        has_next = frame + 1 < len(self.labs)
        carried = self._carried(frame, frame + 1 if has_next else frame - 1)
        followed = np.zeros(self.labs[frame].shape[:2], bool)
        followed.ravel()[carried[0]] = True
        segments = gather(self.labs[frame], self.revisits.evidence(frame), followed)
        self.flows.release(frame)
        return segments, carried if has_next else None

    def _carried(self, frame: int, other: int) -> Carried:
        """The pixels that flow carries to another frame, and their indices there."""
        column, row, visible = self.flows.track(frame, other)
        height, width = self.labs[frame].shape[:2]
        across, down = width / column.shape[1], height / column.shape[0]
        # Interpolated, at pixel centres of the larger size.
        column = (cv2.resize(column, (width, height)) + 0.5) * across - 0.5
        row = (cv2.resize(row, (width, height)) + 0.5) * down - 0.5
        column, row = column.round().astype(np.int64), row.round().astype(np.int64)
        visible = cv2.resize(visible.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
        visible = visible & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixels = visible.ravel().nonzero()[0]
        return pixels.astype(np.int32), (row * width + column).ravel()[pixels].astype(np.int32)


def gather(lab: UInt8[np.ndarray, "H W 3"], evidence: Evidence, followed: Bool[np.ndarray, "H W"]) -> Segments:
    """The superpixels of a frame with the evidence on its textured pixels.

    Args:
        lab: [H, W, 3] image in 8-bit Lab.
        evidence: Evidence on its pixels, at this size or a smaller one.
        followed: [H, W] whether optical flow finds a pixel in the next frame.
    """
    dx, dy = _gradients(lab)
    texture = _texture(dx, dy, *TEXTURE)
    residual = np.nan_to_num(evidence.residual, nan=UNKNOWN_RESIDUAL)
    size = lab.shape[1::-1]
    contradiction = _contradiction(evidence.residual)
    # Where neither the neighbours nor the next frame show a pixel, blur and grain are as likely as motion.
    lost = cv2.resize(np.isnan(evidence.residual).astype(np.float32), size) * ~followed
    motion_texture = texture + lost * (_texture(dx, dy, *STRONG_TEXTURE) - texture)
    # Along an edge or a stripe, flow is a guess: it may contradict the cameras, but not show motion.
    motion_texture *= _isotropy(dx, dy)
    static, dynamic = [], []
    for agreement, witnesses in evidence.agreements:
        seen = witnesses >= NUM_AGREEING
        # A dynamic object also contradicts the neighbours; where they fit well, a mismatch far away is doubtful.
        doubt = (1.0 - agreement) * seen * np.clip(residual - 0.5, 0.15, 1.0)
        # Where no far frame looks, the neighbours alone decide: better than the colours of other places.
        fits = np.where(seen, agreement, np.exp(-((residual / LOCAL_TOLERANCE) ** 2))) * (1.0 - contradiction)
        static.append(texture * cv2.resize(fits, size))
        dynamic.append(motion_texture * cv2.resize(np.maximum(doubt, contradiction), size))
    inverse_depth = cv2.resize(fill_unknown(evidence.inverse_depth), size)
    return segment(lab, inverse_depth, np.array(static), np.array(dynamic))


def _contradiction(residual: np.ndarray) -> Float[np.ndarray, "H W"]:
    """[H, W] in [0, 1], how far residuals exceed the frame's noise; 0 where they are unknown."""
    known = residual[~np.isnan(residual)]
    noise = max(MIN_NOISE, float(np.median(known))) if known.size else MIN_NOISE
    return np.clip(np.nan_to_num(residual) / (NUM_NOISES * noise) - 1.0, 0.0, 1.0)


def _gradients(lab: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] slopes of lightness along x and y [levels per px]."""
    lightness = cv2.GaussianBlur(lab[..., 0], (0, 0), 1.0).astype(np.float32)
    return cv2.Sobel(lightness, -1, 1, 0) / 8.0, cv2.Sobel(lightness, -1, 0, 1) / 8.0


def _texture(dx: np.ndarray, dy: np.ndarray, least: float, full: float) -> Float[np.ndarray, "H W"]:
    """[H, W] in [0, 1], whether a pixel has enough texture to be recognized."""
    return np.clip((np.hypot(dx, dy) - least) / (full - least), 0.0, 1.0)


def _isotropy(dx: np.ndarray, dy: np.ndarray) -> Float[np.ndarray, "H W"]:
    """[H, W] in [0, 1], whether the texture around a pixel fixes its position in both directions.

    From the eigenvalues of the structure tensor (Förstner and Gülch 1987), as a ratio: contrast does not matter.
    """
    xx, yy, xy = (cv2.blur(plane, (PATCH, PATCH)) for plane in (dx * dx, dy * dy, dx * dy))
    mean, spread = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
    ratio = np.sqrt(np.maximum(mean - spread, 0.0) / (mean + spread + GRADIENT_NOISE**2))
    return np.clip((ratio - MIN_ISOTROPY) / (FULL_ISOTROPY - MIN_ISOTROPY), 0.0, 1.0)


def find_dynamic(frames: PosedFrames, quiet: bool = True) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] true where each frame, of working size, is dynamic."""
    images, indices = brighten(frames.images), range(len(frames.images))
    small = frames.halved  # flow tells no more at full size
    flows = Flows(brighten(small.images), small.expected_flow)
    labs = [cv2.cvtColor(image, cv2.COLOR_RGB2LAB) for image in images]
    found = map_frames(_Finder(flows, labs, Revisits(small, flows)).find, indices, "motion", quiet)
    segments, carried = [s for s, _ in found], [c for _, c in found if c is not None]
    graph = Graph(segments, carried)

    def outlined(probabilities: Sequence[np.ndarray]) -> list[Bool[np.ndarray, "H W"]]:
        outlines = map_frames(lambda k: outline(images[k], probabilities[k]), indices, "outlines", quiet)
        return [clean(mask) for mask in vote(outlines, carried)]

    farther, nearer = (graph.dynamic_probabilities(k) for k in range(len(MIN_GAPS)))
    certain = [smooth(p) > LIKELY for p in nearer]
    masks = outlined(farther)
    added = sum(int((c & ~m).sum()) for c, m in zip(certain, masks, strict=True))
    masks = confirmed(masks, certain, carried)
    if added > MIN_ADDED * sum(int(m.sum()) for m in masks):
        masks = [a | b for a, b in zip(masks, outlined(nearer), strict=True)]
    return masks


def confirmed(
    masks: Sequence[Bool[np.ndarray, "H W"]], certain: Sequence[Bool[np.ndarray, "H W"]], carried: Sequence[Carried]
) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] the masks without the objects of which too little is certain, over all frames together.

    Args:
        masks, certain: [H, W] of each frame.
        carried: As for ``vote``. Two regions are one object if flow carries half of the larger one into the other.
    """
    counts, labels = zip(*(cv2.connectedComponents(mask.astype(np.uint8)) for mask in masks), strict=True)
    starts = np.cumsum([0, *counts])
    sizes = np.concatenate([np.bincount(a.ravel(), minlength=n) for a, n in zip(labels, counts, strict=True)])
    num_certain = np.concatenate(
        [np.bincount(a.ravel(), c.ravel(), n) for a, c, n in zip(labels, certain, counts, strict=True)]
    )
    links = []
    for k, (pixels, targets) in enumerate(carried):
        i, j = labels[k].ravel()[pixels], labels[k + 1].ravel()[targets]
        both = (i > 0) & (j > 0)
        pairs, shared = np.unique(np.stack([i[both] + starts[k], j[both] + starts[k + 1]]), axis=1, return_counts=True)
        links.append(pairs[:, shared > 0.5 * sizes[pairs].max(0)])
    i, j = np.concatenate([np.zeros((2, 0), np.int64), *links], 1)
    graph = sparse.coo_matrix((np.ones(len(i)), (i, j)), (starts[-1], starts[-1]))
    count, objects = connected_components(graph, directed=False)
    kept = np.bincount(objects, num_certain, count) > MIN_CERTAIN * np.bincount(objects, sizes, count)
    kept = kept[objects]
    return [mask & kept[start + a] for mask, start, a in zip(masks, starts, labels, strict=False)]


def vote(masks: Sequence[Bool[np.ndarray, "H W"]], carried: Sequence[Carried]) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] the majority over each pixel's own mask and those of three frames in both directions, along the flow.

    Args:
        masks: [H, W] of each frame.
        carried: For each frame but the last, flat indices of pixels, and their indices in the next frame.
    """
    shape, size = masks[0].shape, masks[0].size
    votes = [np.where(mask.ravel(), OWN_VOTE, -OWN_VOTE) for mask in masks]
    for forward in (True, False):
        steps = []
        for pixels, targets in carried:
            step = np.full(size + 1, size)  # one more index, for lost pixels
            step[pixels if forward else targets] = targets if forward else pixels
            steps.append(step)
        for k in range(len(masks)):
            position, other = np.arange(size), k
            for weight in VOTES:
                if not 0 <= (other if forward else other - 1) < len(steps):
                    break
                position = steps[other if forward else other - 1][position]
                other += 1 if forward else -1
                opinion = np.where(np.append(masks[other].ravel(), False)[position], weight, -weight)
                votes[k] += np.where(position < size, opinion, 0.0)
    return [(v > 0).reshape(shape) for v in votes]


def outline(image: UInt8[np.ndarray, "H W 3"], probability: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """[H, W] the dynamic region of an image, outlined by GrabCut.

    Args:
        image: [H, W, 3].
        probability: [H, W] in [0, 1] that a pixel is dynamic.
    """
    probability = smooth(probability)
    likely = probability > LIKELY
    if not likely.any() or likely.all():
        return likely
    labels = np.full(probability.shape, cv2.GC_BGD, np.uint8)
    for threshold, label in ((POSSIBLE, cv2.GC_PR_BGD), (LIKELY, cv2.GC_PR_FGD), (CERTAIN, cv2.GC_FGD)):
        labels[probability > threshold] = label
    cv2.setRNGSeed(0)  # GrabCut initializes its colour clusters at random
    models = np.zeros((1, 65)), np.zeros((1, 65))
    some = np.ascontiguousarray(image[::2, ::2]), np.ascontiguousarray(labels[::2, ::2])
    if min(np.isin(some[1], FOREGROUND).sum(), np.isin(some[1], FOREGROUND, invert=True).sum()) < NUM_CLUSTERS:
        some = image, labels.copy()
    cv2.grabCut(*some, None, *models, 0, cv2.GC_INIT_WITH_MASK)
    cv2.grabCut(image, labels, None, *models, GRABCUT_ROUNDS, cv2.GC_EVAL)
    dynamic = np.isin(labels, FOREGROUND)
    # An object with the colours of the background vanishes: then the evidence alone decides.
    return likely if dynamic.sum() < 0.5 * likely.sum() else dynamic


def smooth(probability: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """[H, W] the probability without the steps between superpixels."""
    return cv2.GaussianBlur(probability.astype(np.float32), (0, 0), BLUR)


def clean(dynamic: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """[H, W] the region without small parts and holes."""
    dynamic = _remove_small(dynamic, MIN_REGION * dynamic.size)
    return ~_remove_small(~dynamic, MIN_HOLE * dynamic.size)


def _remove_small(region: np.ndarray, min_area: float) -> np.ndarray:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= min_area
    large[0] = False
    return large[labels]
