"""Captures of every layout are trained on, through all stages."""

import dataclasses

import pytest

from tests import tiny
from tests.data import layouts

pytestmark = pytest.mark.usefixtures("quickly")


@pytest.mark.parametrize("layout", layouts.WRITERS)
def test_training_runs_through_all_stages(layout, tmp_path):
    data = layouts.WRITERS[layout](tmp_path / "capture")
    schedule = dataclasses.replace(tiny.SCHEDULE, pretrain=2, stage1=2, stage2=1, prune_every=50)
    assume = "dynamic" if layout == "megasam" else "masks"
    config = dataclasses.replace(tiny.CONFIG, assume=assume, schedule=schedule)
    trainer = tiny.trainer(data, tmp_path / "run", config)
    assert tiny.train(trainer)
    assert len(trainer.scene.dynamic) > 0
    assert (len(trainer.scene.static) == 0) == (layout in ("megasam", "blender"))
