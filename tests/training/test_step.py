"""A training step: its inputs by name, and that nothing but the phase and tensors decides what it does."""

import copy
import dataclasses
import inspect

import pytest
import torch

from tests import plain, tiny
from warpgs.ops.dropout import MAX_SEED
from warpgs.rendering import render
from warpgs.runtime import ranks
from warpgs.training import step
from warpgs.training.optimizer import GROUPS
from warpgs.training.sampling import Sampler
from warpgs.training.schedule import Phase
from warpgs.training.step import Step
from warpgs.training.step_inputs import StepInputs

pytestmark = pytest.mark.usefixtures("quickly")

CPU = torch.device("cpu")


def make_inputs():
    return StepInputs(("static", "psnr"), ("means", "networks"), CPU)


def send(inputs, **changes):
    values = {
        "time_noise": 0.5,
        "dropout_seed": 2**24 - 1,
        "color": (0.25, 0.5, 0.75),
        "scales": {"psnr": -10.0, "static": 2.0},
        "learning_rates": {"networks": 4.0, "means": 3.0},
    }
    inputs.send(**{**values, **changes})


def test_inputs_reach_the_tensors_of_their_names():
    inputs = make_inputs()
    send(inputs)
    assert inputs.time_noise.tolist() == [0.5]
    assert inputs.dropout_seed.tolist() == [2**24 - 1]
    assert inputs.color.tolist() == [0.25, 0.5, 0.75]
    assert {name: value.item() for name, value in inputs.scale.items()} == {"static": 2.0, "psnr": -10.0}
    assert inputs.scales.tolist() == [2.0, -10.0]
    assert {name: value.item() for name, value in inputs.learning_rates.items()} == {"means": 3.0, "networks": 4.0}


def test_inputs_stay_at_their_addresses():
    inputs = make_inputs()
    tensors = [inputs.time_noise, inputs.scales, *inputs.scale.values()]
    addresses = [tensor.data_ptr() for tensor in tensors]
    send(inputs, time_noise=0.75)
    assert inputs.time_noise is tensors[0]
    assert inputs.time_noise.item() == 0.75
    assert [tensor.data_ptr() for tensor in tensors] == addresses


@pytest.mark.parametrize("name", ["scales", "learning_rates"])
def test_a_missing_input_is_an_error(name):
    with pytest.raises(KeyError):
        send(make_inputs(), **{name: {}})


class RecordedWork:
    """Stands in for ``GraphCache`` on the CPU: the work of the first run of each phase is run in all later ones."""

    def __init__(self):
        self.work = {}

    def run(self, phase, work):
        return self.work.setdefault(phase, work)()

    def invalidate(self):
        pass


def trained(data, folder, graphs=None, **changes):
    """All tensors of a run that used ``graphs`` throughout."""
    make_step = Step.__init__

    def with_graphs(step, *arguments):
        make_step(step, *arguments)
        step._graphs = graphs and graphs()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Step, "__init__", with_graphs)
        assert tiny.train(tiny.trainer(data, folder, dataclasses.replace(tiny.CONFIG, **changes)))
    return tiny.state(folder)


def test_work_recorded_in_the_first_iteration_of_a_phase_serves_all_others_bit_for_bit(data, tmp_path):
    """A CUDA graph does that; so a step reads nothing of its plan but the phase, and everything else from tensors."""
    eager, recorded = trained(data, tmp_path / "eager"), trained(data, tmp_path / "recorded", RecordedWork)
    assert tiny.differences(eager, recorded) == []


def test_training_on_views_from_disk_is_the_same_bit_for_bit(data, tmp_path):
    kept, read = trained(data, tmp_path / "kept"), trained(data, tmp_path / "read", RecordedWork, resident_bytes=0)
    assert tiny.differences(kept, read) == []


def test_plans_with_equal_phases_share_a_graph(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    trainer._add_dynamic_gaussians()
    trainer.step._graphs = graphs = RecordedWork()
    iterations = range(trainer.protocol.stage2.start, trainer.protocol.num_iterations)
    for trainer.iteration in iterations:
        plan = trainer.protocol.at(trainer.iteration)
        trainer.step(plan, trainer._sample(plan))
    plans = [trainer.protocol.at(k) for k in iterations]
    assert len({plan.progress for plan in plans}) == len(plans)
    assert set(graphs.work) == {plans[0].phase}


def test_the_work_of_a_step_is_given_a_phase_only():
    parameters = inspect.signature(Step._run).parameters
    assert list(parameters) == ["self", "phase"]
    assert parameters["phase"].annotation is Phase


def test_a_step_does_not_keep_its_plan(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    plan = trainer.protocol.at(0)
    before = dict(vars(trainer.step))
    trainer.step(plan, trainer._sample(plan))
    assert {name: id(value) for name, value in vars(trainer.step).items()} == {n: id(v) for n, v in before.items()}


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(Phase)])
def test_phases_that_differ_in_one_field_are_different_keys(field):
    phase = plain.phase(with_depth=True, use_dropout=True, densifies=True)
    other = dataclasses.replace(phase, **{field: "stage2" if field == "stage" else 0})
    assert len({phase, other}) == 2


