"""Alpha compositing in plain torch, any dtype: every pixel evaluates every Gaussian, and autograd differentiates it."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4


def composite(
    splats: Sequence[Tensor],
    features: Tensor,
    is_visible: Tensor,
    size: tuple[int, int],
    background: Tensor,
    max_alpha: float = 0.999,
) -> tuple[Tensor, Tensor, Tensor]:
    """image [H, W, C], alpha [H, W], blend weights [N, H, W] of the Gaussians for which ``is_visible`` [N] is true.

    ``splats`` are means2d, conics, depths and opacities of a ``Projection``.
    """
    means2d, conics, depths, opacities = splats
    width, height = size
    dtype = means2d.dtype
    x = torch.arange(width, dtype=dtype) + 0.5
    y = torch.arange(height, dtype=dtype) + 0.5
    image = torch.zeros(height, width, features.shape[1], dtype=dtype)
    T = torch.ones(height, width, dtype=dtype)
    running = torch.ones(height, width, dtype=torch.bool)
    weights = torch.zeros(means2d.shape[0], height, width, dtype=dtype)
    for g in torch.argsort(depths.detach(), stable=True).tolist():
        if not is_visible[g]:
            continue
        dx, dy = means2d[g, 0] - x[None, :], means2d[g, 1] - y[:, None]
        a, b, c = conics[g]
        alpha = opacities[g] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        alpha = alpha.clamp(max=max_alpha)
        seen = running & (alpha >= ALPHA_MIN)
        T_next = T * (1 - alpha)
        running = running & ~(seen & (T_next <= TRANSMITTANCE_MIN))
        seen = seen & running
        weight = torch.where(seen, alpha * T, torch.zeros_like(T))
        weights[g] = weight.detach()
        image = image + weight[..., None] * features[g]
        T = torch.where(seen, T_next, T)
    return image + T[..., None] * background, 1 - T, weights


def absolute_gradients(outputs: Iterable[Tensor], v_outputs: Iterable[Tensor], means2d: Tensor) -> Tensor:
    """[N, 2] Σ_p |∂(output_p · v_p) / ∂means2d|, over the pixels p of layers [H, W] or [H, W, C] of one image."""
    pairs = zip(outputs, v_outputs, strict=True)
    of_pixels = sum((output * v).flatten(2).sum(-1) if output.ndim > 2 else output * v for output, v in pairs).flatten()
    of_pixels = of_pixels + 0.0 * means2d.sum()  # on which an image without splats does not depend
    one_hot = torch.eye(len(of_pixels), dtype=of_pixels.dtype)
    options = {"retain_graph": True, "is_grads_batched": True}
    return sum(torch.autograd.grad(of_pixels, means2d, part, **options)[0].abs().sum(0) for part in one_hot.split(64))
