"""What a strategy of density control is: it decides where Gaussians are added and removed."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import DensifyConfig, RenderSettings
from warpgs.model.splats import Splats
from warpgs.runtime import ranks
from warpgs.training.schedule import Action

from .adaptation import Adaptation
from .opacity_reset import reset
from .operations import shorten_needles
from .prune import prune, prune_weakest
from .reseed import require_branches, reseed


class Strategy:
    """Density control. It gathers statistics of each Gaussian, static ones first; here, how large pixels are.

    Args:
        config: The options ``--densify.*``.

    Attributes:
        actions: What it does for each action of a plan; it does nothing for actions that are not there.
        screen_offsets: [N, 2] zeros to render each view with while ``Phase.densifies``, if their gradients are needed.
        resolution: [N] pixels per scene unit at the depth of the Gaussian, in the nearest view that has shown it since
            ``begin``; 0 if none has.
    """

    screen_offsets: Float[Tensor, "N 2"] | None = None

    def __init__(self, config: DensifyConfig) -> None:
        self.config = config
        self.actions: dict[Action, Callable[[Adaptation], None]] = {
            "densify": self.densify,
            "prune": prune,
            "reseed": reseed,
            "prune_weakest": prune_weakest,
            "shorten": self.shorten,
            "reset": reset,
        }

    def begin(self, num: int, device: torch.device) -> None:
        """Starts to observe N Gaussians: at first, and whenever Gaussians were replaced. All is forgotten."""
        self.resolution = torch.zeros(num, dtype=torch.float32, device=device)

    def settings(self, settings: RenderSettings) -> RenderSettings:
        """How a step is rendered while ``Phase.densifies``, from how it would be without the strategy."""
        return settings

    @torch.no_grad()
    def observe(self, splats: Splats, camera: Camera, radii: Int32[Tensor, "N 2"]) -> None:
        """Looks at one view after its backward pass; on CUDA captured in a graph with the rest of the step.

        Args:
            splats: The activated Gaussians at the time of the view.
            camera: Its camera.
            radii: [N, 2] ``Rendering.radii``; 0 = culled.
        """
        shown = torch.where(radii[:, 0] > 0, camera.focal / camera.depths(splats.means), 0.0)
        torch.maximum(self.resolution, shown, out=self.resolution)

    def state(self) -> dict[str, Float[Tensor, " N"]]:
        """What was observed, by name: checkpoints keep it, and resuming fills it. Finite and never negative."""
        return {"resolution": self.resolution}

    def merge(self) -> None:
        """Moves what all ranks have observed to rank 0, sums but for the resolution; the others have zeros then."""
        for name, tensor in self.state().items():
            ranks.move_to_first_(tensor, "maximum" if name == "resolution" else "sum")

    def units(self, at: Adaptation) -> Float[Tensor, " N"]:
        """``DensifyConfig.unit`` of each Gaussian [scene units]; infinite for those that no view has shown."""
        if at.config.densify.unit == "extent":
            return torch.full_like(self.resolution, at.capture.extent)
        return 1.0 / self.resolution

    def shorten(self, at: Adaptation) -> None:
        """Shortens the needles of the static branch."""
        static, config = at.scene.static, at.config.densify
        shorten_needles(static, config.max_elongation, config.max_size * self.units(at)[: len(static)])

    def densify(self, at: Adaptation) -> None:
        """Changes the numbers of Gaussians; both branches together grow by at most ``at.capacity``."""
        raise NotImplementedError

    def adapt(self, at: Adaptation) -> None:
        """Does the actions of a plan, in their order; on rank 0.

        A dynamic branch that has lost its last Gaussian gets new ones at once.

        Raises:
            ValueError: If a branch that is needed has lost its last Gaussian all the same.
        """
        before = len(at.scene.static), len(at.scene.dynamic)
        for action in at.plan.actions:
            if action in self.actions:
                self.actions[action](at)
        if before[1] > 0 == len(at.scene.dynamic):
            reseed(at)
        if lost := require_branches(before, at.scene, at.views, at.config):
            at.log(f"warning: {lost}")