@pytest.mark.parametrize(("stage", "omits"), [("pretrain", False), ("stage1", True), ("stage2", True)])
def test_gaussians_are_omitted_at_random_once_both_branches_are_trained(data, tmp_path, stage, omits):
    trainer = tiny.trainer(data, tmp_path)
    trainer._add_dynamic_gaussians()
    plan = trainer.protocol.at(getattr(trainer.protocol, stage).start)
    sample, state, losses = trainer._sample(plan), copy.deepcopy(trainer.scene.state_dict()), []
    for seed in (1, 2):
        trainer.scene.load_state_dict(state)
        trainer.step(plan, sample._replace(dropout_seed=seed))
        losses.append(trainer.step.take_means().loss)
    assert (losses[0] == losses[1]) == (not omits)


def test_each_iteration_and_each_rank_omits_other_gaussians(monkeypatch):
    sampler, seeds = Sampler(0, 6), []
    for rank in range(2):
        monkeypatch.setattr(ranks, "rank", lambda rank=rank: rank)
        seeds += [sampler(k, 0, 0.0).dropout_seed for k in range(10)]
    assert len(set(seeds)) == 20
    assert all(0 <= seed < MAX_SEED for seed in seeds)


@pytest.mark.parametrize("compared", ["yes", "no"])
def test_the_images_of_the_branches_are_rendered_where_they_are_compared(data, tmp_path, monkeypatch, compared):
    loss = dataclasses.replace(tiny.CONFIG.loss, branches_in_stage2=compared)
    trainer = tiny.trainer(data, tmp_path, dataclasses.replace(tiny.CONFIG, loss=loss))
    trainer._add_dynamic_gaussians()
    rendered = []

    def recorded(*arguments):
        rendered.append(rendering := render(*arguments))
        return rendering

    monkeypatch.setattr(step, "render", recorded)
    for stage in (trainer.protocol.stage1, trainer.protocol.stage2):
        plan = trainer.protocol.at(stage.start)
        trainer.step(plan, trainer._sample(plan))
    has_images = [rendering.static is not None and rendering.dynamic is not None for rendering in rendered]
    assert has_images == [True, compared == "yes"]


@pytest.mark.parametrize("hidden_appearance", [True, False])
def test_the_joint_image_trains_hidden_appearance_only_if_asked_to(data, tmp_path, monkeypatch, hidden_appearance):
    loss = dataclasses.replace(tiny.CONFIG.loss, branches_in_stage2="no", hidden_appearance=hidden_appearance)
    trainer = tiny.trainer(data, tmp_path, dataclasses.replace(tiny.CONFIG, loss=loss))
    trainer._add_dynamic_gaussians()
    plan, appearance = trainer.protocol.at(trainer.protocol.stage2.start), trainer.scene.appearance.trunk.values
    for is_hidden in (True, False):
        all_of_them = torch.full((len(trainer.scene.static),), is_hidden)
        monkeypatch.setattr(trainer.step, "_is_hidden", lambda view, all_of_them=all_of_them: all_of_them)
        before = appearance.detach().clone()
        trainer.step(plan, trainer._sample(plan))
        assert torch.equal(appearance, before) == (is_hidden and not hidden_appearance)


def test_gaussians_behind_dynamic_pixels_are_hidden(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    trainer.views._all.static_mask[0, :, :10] = False
    view, means = trainer.views[0], trainer.scene.static.means
    camera, generator = view.camera, torch.Generator().manual_seed(0)
    row, column, depth = (torch.randint(-5, 40, (len(means),), generator=generator) for _ in range(3))
    means.data = camera.unproject(row, column, depth + 0.5)
    expected = []
    for y, x, z in zip(row.tolist(), column.tolist(), depth.tolist(), strict=True):
        is_inside = z >= 0 and 0 <= x < camera.width and 0 <= y < camera.height
        expected.append(is_inside and not view.static_mask[y, x])
    assert trainer.step._is_hidden(view).tolist() == expected
    assert 0 < sum(expected) < len(expected)


def test_every_parameter_group_has_a_learning_rate(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    assert [group["name"] for group in trainer.step.optimizer.param_groups] == list(GROUPS)
