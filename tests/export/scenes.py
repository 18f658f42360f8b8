"""Small clouds and a small trained scene for tests."""

import dataclasses

import torch

from tests import plain, tiny
from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.export.clouds import Clouds
from warpgs.formats.cloud import Cloud
from warpgs.model.gaussians import Gaussians
from warpgs.model.scene import SplitScene
from warpgs.model.splats import Splats
from warpgs.rendering import render
from warpgs.runs.checkpoint import Metadata
from warpgs.runs.trained import TrainedScene

METADATA = Metadata(iteration=32, use_deformation=True, use_appearance=True, sh_degree=1)


def cloud(num, degree=1, seed=0):
    """Gaussians in front of ``camera()``, the second half of them dynamic."""
    random = torch.Generator().manual_seed(seed)
    splats = Splats(
        means=torch.rand(num, 3, generator=random) * 2 - 1,
        quats=torch.nn.functional.normalize(torch.randn(num, 4, generator=random), dim=1),
        scales=torch.rand(num, 3, generator=random) * 0.15 + 0.02,
        opacities=torch.rand(num, generator=random) * 0.9 + 0.05,
        sh=torch.randn(num, (degree + 1) ** 2, 3, generator=random) * 0.3,
        is_dynamic=torch.arange(num) >= num // 2,
    )
    return Cloud.of_splats(splats)


def camera(width=64, height=48, time=0.0):
    origin, up = torch.tensor([0.0, 0.0, -3.0]), torch.tensor([0.0, -1.0, 0.0])
    return Camera.looking_at(origin, torch.zeros(3), up, 60.0 * width / 64, (width, height), time)


def image(cloud, through=None):
    with torch.no_grad():
        settings = RenderSettings(antialias=cloud.antialias)
        return render(cloud.splats(), through or camera(), settings=settings).joint.image.clamp(0, 1)


def psnr(a, b):
    return float(-10 * torch.log10((a - b).square().mean().clamp_min(1e-12)))


def refusal(read, path):
    """The message of the reader's ValueError; None if the file is read. Any other error fails the test."""
    try:
        read(path)
    except ValueError as error:
        return str(error)
    return None


def clouds(num_static=40, num_dynamic=20, seed=0):
    """The clouds of ``trained_scene``."""
    return Clouds(trained_scene(num_static, num_dynamic, seed))


def segmented():
    """The clouds of a scene with two segments of time, which have every second dynamic Gaussian each, for exports."""
    scene = trained_scene(segments=2)
    scene.scene.deformation.is_complete = True
    return Clouds(scene)


def trained_scene(num_static=40, num_dynamic=20, seed=0, segments=1):
    """A scene whose networks have a visible effect."""
    torch.manual_seed(seed)
    model = dataclasses.replace(tiny.MODEL, segments=segments)
    scene = SplitScene.empty(num_static, num_dynamic, model)
    for part in (scene.static, scene.dynamic):
        part.load_state_dict(_random(len(part)).state_dict(), strict=part.segments is None)
    if segments > 1:
        scene.dynamic.segments = torch.arange(num_dynamic) % segments
    for field in (scene.deformation, scene.appearance):
        for parameter in field.parameters():
            torch.nn.init.normal_(parameter, std=0.15)
    return TrainedScene(scene.requires_grad_(False), plain.plan(plain.config(model=model)), METADATA)


def _random(num):
    points, colors = torch.rand(num, 3) * 2 - 1, torch.rand(num, 3)
    gaussians = Gaussians.from_points(points, colors, torch.rand(num) * 0.1 + 0.05, 0.7, 1)
    torch.nn.init.normal_(gaussians.sh_rest, std=0.1)
    torch.nn.init.normal_(gaussians.quats)
    return gaussians
