"""Training on frames as a lens recorded them, without resampling."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch

from tests import lens_captures, plain, tiny
from tests.lens_captures import CAMERAS, changed, undistorted
from warpgs.config import TrainConfig
from warpgs.data.capture import Capture, Frame
from warpgs.data.image_circle import with_image_circle
from warpgs.evaluation.evaluate import evaluate
from warpgs.initialization.prepare_start import prepare_start
from warpgs.rendering import Layer, Rendering
from warpgs.runs import checkpoint
from warpgs.runs.trained import TrainedScene
from warpgs.training.losses import only_shown
from warpgs.training.trainer import Trainer

CONFIG = dataclasses.replace(
    tiny.CONFIG,
    model=plain.model(position_bands=2, time_bands=2, depth=2, width=16, skip=1, dynamic_points=40, dropout=0.0),
    schedule=dataclasses.replace(tiny.SCHEDULE, pretrain=60, stage1=100, stage2=40, densify_until=60, reset_every=500),
    densify=plain.densify(every=20, gradient=1e-4, max_gaussians=800),
    checkpoint_every=1000,
)


@pytest.fixture(autouse=True)
def _in_haste():
    with tiny.in_haste():
        yield


@pytest.fixture(scope="module", params=CAMERAS)
def capture(request):
    return lens_captures.recorded(request.param)


def psnr(trained_on: Capture, evaluated_on: Capture, folder, config: TrainConfig = CONFIG) -> float:
    """Of the recorded evaluation frames after training."""
    trainer = Trainer(prepare_start(config, trained_on), folder)
    assert tiny.train(trainer)
    loaded = checkpoint.load(checkpoint.list_checkpoints(folder)[-1])
    scene = TrainedScene(trainer.scene, trainer.config, loaded.metadata)
    value = evaluate(scene, evaluated_on, quiet=True).summary()["psnr"]
    assert isinstance(value, float)
    return value


def test_training_on_recorded_frames_is_at_least_as_good_as_on_undistorted_frames(capture, tmp_path):
    recorded = psnr(capture, capture, tmp_path / "recorded")
    assert recorded > psnr(changed(capture, undistorted), capture, tmp_path / "undistorted")


def with_corners(colour: int) -> Capture:
    """A capture whose circle ends at 50 degrees, with corners in a colour that are dynamic if it is bright."""
    circle = math.radians(50.0)
    camera = CAMERAS["fisheye"]
    beyond = torch.acos(camera.rays(camera.pixel_centers)[:, 2]).reshape(camera.height, camera.width) > circle

    def change(frame: Frame) -> Frame:
        lens = dataclasses.replace(frame.camera.distortion, circle=circle)
        image = torch.where(beyond[..., None], colour, frame.image).to(torch.uint8)
        camera = dataclasses.replace(frame.camera, distortion=lens)
        depth = torch.where(beyond, colour / 100.0, frame.inverse_depth)
        mask = frame.static_mask & ~(beyond & (colour > 100))
        return dataclasses.replace(frame, camera=camera, image=image, inverse_depth=depth, static_mask=mask)

    return with_image_circle(changed(lens_captures.recorded("fisheye"), change))


def test_the_corners_around_a_circular_image_are_not_learned(tmp_path):
    scenes, config = [], dataclasses.replace(CONFIG, schedule=tiny.SCHEDULE)
    for colour in (100, 200):
        torch.manual_seed(0)
        trainer = Trainer(prepare_start(config, with_corners(colour)), tmp_path / str(colour))
        assert tiny.train(trainer)
        scenes.append(trainer.scene.state_dict())
    assert all(torch.equal(scenes[0][name], scenes[1][name]) for name in scenes[0])


def test_a_rendering_in_the_corners_around_a_circular_image_is_not_compared():
    capture = with_corners(100)
    frame = capture.frame(capture.val[0])
    truth, noise = frame.image / 255.0, torch.rand(frame.image.shape, generator=torch.Generator().manual_seed(0))
    inside = torch.where(frame.camera.shown[..., None], noise, 0.5)
    found, expected = (_values(image, capture.split(capture.train, capture.val[:1])) for image in (noise, inside))
    error = (noise - truth)[frame.camera.shown].square().mean()
    assert found["psnr"] == pytest.approx(-10.0 * math.log10(error), abs=1e-4)
    assert found == expected


def _values(image: torch.Tensor, capture: Capture) -> dict[str, float | None]:
    """Metrics of the only evaluation view if this is its rendering."""
    layer = Layer(image, torch.ones_like(image[..., 0]), None)
    scene = SimpleNamespace(
        device=torch.device("cpu"),
        render=lambda camera, branches: Rendering(layer, layer, layer, torch.zeros(0, 2), None, None, None),
        play=lambda camera: image,
    )
    (view,) = evaluate(scene, capture, quiet=True).views
    return view.values


def test_a_fisheye_view_without_images_of_the_branches_learns_nothing_outside_of_its_circle():
    shown = torch.arange(3 * 4).reshape(3, 4) % 3 > 0
    view = SimpleNamespace(shown=shown, image=torch.rand(3, 4, 3))
    joint = Layer(torch.rand(3, 4, 3), torch.ones(3, 4), None)
    rendering = Rendering(joint, None, None, torch.zeros(1, 2, dtype=torch.int32), None, None, None)
    kept = only_shown(rendering, view, torch.zeros(3))
    assert (kept.static, kept.dynamic) == (None, None)
    assert torch.equal(kept.joint.image[shown], joint.image[shown])
    assert torch.equal(kept.joint.image[~shown], view.image[~shown])
