"""Small random scenes away from all cut-offs, and comparisons of results."""

import dataclasses
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.model.gaussians import Gaussians
from warpgs.model.splats import Splats

WIDTH, HEIGHT = 50, 37
GEOMETRY = ("means", "quats", "scales", "opacities")


def generator(seed: int = 3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """Rotated and shifted, with two focal lengths and an off-centre principal point."""
    turn = torch.tensor(0.2)
    viewmat = torch.eye(4)
    viewmat[0, 0] = viewmat[2, 2] = torch.cos(turn)
    viewmat[0, 2], viewmat[2, 0] = torch.sin(turn), -torch.sin(turn)
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    K = torch.tensor([[45.0, 0.0, 27.3], [0.0, 43.0, 16.1], [0.0, 0.0, 1.0]])
    return Camera(viewmat, K, width, height)


def along_z(
    focal: float, size: tuple[int, int], position: Sequence[float] = (0.0, 0.0, 0.0), time: float = 0.0
) -> Camera:
    """A camera that looks along z, with square pixels and its principal point in the middle of the image."""
    viewmat = torch.eye(4)
    viewmat[:3, 3] -= torch.tensor(position)
    K = torch.tensor([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat, K, *size, time)


def shifted(camera: Camera, x: float, time: float) -> Camera:
    """A camera moved to its left by ``x``, at another time."""
    viewmat = camera.viewmat.clone()
    viewmat[0, 3] += x
    return dataclasses.replace(camera, viewmat=viewmat, time=time)


def make_splats(num: int = 60, seed: int = 3, channels: int | None = None, degree: int = 3) -> Splats:
    """Random splats with spherical harmonics or, if ``channels`` is given, with colours."""
    g = generator(seed)
    corner, size = torch.tensor([-2.0, -1.5, 1.5]), torch.tensor([4.0, 3.0, 4.0])
    means = torch.rand(num, 3, generator=g) * size + corner
    quats = torch.randn(num, 4, generator=g)
    scales = torch.exp(torch.randn(num, 3, generator=g) * 0.6 - 1.8)
    opacities = torch.rand(num, generator=g) * 0.9 + 0.05
    is_dynamic = torch.rand(num, generator=g) > 0.5
    if channels is not None:
        colors = torch.rand(num, channels, generator=g)
        return Splats(means, quats, scales, opacities, colors=colors, is_dynamic=is_dynamic)
    sh = torch.randn(num, (degree + 1) ** 2, 3, generator=g) * 0.3
    return Splats(means, quats, scales, opacities, sh=sh, is_dynamic=is_dynamic)


def as_gaussians(splats: Splats) -> Gaussians:
    """The parameters of splats with spherical harmonics."""
    values = (splats.means, splats.quats, splats.scales.log(), splats.opacities.logit())
    return Gaussians(*values, splats.sh[:, :1].contiguous(), splats.sh[:, 1:].contiguous())


def random_gaussians(num: int, seed: int = 3) -> Gaussians:
    """Parameters that are normally distributed."""
    g = generator(seed)
    shapes = [(num, 3), (num, 4), (num, 3), (num,), (num, 1, 3), (num, 15, 3)]
    return Gaussians(*(torch.randn(shape, generator=g) for shape in shapes))


def float_tensors(splats: Splats) -> dict[str, Tensor]:
    """The differentiable tensors of splats by name."""
    named = {name: getattr(splats, name) for name in Splats.tensor_names()}
    return {name: t for name, t in named.items() if t is not None and t.is_floating_point()}


def as_leaves(splats: Splats) -> Splats:
    """A copy whose tensors require gradients."""
    leaves = {name: t.detach().clone().requires_grad_() for name, t in float_tensors(splats).items()}
    return dataclasses.replace(splats, **leaves)


def as_doubles(splats: Splats) -> dict[str, Tensor]:
    """Copies in double precision that require gradients, for the reference."""
    return {name: t.detach().double().requires_grad_() for name, t in float_tensors(splats).items()}


def gradients(splats: Splats) -> dict[str, Tensor]:
    return {name: t.grad for name, t in float_tensors(splats).items()}


def select(splats: Splats, index: Tensor) -> Splats:
    """The Gaussians at an index or mask."""
    named = {name: getattr(splats, name) for name in Splats.tensor_names()}
    return dataclasses.replace(splats, **{name: t[index].contiguous() for name, t in named.items() if t is not None})


def random_like(tensors: Iterable[Tensor], seed: int = 11) -> list[Tensor]:
    """A random tensor of the same shape for each tensor, such as a gradient of an output."""
    g = generator(seed)
    return [torch.randn(t.shape, generator=g) for t in tensors]


def weighted_sum(values: Iterable[Tensor], weights: Iterable[Tensor]) -> Tensor:
    """Σ value · weight, the scalar whose gradient with respect to the values is the weights."""
    return sum((v * w).sum() for v, w in zip(values, weights, strict=True))


def error(actual: Tensor, expected: Tensor) -> float:
    """Maximum absolute difference."""
    assert actual.shape == expected.shape
    return (actual - expected).abs().max().item()


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """Norm of the difference relative to the norm of the expected tensor, which must not be zero."""
    assert actual.shape == expected.shape
    assert expected.norm() > 0
    return ((actual - expected).norm() / expected.norm()).item()


def assert_same_gradients(
    outputs: Iterable[Tensor],
    expected: Iterable[Tensor],
    inputs: Iterable[Tensor],
    doubles: Iterable[Tensor],
    tolerance: float = 1e-5,
) -> None:
    """Backpropagates random gradients from outputs and from those of the reference; compares the inputs' gradients."""
    v_outputs = random_like(expected)
    weighted_sum(outputs, v_outputs).backward()
    weighted_sum(expected, v_outputs).backward()
    for k, (actual, wanted) in enumerate(zip(inputs, doubles, strict=True)):
        assert relative_error(actual.grad, wanted.grad) < tolerance, f"input {k}"
