"""Activation of the raw Gaussians of both branches, with the outputs of the networks (kernels/activation.py)."""

from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import activation as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.launch import launch
from warpgs.runtime.tape import Gradients, Recorded, differentiable

from .projection import Geometry

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


def activate(
    static: Raw, dynamic: Raw, static_changes: Changes = NO_CHANGES, dynamic_changes: Changes = NO_CHANGES
) -> Geometry:
    """Joins both branches, static ones first, with the outputs of the networks (paper Eq. 5, 8, 11); differentiable.

    Args:
        static, dynamic: The branches; their colours are not used.
        static_changes, dynamic_changes: Changes of each branch.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    _check_geometry(("static", static, static_changes), ("dynamic", dynamic, dynamic_changes))
    inputs = (*static[:NUM_GEOMETRY], *static_changes, *dynamic[:NUM_GEOMETRY], *dynamic_changes)
    return Geometry(*differentiable(_activate, *inputs))


def _activate(*tensors: Any) -> Recorded:
    half = len(tensors) // 2
    branches, num_static = (tensors[:half], tensors[half:]), len(tensors[0])
    N, new = num_static + len(tensors[half]), tensors[0].new_empty
    out = Geometry(new(N, 3), new(N, 4), new(N, 3), new(N))
    for branch, first_row in zip(branches, (0, num_static), strict=True):
        launch(kernels.activate_fwd, len(branch[0]), *branch, first_row, *out)
    return Recorded(tuple(out), _activate_backward, (*tensors, out.scales, out.opacities))


def _activate_backward(saved: tuple[Any, ...], v_outputs: Gradients) -> Gradients:
    *tensors, scales, opacities = saved
    half = len(tensors) // 2
    columns = ((3,), (4,), (3,), ())
    v_out = [scales.new_zeros(len(scales), *c) if v is None else v for v, c in zip(v_outputs, columns, strict=True)]
    gradients: list[Tensor | None] = []
    for branch, first_row in ((tensors[:half], 0), (tensors[half:], len(tensors[0]))):
        _, quats, *_, offsets, logit_residuals = branch
        v_raw = [torch.empty_like(t) for t in branch[:NUM_GEOMETRY]]
        v_offsets = None if offsets is None else torch.empty_like(offsets)
        inputs = (quats, offsets, scales, opacities, *v_out)
        launch(kernels.activate_bwd, len(quats), *inputs, first_row, *v_raw, v_offsets)
        gradients += [*v_raw, v_offsets, None if logit_residuals is None else v_raw[-1]]
    return gradients


def _check_geometry(*branches: tuple[str, Raw, Changes]) -> None:
    shapes = (("N", 3), ("N", 4), ("N", 3), ("N",), ("N", 10), ("N",))
    tensors: dict[str, Tensor | None] = {}
    for branch, raw, changes in branches:
        sizes: dict[str, int] = {}
        fields = raw._fields[:NUM_GEOMETRY] + changes._fields
        for field, tensor, shape in zip(fields, (*raw[:NUM_GEOMETRY], *changes), shapes, strict=True):
            tensors[f"{branch}.{field}"] = tensor
            if tensor is not None:
                check_tensor(f"{branch}.{field}", tensor, shape, sizes)
    check_same_device(tensors)


def join_sh(static: Raw, dynamic: Raw, residuals: Float[Tensor, "N R 3"] | None = None) -> Float[Tensor, "M bases 3"]:
    """Joins the spherical harmonics coefficients of both branches, static ones first; differentiable in everything.

    Args:
        static, dynamic: The branches, with equal numbers of bases; only their colours are used.
        residuals: [N, R, 3] Δw of paper Eq. 8, added to the first R bases of the N static Gaussians.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    bases = _check_coefficients(static, dynamic, residuals)
    inputs = (static.sh_dc, static.sh_rest, residuals, dynamic.sh_dc, dynamic.sh_rest, None)
    return differentiable(partial(_join_sh, bases), *inputs)[0]


def _join_sh(bases: int, *tensors: Any) -> Recorded:
    num_static = len(tensors[0])
    sh = tensors[0].new_empty(num_static + len(tensors[3]), bases, 3)
    for parts, first_row in ((tensors[:3], 0), (tensors[3:], num_static)):
        if sh.is_cuda:
            launch(kernels.join_sh_fwd, len(parts[0]) * bases, *parts, first_row, sh)
        else:
            _copy_sh(sh[first_row : first_row + len(parts[0])], *parts)
    return Recorded((sh,), _join_sh_backward, tensors)


def _copy_sh(sh: Tensor, sh_dc: Tensor, sh_rest: Tensor, residuals: Tensor | None) -> None:
    """``join_sh_fwd`` on CPU, where torch copies whole rows, a tenth of the time of a thread per coefficient."""
    sh[:, :1] = sh_dc
    sh[:, 1:] = sh_rest
    if residuals is not None:
        sh[:, : residuals.shape[1]] += residuals


def _join_sh_backward(saved: tuple[Any, ...], v_outputs: Gradients) -> Gradients:
    (v_sh,) = v_outputs
    assert v_sh is not None
    v_inputs: list[Tensor | None] = []
    for k, first_row in ((0, 0), (3, len(saved[0]))):
        parts = saved[k : k + 3]
        if v_sh.is_cuda:
            v_parts = [None if t is None else torch.empty_like(t) for t in parts]
            launch(kernels.join_sh_bwd, len(parts[0]) * v_sh.shape[1], v_sh, first_row, *v_parts)
        else:
            v_own = v_sh[first_row : first_row + len(parts[0])]
            columns = (slice(1), slice(1, None), slice(None if parts[2] is None else parts[2].shape[1]))
            v_parts = [None if t is None else v_own[:, c].contiguous() for t, c in zip(parts, columns, strict=True)]
        v_inputs += v_parts
    return v_inputs


def _check_coefficients(static: Raw, dynamic: Raw, residuals: Tensor | None) -> int:
    """Raises ``ValueError`` unless the tensors fit each other; returns the number of bases."""
    tensors: dict[str, Tensor | None] = {"sh_residuals": residuals}
    bases = 1 + static.sh_rest.shape[1]
    for name, raw in (("static", static), ("dynamic", dynamic)):
        sizes = {"rest": bases - 1}
        check_tensor(f"{name}.sh_dc", raw.sh_dc, ("N", 1, 3), sizes)
        check_tensor(f"{name}.sh_rest", raw.sh_rest, ("N", "rest", 3), sizes)
        tensors |= {f"{name}.sh_dc": raw.sh_dc, f"{name}.sh_rest": raw.sh_rest}
    if residuals is not None:
        sizes = {"N": len(static.sh_dc)}
        check_tensor("sh_residuals", residuals, ("N", "R", 3), sizes)
        if sizes["R"] > bases:
            raise ValueError(f"sh_residuals has {sizes['R']} bases, but there are only {bases}")
    check_same_device(tensors)
    return bases
