"""What training starts from, and the form of the remedies for what a capture lacks."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from warpgs.config import Plan
from warpgs.data.capture import Capture
from warpgs.model.scene import SplitScene
from warpgs.runtime.random_numbers import random_numbers
from warpgs.views.views import Views

from .alignment import DepthTrust
from .initialize import initial_scene
from .sky import Sky


@dataclass(frozen=True)
class Start:
    """What training starts from.

    Attributes:
        plan: What runs.
        capture: The capture, with the masks and background that the plan implies.
        views: Its training views; remedies change their depth and the trust in their masks in place.
        scene: The initial scene.
        alignments: [T, 2] scale and offset of each view's inverse depth; NaN where it is unknown or not trusted.
        trust: How much each view's depth is trusted.
        resumed: Whether the plan is that of a run that was begun before: it stays as it is then.
        depth_error: Typical relative error of depth at the sparse points, aligned by a scale and an offset alone; 0 if
            none could be aligned.
        num_aligned: Number of views whose depth could be aligned to the sparse points.
        num_with_objects: Number of views in which the size of dynamic objects gives or corrects their depth.
        notes: A sentence of each remedy on what it found or changed.
        sky: Where frames show the sky, if that is the background and depth tells it.
    """

    plan: Plan
    capture: Capture
    views: Views
    scene: SplitScene
    alignments: Float[Tensor, "T 2"]
    trust: DepthTrust
    resumed: bool
    depth_error: float = 0.0
    num_aligned: int = 0
    num_with_objects: int = 0
    notes: tuple[str, ...] = ()
    sky: Sky | None = None

    @property
    def has_depth(self) -> bool:
        """Whether any view has depth to compare."""
        return self.num_aligned + self.num_with_objects > 0

    def planned(self, plan: Plan) -> "Start":
        """The same with another plan, and the initial scene that it implies."""
        return replace(self, plan=plan, scene=first_scene(plan, self.capture, self.views, self.sky))

    def noted(self, *notes: str) -> "Start":
        """The same, with more notes."""
        return replace(self, notes=(*self.notes, *notes))


def first_scene(plan: Plan, capture: Capture, views: Views, sky: Sky | None) -> SplitScene:
    """The initial scene of a plan."""
    return initial_scene(plan, capture, views, random_numbers(plan.seed, "points", 0, 0), sky)


class Remedy(NamedTuple):
    """A remedy for what a capture lacks.

    Attributes:
        applies: Whether it is asked for and of use.
        apply: The start after it.
    """

    applies: Callable[[Start], bool]
    apply: Callable[[Start], Start]
