"""Raw Gaussians of both branches, moved and relit, as splats of one scene (kernels/activation.py).

Geometry and colours apart: what has to be done with the geometry first takes long enough for a network to find the
colours meanwhile.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import activation as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import Run, differentiable

NUM_GEOMETRY = 4
"""Fields of ``Raw`` that are not colours."""


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
    """What networks add to the geometry of the Gaussians of one branch; None where they add nothing.

    Attributes:
        offsets: [N, 10] δμ (3), δr (4) and δs (3) of paper Eq. 10.
        logit_residuals: [N] Δ of the logits of opacities (paper Eq. 8).
    """

    offsets: Float[Tensor, "N 10"] | None = None
    logit_residuals: Float[Tensor, " N"] | None = None


NO_CHANGES = Changes()


class Activated(NamedTuple):
    """Gaussians in activated form, those of the first branch first.

    Attributes:
        means: [N, 3].
        quats: [N, 4].
        scales: [N, 3] standard deviations.
        opacities: [N] in (0, 1).
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]


def activate(static: Raw, dynamic: Raw, relit: Changes = NO_CHANGES, moved: Changes = NO_CHANGES) -> Activated:
    """Joins both branches and applies what the networks say (paper Eq. 5, 8, 11); differentiable in everything.

    Args:
        static, dynamic: The branches; their colours are not looked at.
        relit: Changes of the static branch.
        moved: Changes of the dynamic branch.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    static_geometry, dynamic_geometry = static[:NUM_GEOMETRY], dynamic[:NUM_GEOMETRY]
    everything: dict[str, Tensor | None] = {}
    for name, geometry, changes in (("static", static_geometry, relit), ("dynamic", dynamic_geometry, moved)):
        sizes: dict[str, int] = {}
        shapes = [("N", 3), ("N", 4), ("N", 3), ("N",)]
        for field, tensor, shape in zip(Raw._fields, geometry, shapes, strict=False):
            check_tensor(f"{name}.{field}", tensor, shape, sizes)
            everything[f"{name}.{field}"] = tensor
        for (field, change), shape in zip(changes._asdict().items(), [("N", 10), ("N",)], strict=True):
            if change is not None:
                check_tensor(f"{name}: {field}", change, shape, sizes)
            everything[f"{name}: {field}"] = change
    check_same_device(everything)

    def op(run: Run, *tensors: Any) -> tuple[Tensor, ...]:
        half = len(tensors) // 2
        N = len(tensors[0]) + len(tensors[half])
        out = Activated(run.empty(N, 3), run.empty(N, 4), run.empty(N, 3), run.empty(N))
        _record_branch(run, tensors[:NUM_GEOMETRY], Changes(*tensors[NUM_GEOMETRY:half]), out, 0)
        rest = tensors[half:]
        _record_branch(run, rest[:NUM_GEOMETRY], Changes(*rest[NUM_GEOMETRY:]), out, len(tensors[0]))
        return tuple(out)

    return Activated(*differentiable(op, *static_geometry, *relit, *dynamic_geometry, *moved))


def _record_branch(run: Run, raw: Sequence[Tensor], changes: Changes, out: Activated, first_row: int) -> None:
    """Writes one branch's geometry into its rows of the output, from ``first_row`` on."""
    N, quats = len(raw[0]), raw[1]
    run.launch(kernels.activate_fwd, N, first_row, *raw, *changes, *out)

    def backward(run: Run) -> None:
        v_out = [torch.zeros_like(t) if (v := run.adjoint(t)) is None else v for t in out]
        v_raw = [run.empty(*t.shape) for t in raw]
        v_offsets = None if changes.offsets is None else run.empty(N, 10)
        run.launch(
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
                run.add_adjoint(tensor, value)

    run.on_backward(backward, reads=(out.scales, out.opacities))


def join_sh(static: Raw, dynamic: Raw, residuals: Float[Tensor, "N R 3"] | None = None) -> Float[Tensor, "M bases 3"]:
    """Coefficients of spherical harmonics of both branches, those of the static one first; differentiable.

    Args:
        static, dynamic: The branches, with as many bases; only their colours are looked at.
        residuals: [N, R, 3] Δw of paper Eq. 8, added to the first R bases of the N static Gaussians.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    everything: dict[str, Tensor | None] = {"sh_residuals": residuals}
    shared: dict[str, int] = {}
    for name, raw in (("static", static), ("dynamic", dynamic)):
        sizes = dict(shared)
        check_tensor(f"{name}.sh_dc", raw.sh_dc, ("N", 1, 3), sizes)
        check_tensor(f"{name}.sh_rest", raw.sh_rest, ("N", "rest", 3), sizes)
        shared["rest"] = sizes["rest"]
        everything |= {f"{name}.sh_dc": raw.sh_dc, f"{name}.sh_rest": raw.sh_rest}
    bases = 1 + shared["rest"]
    if residuals is not None:
        sizes = {"N": len(static.sh_dc)}
        check_tensor("sh_residuals", residuals, ("N", "R", 3), sizes)
        if sizes["R"] > bases:
            raise ValueError(f"sh_residuals has {sizes['R']} bases, but there are only {bases}")
    check_same_device(everything)

    def op(run: Run, *tensors: Any) -> tuple[Tensor, ...]:
        num_static = len(tensors[0])
        sh = run.empty(num_static + len(tensors[3]), bases, 3)
        _record_sh_branch(run, tensors[:3], sh, 0)
        _record_sh_branch(run, (*tensors[3:], None), sh, num_static)
        return (sh,)

    return differentiable(op, static.sh_dc, static.sh_rest, residuals, dynamic.sh_dc, dynamic.sh_rest)[0]


def _record_sh_branch(run: Run, parts: Sequence[Tensor | None], sh: Tensor, first_row: int) -> None:
    """Writes one branch's coefficients (first, others, residuals) into its rows, from ``first_row`` on."""
    sh_dc, _, residuals = parts
    assert sh_dc is not None
    threads = len(sh_dc) * sh.shape[1]
    run.launch(kernels.join_sh_fwd, threads, first_row, *parts, sh)

    def backward(run: Run) -> None:
        v_sh = run.adjoint(sh)
        if v_sh is None:
            return
        inputs = [t for t in parts if t is not None]
        v_inputs = [run.empty(*t.shape) for t in inputs]
        v_residuals = None if residuals is None else v_inputs[2]
        run.launch(kernels.join_sh_bwd, threads, first_row, v_sh, *v_inputs[:2], v_residuals)
        for tensor, value in zip(inputs, v_inputs, strict=True):
            run.add_adjoint(tensor, value)

    run.on_backward(backward)
