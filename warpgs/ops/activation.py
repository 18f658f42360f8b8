"""Activation of the raw Gaussians of both branches, with the outputs of the networks applied (kernels/activation.py).

Geometry and colours are separate ops, so that the appearance network can run while geometry is activated and binned.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import activation as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import OpContext, differentiable

NUM_GEOMETRY = 4
"""Number of fields of ``Raw`` that are not colours."""


class Raw(NamedTuple):
    """Gaussians of one branch as the optimizer holds them.

    Attributes:
        means: [N, 3] centres.
        quats: [N, 4] rotations (w, x, y, z) of any length.
        log_scales: [N, 3] logarithms of standard deviations.
        logit_opacities: [N] logits of opacities.
        sh_dc: [N, 1, 3] spherical harmonics coefficients of degree 0.
        sh_rest: [N, bases - 1, 3] coefficients of the higher degrees.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    logit_opacities: Float[Tensor, " N"]
    sh_dc: Float[Tensor, "N 1 3"]
    sh_rest: Float[Tensor, "N rest 3"]


class Changes(NamedTuple):
    """Outputs of the networks for the geometry of one branch; None for no change.

    Attributes:
        offsets: [N, 10] δμ (3), δr (4) and δs (3) of paper Eq. 10.
        logit_residuals: [N] residuals of the opacity logits (paper Eq. 8).
    """

    offsets: Float[Tensor, "N 10"] | None = None
    logit_residuals: Float[Tensor, " N"] | None = None


NO_CHANGES = Changes()


class Activated(NamedTuple):
    """Gaussians in activated form, static ones first.

    Attributes:
        means: [N, 3] centres.
        quats: [N, 4] rotations (w, x, y, z) of any length.
        scales: [N, 3] standard deviations.
        opacities: [N] in (0, 1).
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]


def activate(
    static: Raw, dynamic: Raw, static_changes: Changes = NO_CHANGES, dynamic_changes: Changes = NO_CHANGES
) -> Activated:
    """Joins both branches and applies the outputs of the networks (paper Eq. 5, 8, 11); differentiable in everything.

    Args:
        static, dynamic: The branches; their colours are not used.
        static_changes, dynamic_changes: Changes of each branch.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    _check_geometry(("static", static, static_changes), ("dynamic", dynamic, dynamic_changes))

    def op(ctx: OpContext, *tensors: Any) -> tuple[Tensor, ...]:
        half = len(tensors) // 2
        N = len(tensors[0]) + len(tensors[half])
        out = Activated(ctx.empty(N, 3), ctx.empty(N, 4), ctx.empty(N, 3), ctx.empty(N))
        for branch, first_row in ((tensors[:half], 0), (tensors[half:], len(tensors[0]))):
            _record_branch(ctx, branch[:NUM_GEOMETRY], Changes(*branch[NUM_GEOMETRY:]), out, first_row)
        return tuple(out)

    static_inputs = (*static[:NUM_GEOMETRY], *static_changes)
    return Activated(*differentiable(op, *static_inputs, *dynamic[:NUM_GEOMETRY], *dynamic_changes))


def _check_geometry(*branches: tuple[str, Raw, Changes]) -> None:
    tensors: dict[str, Tensor | None] = {}
    for name, raw, changes in branches:
        sizes: dict[str, int] = {}
        shapes = [("N", 3), ("N", 4), ("N", 3), ("N",)]
        for field, tensor, shape in zip(Raw._fields, raw[:NUM_GEOMETRY], shapes, strict=False):
            check_tensor(f"{name}.{field}", tensor, shape, sizes)
            tensors[f"{name}.{field}"] = tensor
        for (field, change), shape in zip(changes._asdict().items(), [("N", 10), ("N",)], strict=True):
            if change is not None:
                check_tensor(f"{name}: {field}", change, shape, sizes)
            tensors[f"{name}: {field}"] = change
    check_same_device(tensors)


