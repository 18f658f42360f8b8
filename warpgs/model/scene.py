"""The scene of the paper: static Gaussians whose appearance changes, dynamic Gaussians that are deformed (Eq. 5)."""

import copy
import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from warpgs.cameras import Camera
from warpgs.config import ModelConfig
from warpgs.ops.activation import Changes, activate, join_sh
from warpgs.runtime.streams import concurrently

from . import segments
from .dome import Dome
from .fields import make_deformation
from .gaussians import Gaussians
from .reflections import Light, reflections
from .segmented_deformation import SegmentedDeformation
from .splats import Splats
from .trunk import Trunk


class AppearanceField(nn.Module):
    """MLP_app of paper Eq. 8b: position and time → residuals of SH coefficients and of the opacity's logit."""

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        changes_all = config.appearance == "all"
        self.bases = (config.sh_degree + 1) ** 2 if changes_all else 1
        depth, width = config.appearance_size or (config.depth, config.width)
        # One network for all segments: its frequencies are those that one segment has.
        bands = config.time_bands + math.ceil(math.log2(config.segments or 1))
        config = dataclasses.replace(config, depth=depth, width=width, time_bands=bands)
        outputs = (3 * self.bases, 1) if changes_all else (3 * self.bases,)
        self.trunk = Trunk(config, center, half_size, outputs)

    def forward(
        self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"], is_fixed: Bool[Tensor, " N"] | None = None
    ) -> tuple[Float[Tensor, "N bases 3"], Float[Tensor, " N"] | None]:
        """Residuals at N positions and one time in [0, 1]; no gradient flows from those that are fixed.

        Returns:
            [N, bases, 3] residuals of the SH coefficients of the lowest degrees, and [N] residuals of the opacities'
            logits, or None if the network does not change opacities.
        """
        residuals, *logits = self.trunk(means, time)
        if is_fixed is not None:
            residuals, *logits = (torch.where(is_fixed[:, None], r.detach(), r) for r in (residuals, *logits))
        return residuals.unflatten(1, (self.bases, 3)), logits[0][:, 0] if logits else None


class PointsInTime(NamedTuple):
    """Arguments of a deformation model.

    Attributes:
        means: [N, 3] canonical positions [scene units].
        times: [N] times in [0, 1], or [1] of all.
    """

    means: Float[Tensor, "N 3"]
    times: Float[Tensor, " T"]


class InTraining(NamedTuple):
    """What a training step alone asks of a scene.

    Attributes:
        is_hidden: [num_static] static Gaussians from which the appearance network gets no gradient; none if None.
        points: Other points that the deformation moves in the same evaluation. Its kernels are so many and so small
            that a second one takes longer than more rows in the first; None without.
        choice: What is seen in overlaps of segments, as of ``segments.weights``.
    """

    is_hidden: Bool[Tensor, " num_static"] | None = None
    points: PointsInTime | None = None
    choice: Float[Tensor, "1"] | None = None


