"""Density control by absolute gradients."""

import copy
import dataclasses

from tests import tiny


def gradients(data, folder, strategy):
    """Mean gradient of every Gaussian after the first iteration."""
    densify = dataclasses.replace(tiny.CONFIG.densify, strategy=strategy)
    trainer = tiny.trainer(data, folder, dataclasses.replace(tiny.CONFIG, densify=densify))
    before = copy.deepcopy(trainer.scene.state_dict())
    plan = trainer.protocol.at(0)
    trainer.step(plan, trainer._sample(plan))
    changed = {name: tensor - before[name] for name, tensor in trainer.scene.state_dict().items()}
    return trainer.step.density.mean(), changed


def test_absolute_gradients_are_larger_and_nothing_else_changes(data, tmp_path):
    (plain, change), (absolute, same) = (gradients(data, tmp_path / name, name) for name in ("3dgs", "absgrad"))
    shown = plain > 0
    assert shown.any()
    assert (absolute[shown] > 0.99 * plain[shown]).all()
    assert absolute.sum() > 1.5 * plain.sum()
    assert tiny.differences(change, same) == []
