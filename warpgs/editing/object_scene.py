"""A scene whose Gaussians belong to objects, some of which have another colour or move at another time."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor, nn

from warpgs.cameras import Camera
from warpgs.model.gaussians import SH_C0
from warpgs.model.splats import Splats
from warpgs.runs.trained import TrainedScene

from .objects import Objects
from .options import Edits, NamedBox

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the brightness of a colour (ITU-R BT.601)."""

DARK = 1e-3
"""Minimum brightness of an object, so that it can be divided by."""


class Retimed(NamedTuple):
    """Times at which an object moves.

    Attributes:
        object: Its number.
        freeze: The time at which it stays; None if it moves.
        shift: By how much it moves later.
    """

    object: int
    freeze: float | None
    shift: float

    def at(self, time: Float[Tensor, " T"]) -> Float[Tensor, " T"]:
        """The times at which the object is shown at times of the scene."""
        return (time - self.shift).clamp(0.0, 1.0) if self.freeze is None else torch.full_like(time, self.freeze)


class Recolored(NamedTuple):
    """Another colour of an object: c ↦ matrix c, for colours and for all of their coefficients.

    Attributes:
        object: Its number.
        matrix: [3, 3] the new colour times the brightness of a colour, relative to that of the object.
    """

    object: int
    matrix: Float[Tensor, "3 3"]

    def of(self, sh: Float[Tensor, "M bases 3"]) -> Float[Tensor, "M bases 3"]:
        """The coefficients in the new colour."""
        sh = sh @ self.matrix.T
        sh[:, 0] += (self.matrix.sum(1) - 1.0) * 0.5 / SH_C0  # a colour is 0.5 + SH_C0 · sh[0] + …
        return sh


class ObjectScene(TrainedScene):
    """A trained scene that knows the object of each Gaussian.

    Args:
        scene: The scene without changes of its objects.
        ids: [N] as of ``Objects``.
        retimed, recolored: Changes of objects.

    Attributes:
        ids: As above, on the scene's device.
    """

    def __init__(
        self,
        scene: TrainedScene,
        ids: Int64[Tensor, " N"],
        retimed: Sequence[Retimed] = (),
        recolored: Sequence[Recolored] = (),
    ) -> None:
        num_static = len(scene.scene.static)
        super().__init__(scene.scene, scene.config, scene.metadata)
        self.rows = scene.rows
        self.ids, self._plain, self._retimed, self._recolored = ids, scene, retimed, recolored
        rows = [(change, (ids[num_static:] == change.object).nonzero()[:, 0]) for change in retimed]
        if rows := [(change, of_object) for change, of_object in rows if len(of_object)]:
            deformation = RetimedDeformation(scene.scene.deformation, rows)
            self.scene = scene.scene.with_modules(deformation=deformation)
        self._rows = [(change, (ids == change.object).nonzero()[:, 0]) for change in recolored]

    @property
    def of_dynamic(self) -> Int32[np.ndarray, " D"]:
        """The objects of the dynamic Gaussians."""
        return self.ids[len(self.scene.static) :].cpu().numpy().astype(np.int32)

    def select(self, kept: Bool[Tensor, " N"]) -> "ObjectScene":
        return ObjectScene(self._plain.select(kept), self.ids[kept], self._retimed, self._recolored)

    def _splats(self, time: Float[Tensor, "1"], residual: bool = True, camera: Camera | None = None) -> Splats:
        splats = super()._splats(time, residual, camera)
        assert splats.sh is not None
        sh = splats.sh
        for change, rows in self._rows:
            sh = sh.index_copy(0, rows, change.of(sh[rows]))
        return replace(splats, sh=sh, objects=self.ids)


class RetimedDeformation(nn.Module):
    """A deformation model that some Gaussians ask at other times.

    Args:
        deformation: The model; see ``model.fields.FIELDS``.
        rows: The changes of objects, each with the indices of its dynamic Gaussians.
    """

    def __init__(self, deformation: nn.Module, rows: Sequence[tuple[Retimed, Int64[Tensor, "..."]]]) -> None:
        super().__init__()
        self.deformation, self._rows = deformation, rows

    def forward(self, means: Float[Tensor, "N 3"], time: Float[Tensor, " T"]) -> Float[Tensor, "N 10"]:
        """Offsets, as of the model."""
        offsets = self.deformation(means, time)
        for change, rows in self._rows:
            at = change.at(time if len(time) == 1 else time[rows])
            offsets = offsets.index_copy(0, rows, self.deformation(means[rows], at))
        return offsets


