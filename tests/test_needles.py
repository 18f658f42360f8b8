"""Gradients of long, thin splats against the float64 reference: single precision must not lose how long they are."""

import dataclasses
import math

import pytest
import torch

from tests.reference.render import render as reference
from tests.scenes import along_z, as_doubles
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.rendering import render

WIDTH, HEIGHT, FOCAL, DEPTH = 480, 270, 400.0, 4.0
CAMERA = along_z(FOCAL, (WIDTH, HEIGHT), (0.0, 0.0, -DEPTH))
PIXEL = DEPTH / FOCAL
THICKNESS = math.sqrt(0.3)
"""Standard deviation on screen [px] of a splat whose own is far below: the low-pass filter."""
ORIENTATIONS = [math.pi * (step + 0.37) / 16 for step in range(16)]


def make_needle(elongation: float, angle: float) -> Splats:
    """One Gaussian in the image plane, ``elongation`` times as long on screen as thick, turned by an angle."""
    scales = [elongation * THICKNESS * PIXEL, 0.05 * PIXEL, 0.05 * PIXEL]
    return Splats(
        means=torch.tensor([[0.13, -0.07, 0.0]]),
        quats=torch.tensor([[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]]),
        scales=torch.tensor([scales]),
        opacities=torch.tensor([0.7]),
        colors=torch.tensor([[0.9, 0.4, 0.2]]),
    )


def smooth_gradient() -> torch.Tensor:
    """[H, W, 3] gradient of the image that changes slowly, as the error of a blurred region does."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) / HEIGHT, torch.arange(WIDTH) / WIDTH, indexing="ij")
    waves = [torch.sin(2.1 * x + 1.3 * y), torch.cos(3.7 * x - 0.8 * y), torch.sin(1.1 * x * y + 2.9 * x)]
    return torch.stack(waves, -1)


def gradients_of_needle(elongation: float, angle: float, antialias: bool) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Gradients of scales and quaternion: of the kernels, and of the reference in double precision."""
    splats, camera, v_image = make_needle(elongation, angle), CAMERA, smooth_gradient()
    splats.scales.requires_grad_()
    splats.quats.requires_grad_()
    rendering = render(splats, camera, torch.zeros(3), RenderSettings(antialias=antialias))
    rendering.joint.image.backward(v_image)
    doubles = as_doubles(splats)
    image, *_ = reference(doubles, camera, torch.zeros(3, dtype=torch.float64), antialias=antialias)
    image.backward(v_image.double())
    return [(getattr(splats, name).grad.double(), doubles[name].grad) for name in ("scales", "quats")]


def errors_of_length(elongation: float, antialias: bool) -> torch.Tensor:
    """[16] relative errors of the gradient of the longest scale."""
    found = [gradients_of_needle(elongation, angle, antialias)[0] for angle in ORIENTATIONS]
    return torch.stack([(actual[0, 0] - wanted[0, 0]).abs() / wanted[0, 0].abs() for actual, wanted in found])


MAX_MEDIAN = {30.0: 1e-4, 100.0: 5e-4, 300.0: 5e-3, 1000.0: 2e-2}
"""Maximum median error by elongation: a few times what single precision of the image's gradient leaves."""


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("elongation", MAX_MEDIAN)
def test_the_gradient_of_the_length_of_a_needle_equals_the_reference(elongation, antialias):
    errors = errors_of_length(elongation, antialias)
    assert errors.median() < MAX_MEDIAN[elongation]
    assert errors.max() < 0.1


@pytest.mark.parametrize("antialias", [False, True])
def test_the_gradient_of_the_rotation_of_a_needle_equals_the_reference(antialias):
    pairs = [gradients_of_needle(300.0, angle, antialias)[1] for angle in ORIENTATIONS]
    errors = torch.stack([(actual - wanted).norm() / wanted.norm() for actual, wanted in pairs])
    assert errors.median() < 0.02


@pytest.mark.parametrize("angle", ORIENTATIONS[::4])
def test_a_needle_that_is_too_long_shrinks_to_the_length_of_its_target(angle):
    camera, background = CAMERA, torch.zeros(3)
    target = render(make_needle(40.0, angle), camera, background).joint.image
    needle = make_needle(200.0, angle)
    log_length = needle.scales[0, 0].log().requires_grad_()
    optimizer = torch.optim.Adam([log_length], lr=0.03)
    for _ in range(150):
        scales = torch.cat([log_length.exp()[None], needle.scales[0, 1:]])[None]
        image = render(dataclasses.replace(needle, scales=scales), camera, background).joint.image
        optimizer.zero_grad()
        (image - target).square().sum().backward()
        optimizer.step()
    assert log_length.exp().item() == pytest.approx(40.0 * THICKNESS * PIXEL, rel=0.02)
