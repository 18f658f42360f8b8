"""Layers of a composite, and what arrives at them on the way back (kernels/layers.py)."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import layers as kernels

from .tape import LITTLE_WORK, Run

NUM_BRANCH_IMAGES = 3
"""Joint, static only, dynamic only."""


class Layers(NamedTuple):
    """One entry for each image; ``depths`` is empty unless asked for.

    Attributes:
        images: [H, W, C] each.
        alphas: [H, W] each.
        depths: [H, W] each.
    """

    images: tuple[Float[Tensor, "H W C"], ...]
    alphas: tuple[Float[Tensor, "H W"], ...]
    depths: tuple[Float[Tensor, "H W"], ...]


def gather_adjoints(
    run: Run, layers: Layers, alpha: Tensor, depth: Tensor | None
) -> tuple[Tensor | None, Tensor | None, int]:
    """What has arrived at layers, in one launch for all: gradients of the composites, depth as drawn being their last
    channel, and of alpha, None where nothing has arrived; and where something has.

    Args:
        alpha, depth: [layers, H, W], what ``layers`` has by the piece.

    Returns:
        [layers, H, W, channels], [layers, H, W] and a number whose bit k says whether anything has arrived at layer k.
    """
    arrived = [[run.adjoint(t) for t in tensors] for tensors in layers]
    bits = sum({1 << k for values in arrived for k, v in enumerate(values) if v is not None})
    if bits == 0:
        return None, None, 0
    num, H, W = alpha.shape
    if num == 1 and depth is None:
        (v_image,), (v_alpha,), _ = arrived
        return v_image, v_alpha, bits
    C = layers.images[0].shape[-1]
    v_composite, v_alpha = run.empty(num, H, W, C + int(depth is not None)), run.empty(num, H, W)
    missing: list[Tensor | None] = [None] * NUM_BRANCH_IMAGES
    run.launch(
        kernels.make_layers_bwd(C, depth is not None),
        alpha.numel(),
        H * W,
        alpha.view(-1),
        None if depth is None else depth.view(-1),
        *(None if v is None else v.view(-1) for values in arrived for v in (values + missing)[:NUM_BRANCH_IMAGES]),
        v_composite.view(-1),
        v_alpha.view(-1),
        work=LITTLE_WORK,
    )
    return v_composite, v_alpha, bits