class SplitScene(nn.Module):
    """G_s ∪ G_d with their networks (paper Eq. 5).

    Args:
        static, dynamic: The Gaussians of the two branches.
        config: Which networks, and their sizes.
        center, half_size: [3] box of the scene, by which the networks normalize positions.
        dome: The sky; None without.

    Attributes:
        static: Gaussians of constant geometry; w⁰ of Eq. 8 is their own appearance.
        dynamic: Gaussians in canonical space, of constant appearance.
        deformation: F_θ of Eq. 10.
        appearance: MLP_app of Eq. 8.
        light: What the dynamic Gaussians reflect; None if they reflect nothing.
        dome: The sky behind all Gaussians; None if a colour is behind them.

    Raises:
        ValueError: If there is no deformation model of the configured name.
    """

    def __init__(
        self,
        static: Gaussians,
        dynamic: Gaussians,
        config: ModelConfig,
        center: Float[Tensor, "3"],
        half_size: Float[Tensor, "3"],
        dome: Dome | None = None,
    ) -> None:
        super().__init__()
        self.static, self.dome = static, dome
        self.deformation = make_deformation(config, center, half_size)
        self.appearance = AppearanceField(config, center, half_size)
        self.sh_degree, self.light = config.sh_degree, Light(center) if config.reflections else None
        self.num_segments = config.segments or 1
        self._rows: tuple[Tensor, segments.SegmentRows] | None = None
        self.set_dynamic(dynamic)

    def set_dynamic(self, dynamic: Gaussians) -> None:
        """Replaces the dynamic Gaussians by others, which reflect as the scene does; without segments, all get 0."""
        if self.light is not None and dynamic.reflectances is None:
            dynamic.reflectances = nn.Parameter(dynamic.means.new_zeros(len(dynamic), self.light.size))
        if self.num_segments > 1 and dynamic.segments is None:
            dynamic.segments = torch.zeros(len(dynamic), dtype=torch.int64, device=dynamic.means.device)
        self.dynamic = dynamic

    @staticmethod
    def empty(num_static: int, num_dynamic: int, config: ModelConfig, has_dome: bool = False) -> "SplitScene":
        """A scene with arbitrary values, to load a checkpoint into."""
        static, dynamic = (Gaussians.empty(num, config.sh_degree) for num in (num_static, num_dynamic))
        center, half_size = torch.zeros(3, dtype=torch.float32), torch.ones(3, dtype=torch.float32)
        return SplitScene(static, dynamic, config, center, half_size, Dome() if has_dome else None)

    def select(self, static: Bool[Tensor, " S"], dynamic: Bool[Tensor, " D"]) -> "SplitScene":
        """A scene of copies of the Gaussians to keep, with the same networks."""
        return self.with_modules(static=self.static.select(static), dynamic=self.dynamic.select(dynamic))

    def with_modules(self, **modules: nn.Module) -> "SplitScene":
        """The same scene with other Gaussians or networks in place of those of the same name."""
        changed = copy.copy(self)
        changed._modules = {**self._modules, **modules}
        return changed

    def splats(
        self,
        time: Float[Tensor, "1"],
        use_deformation: bool = True,
        use_appearance: bool = True,
        sh_degree: int | None = None,
        time_noise: Float[Tensor, " T"] | None = None,
    ) -> Splats:
        """The activated Gaussians at a time, static ones first.

        Args:
            time: Time in [0, 1].
            use_deformation: Whether the deformation network deforms the dynamic Gaussians (paper Eq. 11).
            use_appearance: Whether the appearance network changes the static ones (paper Eq. 8).
            sh_degree: Maximum degree of spherical harmonics to use; all if None. Reflections need all.
            time_noise: Added to the time that the deformation network sees, one number or [D] of each dynamic Gaussian
                (annealed smoothing of Deformable-3DGS, ``with_delays``).
        """
        return self.splats_in_training(InTraining(), time, use_deformation, use_appearance, sh_degree, time_noise)[0]

    def splats_in_training(
        self,
        training: InTraining,
        time: Float[Tensor, "1"],
        use_deformation: bool,
        use_appearance: bool,
        sh_degree: int | None,
        time_noise: Float[Tensor, " T"] | None,
    ) -> tuple[Splats, Float[Tensor, "M 3"] | None]:
        """``splats``, and the positions of the points of ``training``, deformed; None without any or a deformation."""
        static, dynamic, device = self.static, self.dynamic, self.static.means.device
        residuals = logit_residuals = offsets = others = None
        is_hidden, points, choice = training
        with concurrently(device) as beside:
            with beside:
                if use_appearance and len(static):
                    residuals, logit_residuals = self.appearance(static.means, time, is_hidden)
                sh = join_sh(static.raw(), dynamic.raw(), residuals)
            if use_deformation and len(dynamic):
                own = PointsInTime(dynamic.means, time if time_noise is None else time + time_noise)
                offsets, others = self._offsets(own, points, time)
        static_changes, dynamic_changes = Changes(logit_residuals=logit_residuals), Changes(offsets)
        geometry = activate(static.raw(), dynamic.raw(), static_changes, dynamic_changes)
        geometry = geometry._replace(opacities=self._faded(geometry.opacities, time, choice))
        is_dynamic = torch.arange(len(static) + len(dynamic), device=device) >= len(static)
        splats = Splats(**geometry._asdict(), sh=sh, is_dynamic=is_dynamic, sh_degree=sh_degree)
        return self._reflecting(splats), others

    def _reflecting(self, splats: Splats) -> Splats:
        """The splats with what the dynamic ones reflect, once all degrees of spherical harmonics are in use."""
        dynamic, sh_degree = self.dynamic, splats.sh_degree
        if self.light is None or dynamic.reflectances is None or sh_degree not in (None, self.sh_degree):
            return splats
        quats = splats.quats[len(self.static) :]
        reflected = reflections(self.light, dynamic.log_scales, quats, dynamic.reflectances)
        return dataclasses.replace(splats, reflections=reflected)

    def _offsets(
        self, own: PointsInTime, others: PointsInTime | None, time: Float[Tensor, "1"]
    ) -> tuple[Tensor, Tensor | None]:
        """Offsets of the dynamic Gaussians, and positions of other points, if any, around a time, both deformed."""
        if self.num_segments > 1:
            offsets = self.deformation(*own, time, self.rows())
            return offsets, None if others is None else others.means + self.around(time)[1](*others)[:, :3]
        if others is None:
            return self.deformation(*own), None
        sizes = [len(own.means), len(others.means)]
        times = torch.cat([own.times.expand(sizes[0]), others.times])
        offsets, of_others = self.deformation(torch.cat([own.means, others.means]), times).split(sizes)
        return offsets, others.means + of_others[:, :3]

    def offsets(self, time: Float[Tensor, "1"], noise: Float[Tensor, " T"] | None = None) -> Float[Tensor, "D 10"]:
        """Offsets of the dynamic Gaussians at a time; one number or [D] of noise is added to it for the network."""
        return self._offsets(PointsInTime(self.dynamic.means, time if noise is None else time + noise), None, time)[0]

    def _faded(
        self, opacities: Float[Tensor, " N"], time: Float[Tensor, "1"], choice: Float[Tensor, "1"] | None
    ) -> Float[Tensor, " N"]:
        """Opacities, of which those of the dynamic Gaussians are 0 outside of their segments, if they have any."""
        dynamic = self.dynamic
        if dynamic.segments is None:
            return opacities
        weights = segments.weights(time, self.num_segments, choice).index_select(0, dynamic.segments)
        return torch.cat([opacities[: len(self.static)], segments.faded(dynamic.logit_opacities, weights)])

    def rows(self) -> segments.SegmentRows:
        """The dynamic Gaussians by segment; reads back from the device when they were replaced."""
        found = self.dynamic.segments
        assert found is not None
        if self._rows is None or self._rows[0] is not found:
            self._rows = found, segments.rows_by_segment(found, self.num_segments)
        return self._rows[1]

    def around(self, time: Float[Tensor, "1"]) -> tuple[Float[Tensor, "N 3"], Callable[[Tensor, Tensor], Tensor]]:
        """Canonical positions of the dynamic Gaussians at a time, and a function as of ``fields.FIELDS`` for them.

        Of several segments it is the one with the largest weight, in which some positions may be there more than once.
        """
        means = self.dynamic.means.detach()
        if not isinstance(self.deformation, SegmentedDeformation):
            return means, self.deformation
        segment = segments.nearest(time, self.num_segments)
        if len(means):
            means = means.index_select(0, self.rows().rows.index_select(0, segment)[0])
        return means, partial(self.deformation.at, segment)

    @torch.no_grad()
    def with_delays(
        self, camera: Camera, time: Float[Tensor, "1"], noise: Float[Tensor, "1"] | None = None
    ) -> Float[Tensor, " T"] | None:
        """``time_noise`` of ``splats`` so that each dynamic Gaussian is at the time of the row that sees it.

        The row is that of its mean at the time of the middle row, without gradient: one step of a fixed point. With a
        global shutter it is the noise itself.

        Args:
            camera: Whose rows see them.
            time: Time of its middle row.
            noise: Added to the times of all rows.
        """
        means = self.dynamic.means
        if camera.motion is None or camera.duration == 0.0 or not len(means):
            return noise
        offsets = self.offsets(time, noise)
        delays = camera.delays(means + offsets[:, :3])
        return delays if noise is None else delays + noise

    def static_splats(self, sh_degree: int | None = None) -> Splats:
        """The static Gaussians alone, with their own appearance w⁰."""
        static = self.static
        return Splats(static.means, static.quats, static.scales, static.opacities, sh=static.sh, sh_degree=sh_degree)
