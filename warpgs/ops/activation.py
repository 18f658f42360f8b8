"""Raw Gaussians of both branches, moved and relit, as splats of one scene (kernels/activation.py)."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import activation as kernels

from .contracts import check_same_device, check_tensor
from .tape import Run, differentiable


class Raw(NamedTuple):
    """Gaussians of one branch as the optimizer holds them.

    Attributes:
        means: [N, 3].
        quats: [N, 4] (w, x, y, z), of any length.
        log_scales: [N, 3] logarithms of standard deviations.
        logit_opacities: [N] logits of opacities.
        sh_dc: [N, 1, 3] constant coefficients of the colour.
        sh_rest: [N, bases - 1, 3] the others.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    logit_opacities: Float[Tensor, " N"]
    sh_dc: Float[Tensor, "N 1 3"]
    sh_rest: Float[Tensor, "N rest 3"]


class Changes(NamedTuple):
    """What networks add to the Gaussians of one branch; None where they add nothing.

    Attributes:
        offsets: [N, 10] δμ (3), δr (4) and δs (3) of paper Eq. 10.
        sh_residuals: [N, R, 3] Δw of paper Eq. 8, of the first R bases.
        logit_residuals: [N] the same of the logits of opacities.
    """

    offsets: Float[Tensor, "N 10"] | None = None
    sh_residuals: Float[Tensor, "N R 3"] | None = None
    logit_residuals: Float[Tensor, " N"] | None = None


NO_CHANGES = Changes()


class Activated(NamedTuple):
    """Gaussians in activated form, those of the first branch first.

    Attributes:
        means: [N, 3].
        quats: [N, 4].
        scales: [N, 3] standard deviations.
        opacities: [N] in (0, 1).
        sh: [N, bases, 3].
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    sh: Float[Tensor, "N bases 3"]


def activate(static: Raw, dynamic: Raw, relit: Changes = NO_CHANGES, moved: Changes = NO_CHANGES) -> Activated:
    """Joins both branches and applies what the networks say (paper Eq. 5, 8, 11); differentiable in everything.

    Args:
        static, dynamic: The branches, with as many bases of spherical harmonics.
        relit: Changes of the static branch.
        moved: Changes of the dynamic branch.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    branches = ((static, relit), (dynamic, moved))
    shared: dict[str, int] = {}
    for name, (raw, changes) in zip(("static", "dynamic"), branches, strict=True):
        _check(name, raw, changes, shared)
    everything = {
        f"{name}.{field}": value
        for name, pair in zip(("static", "dynamic"), branches, strict=True)
        for part in pair
        for field, value in part._asdict().items()
    }
    check_same_device(everything)

    def op(run: Run, *tensors: Any) -> tuple[Tensor, ...]:
        half, num_raw = len(tensors) // 2, len(Raw._fields)
        pairs = [(Raw(*t[:num_raw]), Changes(*t[num_raw:])) for t in (tensors[:half], tensors[half:])]
        N, bases = sum(len(raw.means) for raw, _ in pairs), 1 + pairs[0][0].sh_rest.shape[1]
        out = Activated(run.empty(N, 3), run.empty(N, 4), run.empty(N, 3), run.empty(N), run.empty(N, bases, 3))
        first_row = 0
        for raw, changes in pairs:
            _record_branch(run, raw, changes, out, first_row)
            first_row += len(raw.means)
        return tuple(out)

    return Activated(*differentiable(op, *static, *relit, *dynamic, *moved))


def _record_branch(run: Run, raw: Raw, changes: Changes, out: Activated, first_row: int) -> None:
    """Writes one branch into its rows of the output, from ``first_row`` on."""
    N, bases = len(raw.means), out.sh.shape[1]
    residuals = changes.sh_residuals
    run.launch(kernels.activate_fwd, N, first_row, *raw[:4], changes.offsets, changes.logit_residuals, *out[:4])
    run.launch(kernels.join_sh_fwd, N * bases, first_row, raw.sh_dc, raw.sh_rest, residuals, out.sh)

    def backward(run: Run) -> None:
        v_out = [torch.zeros_like(t) if (v := run.adjoint(t)) is None else v for t in out]
        v_raw = Raw(*(run.empty(*t.shape) for t in raw))
        v_changes = Changes(
            None if changes.offsets is None else run.empty(N, 10),
            None if residuals is None else run.empty(*residuals.shape),
            v_raw.logit_opacities,
        )
        run.launch(
            kernels.activate_bwd,
            N,
            first_row,
            raw.quats,
            changes.offsets,
            out.scales,
            out.opacities,
            *v_out[:4],
            *v_raw[:4],
            v_changes.offsets,
        )
        run.launch(
            kernels.join_sh_bwd, N * bases, first_row, v_out[4], v_raw.sh_dc, v_raw.sh_rest, v_changes.sh_residuals
        )
        for tensor, value in zip((*raw, *changes), (*v_raw, *v_changes), strict=True):
            if tensor is not None and value is not None:
                run.add_adjoint(tensor, value)

    run.on_backward(backward)


def _check(name: str, raw: Raw, changes: Changes, shared: dict[str, int]) -> None:
    sizes = {key: value for key, value in shared.items() if key == "rest"}
    shapes = [("N", 3), ("N", 4), ("N", 3), ("N",), ("N", 1, 3), ("N", "rest", 3)]
    for (field, tensor), shape in zip(raw._asdict().items(), shapes, strict=True):
        check_tensor(f"{name}.{field}", tensor, shape, sizes)
    shared["rest"] = sizes["rest"]
    for (field, tensor), shape in zip(changes._asdict().items(), [("N", 10), ("N", "R", 3), ("N",)], strict=True):
        if tensor is not None:
            check_tensor(f"{name}: {field}", tensor, shape, sizes)
    if changes.sh_residuals is not None and sizes["R"] > sizes["rest"] + 1:
        raise ValueError(f"{name}: sh_residuals has {sizes['R']} bases, but there are only {sizes['rest'] + 1}")