def with_objects(scene: TrainedScene, objects: Objects, edits: Edits) -> ObjectScene:
    """A scene that knows its objects, with the changes of edits to them.

    Raises:
        ValueError: If edits name an object that there is not, or let one move that is static.
    """
    ids = torch.from_numpy(objects.ids).long().to(scene.device)
    colors = [(number_of(objects, "recolor", name), color) for name, *color in edits.recolor]
    recolored = [Recolored(k, _toward(scene, ids == k, color)) for k, color in colors]
    return ObjectScene(scene, ids, _retimed(scene, objects, edits), recolored)


def with_boxes(ids: Int32[np.ndarray, " D"], scene: TrainedScene, boxes: Sequence[NamedBox]) -> Objects:
    """The objects of a scene: the dynamic ones, then those in boxes; a Gaussian in several is of the last.

    Args:
        ids: [D] objects of the dynamic Gaussians, from 1; 0 for those of none.
        scene: The scene.
        boxes: Where its static objects are.

    Raises:
        ValueError: If a box is empty.
    """
    count, static = int(ids.max(initial=0)), scene.scene.static.means
    of_static = torch.zeros(len(static), dtype=torch.int32)
    for k, (name, *box) in enumerate(boxes, 1):
        corners = torch.tensor(box, dtype=torch.float32, device=scene.device).view(2, 3)
        inside = ((static >= corners.amin(0)) & (static <= corners.amax(0))).all(1)
        if not inside.any():
            raise ValueError(f"--box {name} has no static Gaussians inside")
        of_static[inside.cpu()] = count + k
    names = (*(str(k) for k in range(1, count + 1)), *(name for name, *_ in boxes))
    return Objects(np.concatenate([of_static.numpy(), ids]), names, len(ids))


def number_of(objects: Objects, option: str, name: str) -> int:
    """The number of the object of a name, 0 for what belongs to none; raises ValueError if there is none."""
    if name not in ("0", *objects.names):
        known = ", ".join(objects.names) or f"{objects}; --box makes one of static Gaussians"
        raise ValueError(f"--{option} {name}: there is no such object; the objects of this scene are: {known}")
    return 0 if name == "0" else objects.names.index(name) + 1


def _retimed(scene: TrainedScene, objects: Objects, edits: Edits) -> list[Retimed]:
    if scene.scene.num_segments > 1 and edits.freeze + edits.shift:
        option = "freeze" if edits.freeze else "shift"
        num = f"{scene.scene.num_segments} segments of time"
        raise ValueError(f"--{option}: this scene has {num}, expected one: train it with --model.segments 1")
    moving = {*objects.ids[len(scene.scene.static) :].tolist()}
    changes = []
    for option, times in (("freeze", edits.freeze), ("shift", edits.shift)):
        for name, time in times:
            number = number_of(objects, option, name)
            if number not in moving:
                raise ValueError(f"--{option} {name}: this object has no dynamic Gaussians, so it never moves")
            changes.append(Retimed(number, time, 0.0) if option == "freeze" else Retimed(number, None, time))
    return changes


def _toward(scene: TrainedScene, of_object: Bool[Tensor, " N"], color: Sequence[float]) -> Float[Tensor, "3 3"]:
    """The matrix of ``Recolored`` for a colour: brightness becomes shades of it, so that shading and texture stay."""
    splats = scene.splats(0.0)
    assert splats.sh is not None
    luma = torch.tensor(LUMA, dtype=torch.float32, device=scene.device)
    brightness = (0.5 + SH_C0 * splats.sh[of_object, 0]).clamp(0, 1) @ luma
    # Those of dynamic Gaussians are 0 outside of their segment of time.
    opacities = torch.cat([splats.opacities[: len(scene.scene.static)], scene.scene.dynamic.opacities])
    weights = opacities[of_object]
    mean = (brightness * weights).sum() / weights.sum().clamp_min(DARK)
    return torch.tensor(color, dtype=torch.float32, device=scene.device)[:, None] * luma / mean.clamp_min(DARK)
