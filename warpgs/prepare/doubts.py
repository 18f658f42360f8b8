"""What may be wrong with the cameras and masks that a preparation has found, one sentence each."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from .cameras.posed_frames import PosedFrames
from .cameras.recovered import PLAUSIBLE_FOCAL, Cameras
from .cameras.triangulation import triangulate
from .depth.flow import MAX_RESIDUAL
from .frames.flow import Flows
from .frames.images import brighten
from .frames.parallel import map_frames

DOUBTFUL_FRACTION = 0.4
"""Fraction of dynamic pixels above which the masks are probably wrong."""

CROWDED_FRACTION, MANY_FRAMES = 0.3, 0.25
"""Fraction of dynamic pixels in a frame, and of such frames, from which on estimated masks are rarely right
(docs/design/motion-masks.md)."""

MIN_OFF, MIN_CONFIRMED = 0.01, 0.2
"""Fraction of the pixels that do not move with the background, from which on it says something, and fraction of them
that masks hold at least where cameras are right. Static foreground does not move with the background either."""

NUM_CHECKED, MIN_FITTING = 16, 0.5
"""Number of frames whose optical flow is compared with the cameras, and fraction of the pixels that it follows in
nearly every frame that right cameras explain (docs/design/motion-masks.md)."""

NOTHING_MOVES = (
    "nothing seems to move: objects of one flat colour are not found; give masks (--masks FOLDER) or a network "
    "(--masks sam2)"
)

Planes = Sequence[Bool[np.ndarray, "H W"]]


def doubts_of_masks(dynamic: Planes, estimated: bool, off: Planes | None = None) -> list[str]:
    """Doubts about dynamic masks.

    Args:
        dynamic: [H, W] dynamic mask of each frame.
        estimated: Whether they are estimates.
        off: [H, W] what does not move with the background of each frame (``masks.background``); None if unknown.
    """
    fractions = np.array([mask.mean() for mask in dynamic])
    mean, crowded = float(fractions.mean()), int((fractions > CROWDED_FRACTION).sum())
    if mean > DOUBTFUL_FRACTION:
        return [f"according to the masks, {mean:.0%} of the pixels move: look at masks.png"]
    if not estimated:
        return []
    if mean == 0.0:
        return [NOTHING_MOVES]
    found = []
    if crowded >= MANY_FRAMES * len(dynamic):
        found.append(
            f"according to the masks, more than {CROWDED_FRACTION:.0%} of the pixels move in {crowded} of "
            f"{len(dynamic)} frames: look at masks.png"
        )
    if off is not None:
        num_off = sum(int(plane.sum()) for plane in off)
        both = sum(int((plane & mask).sum()) for plane, mask in zip(off, dynamic, strict=True))
        if num_off > MIN_OFF * sum(plane.size for plane in off) and both < MIN_CONFIRMED * num_off:
            found.append(
                f"the masks hold only {both / num_off:.0%} of what does not move with the background: the rest is "
                "static foreground, or cameras were found that follow it; look at masks.png"
            )
    return found


def doubts_of_motion(frames: PosedFrames, quiet: bool = True) -> list[str]:
    """Doubts about cameras that the optical flow between neighbouring frames does not confirm.

    Args:
        frames: The frames, of half the working size.
        quiet: Whether to show no progress.
    """
    flows = Flows(brighten(frames.images), frames.expected_flow)

    def fitting(frame: int) -> float:
        residual = triangulate(frames.observations(frame, flows), frames.focal).residual
        return float((residual < MAX_RESIDUAL).sum() / max(1, (~np.isnan(residual)).sum()))

    checked = np.unique(np.linspace(0, len(frames.poses) - 1, NUM_CHECKED).round().astype(int)).tolist()
    num_bad = sum(fraction < MIN_FITTING for fraction in map_frames(fitting, checked, "check of the cameras", quiet))
    if num_bad < MANY_FRAMES * len(checked):
        return []
    return [
        f"in {num_bad} of {len(checked)} frames that were compared with their neighbours, the cameras explain less "
        "than half of the motion: they may be wrong, or most of the image moves; look at masks.png"
    ]


def doubts_of_lens(cameras: Cameras) -> list[str]:
    """Doubts about a focal length that was found."""
    lens, (least, most) = cameras.lens, PLAUSIBLE_FOCAL
    ratio = max(lens.focal) / max(lens.width, lens.height)
    if cameras.has_held_focal:
        return [
            f"the focal length is a guess, {ratio:.1f} times the longer side of the frames: the one that was found is "
            "not plausible and explains less of them; give it (--focal PX)"
        ]
    if lens.model == "fisheye" or least <= ratio <= most:
        return []
    return [
        f"the focal length that was found is {ratio:.1f} times the longer side of the frames, which few lenses have: "
        "the cameras may be wrong; give it (--focal PX)"
    ]