def _record_branch(ctx: OpContext, raw: Sequence[Tensor], changes: Changes, out: Activated, first_row: int) -> None:
    """Writes the geometry of one branch to the rows of the output from ``first_row`` on."""
    N, quats = len(raw[0]), raw[1]
    ctx.launch(kernels.activate_fwd, N, first_row, *raw, *changes, *out)

    def backward(ctx: OpContext) -> None:
        v_out = [torch.zeros_like(t) if (v := ctx.gradient(t)) is None else v for t in out]
        v_raw = [ctx.empty(*t.shape) for t in raw]
        v_offsets = None if changes.offsets is None else ctx.empty(N, 10)
        ctx.launch(
            kernels.activate_bwd,
            N,
            first_row,
            quats,
            changes.offsets,
            out.scales,
            out.opacities,
            *v_out,
            *v_raw,
            v_offsets,
        )
        for tensor, value in zip((*raw, *changes), (*v_raw, v_offsets, v_raw[-1]), strict=True):
            if tensor is not None and value is not None:
                ctx.add_gradient(tensor, value)

    ctx.on_backward(backward, reads=(out.scales, out.opacities))


def join_sh(static: Raw, dynamic: Raw, residuals: Float[Tensor, "N R 3"] | None = None) -> Float[Tensor, "M bases 3"]:
    """Joins the spherical harmonics coefficients of both branches, static ones first; differentiable in everything.

    Args:
        static, dynamic: The branches, with equal numbers of bases; only their colours are used.
        residuals: [N, R, 3] Δw of paper Eq. 8, added to the first R bases of the N static Gaussians.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    bases = _check_coefficients(static, dynamic, residuals)

    def op(ctx: OpContext, *tensors: Any) -> tuple[Tensor, ...]:
        num_static = len(tensors[0])
        sh = ctx.empty(num_static + len(tensors[3]), bases, 3)
        _record_sh_branch(ctx, tensors[:3], sh, 0)
        _record_sh_branch(ctx, (*tensors[3:], None), sh, num_static)
        return (sh,)

    return differentiable(op, static.sh_dc, static.sh_rest, residuals, dynamic.sh_dc, dynamic.sh_rest)[0]


def _check_coefficients(static: Raw, dynamic: Raw, residuals: Tensor | None) -> int:
    """Raises ``ValueError`` unless the tensors fit each other; returns the number of bases."""
    tensors: dict[str, Tensor | None] = {"sh_residuals": residuals}
    shared: dict[str, int] = {}
    for name, raw in (("static", static), ("dynamic", dynamic)):
        sizes = dict(shared)
        check_tensor(f"{name}.sh_dc", raw.sh_dc, ("N", 1, 3), sizes)
        check_tensor(f"{name}.sh_rest", raw.sh_rest, ("N", "rest", 3), sizes)
        shared["rest"] = sizes["rest"]
        tensors |= {f"{name}.sh_dc": raw.sh_dc, f"{name}.sh_rest": raw.sh_rest}
    bases = 1 + shared["rest"]
    if residuals is not None:
        sizes = {"N": len(static.sh_dc)}
        check_tensor("sh_residuals", residuals, ("N", "R", 3), sizes)
        if sizes["R"] > bases:
            raise ValueError(f"sh_residuals has {sizes['R']} bases, but there are only {bases}")
    check_same_device(tensors)
    return bases


def _record_sh_branch(ctx: OpContext, parts: Sequence[Tensor | None], sh: Tensor, first_row: int) -> None:
    """Writes the coefficients of one branch (sh_dc, sh_rest, residuals) to the rows from ``first_row`` on."""
    sh_dc, _, residuals = parts
    assert sh_dc is not None
    threads = len(sh_dc) * sh.shape[1]
    ctx.launch(kernels.join_sh_fwd, threads, first_row, *parts, sh)

    def backward(ctx: OpContext) -> None:
        v_sh = ctx.gradient(sh)
        if v_sh is None:
            return
        inputs = [t for t in parts if t is not None]
        v_inputs = [ctx.empty(*t.shape) for t in inputs]
        v_residuals = None if residuals is None else v_inputs[2]
        ctx.launch(kernels.join_sh_bwd, threads, first_row, v_sh, *v_inputs[:2], v_residuals)
        for tensor, value in zip(inputs, v_inputs, strict=True):
            ctx.add_gradient(tensor, value)

    ctx.on_backward(backward)
