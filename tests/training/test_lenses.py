"""Training on frames as a lens recorded them, without resampling."""

import dataclasses

import pytest

from tests import lens_captures, plain, tiny
from tests.lens_captures import CAMERAS, changed, undistorted
from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.evaluation.evaluate import evaluate
from warpgs.initialization.prepare_start import prepare_start
from warpgs.runs import checkpoint
from warpgs.runs.trained import TrainedScene
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


def test_recorded_frames_are_learned_at_least_as_well_as_undistorted_ones(capture, tmp_path):
    recorded = psnr(capture, capture, tmp_path / "recorded")
    assert recorded > psnr(changed(capture, undistorted), capture, tmp_path / "undistorted")
