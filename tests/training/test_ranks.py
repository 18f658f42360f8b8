"""Several processes that train one scene: equal scenes, one run folder, one line about an error."""

import dataclasses
import json
import shutil

import pytest
import torch

from tests import tiny, two_ranks
from tests.scenes import relative_error
from warpgs.config import TrainConfig
from warpgs.runs import checkpoint
from warpgs.runtime import ranks
from warpgs.training import optimizer
from warpgs.training import train as script
from warpgs.training.step import Sample

pytestmark = pytest.mark.usefixtures("quickly")
ON_TWO_GPUS = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="fewer than two CUDA devices")


def config_of(data, folder, **changes):
    return dataclasses.replace(tiny.CONFIG, data=data, out=folder / "run", checkpoint_every=5, **changes)


def results(folder, num=2):
    return [json.loads((folder / f"rank{k}.json").read_text()) for k in range(num)]


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """A folder with a run of two ranks without interruption, and with what each of them had."""
    folder = tmp_path_factory.mktemp("whole")
    assert two_ranks.start(folder, two_ranks.train, config_of(data, folder)) == [0, 0]
    return folder


# Equal scenes --------------------------------------------------------------------------------------------------------


def test_all_ranks_end_with_the_same_bits(whole):
    first, second = results(whole)
    assert first["iteration"] == second["iteration"] == tiny.LENGTH
    assert first["digest"] == second["digest"]


def test_the_ranks_densified_and_pruned_alike(whole):
    first, second = ([(step["static"], step["dynamic"]) for step in rank["steps"]] for rank in results(whole))
    assert first == second
    static = [counts[0] for counts in first]
    assert max(static) > static[0]
    assert static[-1] < max(static)


def test_every_view_is_visited_once_per_epoch_by_one_of_the_ranks(whole):
    views = [[step["view"] for step in rank["steps"]] for rank in results(whole)]
    together = [view for pair in zip(*views, strict=True) for view in pair]
    for epoch in range(len(together) // 6):
        assert sorted(together[6 * epoch : 6 * epoch + 6]) == list(range(6))


def test_a_step_averages_gradients_and_adds_statistics_over_the_ranks(data, tmp_path):
    folder = tmp_path / "ranks"
    assert two_ranks.start(folder, two_ranks.one_step, config_of(data, folder)) == [0, 0]
    alone = []
    for rank in range(2):
        trainer = tiny.trainer(data, tmp_path / str(rank))
        trainer.step(trainer.protocol.at(0), Sample(*torch.load(folder / f"sample{rank}.pt", weights_only=True)))
        trainer.iteration = 1
        trainer.save()
        alone.append(tiny.state(tmp_path / str(rank)))
    together = tiny.state(folder / "run")
    assert not torch.equal(alone[0]["gradients.total"], alone[1]["gradients.total"])
    for name in ("gradients.total", "gradients.count"):
        assert alone[0][name].any()
        torch.testing.assert_close(together[name], alone[0][name] + alone[1][name])
    nearest = torch.maximum(*(state["gradients.resolution"] for state in alone))
    torch.testing.assert_close(together["gradients.resolution"], nearest)
    assert all((nearest != state["gradients.resolution"]).any() for state in alone)
    beta = optimizer.BETAS[0]
    moments = [name for name in together if name.startswith("adam.exp_avg.") and together[name].any()]
    assert len(moments) > 4
    for name in moments:  # after one step: (1 − β) times the gradient
        mean = (alone[0][name] + alone[1][name]) / 2 / (1 - beta)
        assert relative_error(together[name] / (1 - beta**2), mean) < 1e-5


def test_a_step_is_as_much_larger_as_gsplat_and_grendel_scale_it(monkeypatch, data, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    networks = dict.fromkeys(optimizer.NETWORKS, 0.5)
    at = optimizer.RatePlan(0.5, 0.0, dict.fromkeys(optimizer.BRANCHES, 0.5), networks, networks)
    alone = optimizer.learning_rates(tiny.CONFIG.optim, 1.0, at)
    monkeypatch.setattr(ranks, "num_ranks", lambda: 4)
    scaled = optimizer.learning_rates(tiny.CONFIG.optim, 1.0, at)
    assert scaled == {name: 2.0 * rate for name, rate in alone.items()}
    adam = optimizer.make_optimizer(trainer.step.parameters(), tiny.equal_rates(0.1))
    assert adam.betas == pytest.approx((0.9**4, 0.999**4))
    assert adam.epsilon == optimizer.EPSILON / 2


def test_a_loss_of_one_rank_that_is_not_finite_rolls_all_back(data, tmp_path):
    assert two_ranks.start(tmp_path, two_ranks.train, config_of(data, tmp_path), None, 12) == [0, 0]
    first, second = results(tmp_path)
    assert "not finite after iteration 15: back to iteration 10" in (tmp_path / "rank0.out").read_text()
    assert len(first["steps"]) == len(second["steps"]) == tiny.LENGTH + 5
    assert first["digest"] == second["digest"]


# One run -------------------------------------------------------------------------------------------------------------


def test_the_first_rank_alone_writes_reports_and_evaluates(whole):
    first, second = results(whole)
    assert any("2 views per iteration" in line for line in first["lines"])
    assert "evaluated" in first["lines"]
    assert second["lines"] == two_ranks.errors(whole, 1) == []
    printed = (whole / "rank1.out").read_text().splitlines()
    assert [line for line in printed if not line.startswith("[Gloo]")] == []  # torch 2.8 says that ranks are connected
    assert len(list((whole / "run" / "events").iterdir())) == 1
    assert checkpoint.load(checkpoint.path_of(whole / "run", tiny.LENGTH)).metadata.iteration == tiny.LENGTH


def test_a_signal_to_one_rank_stops_all_with_a_checkpoint_from_which_they_continue(data, whole, tmp_path):
    folder, config = tmp_path / "ranks", config_of(data, tmp_path / "ranks")
    assert two_ranks.start(folder, two_ranks.train, config, 12) == [130, 130]
    assert [rank["iteration"] for rank in results(folder)] == [15, 15]
    assert checkpoint.list_checkpoints(folder / "run")[-1] == checkpoint.path_of(folder / "run", 15)
    lines = two_ranks.errors(folder, 0) + two_ranks.errors(folder, 1)
    assert lines == [
        f"warpgs: stopped after iteration 15 of {tiny.LENGTH}; continue with warpgs train --resume {folder / 'run'}"
    ]

    assert two_ranks.start(folder, two_ranks.train, TrainConfig(resume=folder / "run")) == [0, 0]
    assert tiny.differences(tiny.state(folder / "run"), tiny.state(whole / "run")) == []


def test_a_callback_is_called_on_the_first_rank_and_stops_all(data, tmp_path):
    assert two_ranks.start(tmp_path, two_ranks.train_with_callback, config_of(data, tmp_path)) == [0, 0]
    assert [rank["calls"] for rank in results(tmp_path)] == [[5], []]
    assert checkpoint.list_checkpoints(tmp_path / "run")[-1] == checkpoint.path_of(tmp_path / "run", 5)


def test_a_run_of_two_ranks_continues_with_one(data, whole, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    trainer.restore(checkpoint.path_of(whole / "run", 5))
    assert trainer.step.density.count.max() > 5  # of both ranks
    assert tiny.train(trainer)


def test_a_run_of_one_process_continues_with_two_ranks(data, tmp_path):
    config = config_of(data, tmp_path)
    alone = script.make_trainer(config)
    assert not tiny.train(alone, tiny.StopWhen(lambda: alone.iteration >= 9))
    assert two_ranks.start(tmp_path, two_ranks.train, TrainConfig(resume=tmp_path / "run")) == [0, 0]
    first, second = results(tmp_path)
    assert len(first["steps"]) == tiny.LENGTH - 9
    assert first["digest"] == second["digest"]


# Errors --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=ON_TWO_GPUS)])
def test_a_rank_that_is_killed_ends_the_others_with_one_line(data, tmp_path, device):
    """Also where its GPU waits."""
    config = dataclasses.replace(config_of(data, tmp_path), device=device)
    assert two_ranks.start(tmp_path, two_ranks.fail_in_step, config, "killed") == [2, -9]
    (line,) = two_ranks.errors(tmp_path, 0)
    assert line.startswith("warpgs train: another of the 2 processes ended, ")


def test_a_rank_that_fails_says_why_and_the_others_end_silently(data, tmp_path):
    assert two_ranks.start(tmp_path, two_ranks.fail_in_step, config_of(data, tmp_path), "raises") == [2, 2]
    assert two_ranks.errors(tmp_path, 0) == []
    assert two_ranks.errors(tmp_path, 1) == ["warpgs train: rank 1 has a reason"]


@pytest.mark.parametrize("difference", ["options", "points", "shutter", "circle"])
def test_ranks_with_different_options_or_captures_are_refused_in_one_line(data, tmp_path, difference):
    assert two_ranks.start(tmp_path, two_ranks.with_differences, config_of(data, tmp_path), difference) == [2, 2]
    what = "the options" if difference == "options" else "the capture"
    (line,) = two_ranks.errors(tmp_path, 0) + two_ranks.errors(tmp_path, 1)
    assert line == f"warpgs train: expected {what} to be the same on all ranks, rank 1 has another than rank 0"
    assert not (tmp_path / "run").exists()


def test_a_damaged_evaluation_frame_is_refused_in_one_line_of_the_rank_that_evaluates(data, tmp_path):
    data = shutil.copytree(data, tmp_path / "damaged")
    path = data / f"rgb/1x/{json.loads((data / 'dataset.json').read_text())['val_ids'][0]}.png"
    path.write_bytes(path.read_bytes()[:-20])
    assert two_ranks.start(tmp_path, two_ranks.by_command, config_of(data, tmp_path)) == [2, 2]
    assert two_ranks.errors(tmp_path, 0) == [f"warpgs train: {path} is truncated: its last chunk is cut off"]
    assert two_ranks.errors(tmp_path, 1) == []
    assert not (tmp_path / "run").exists()


def test_more_processes_than_gpus_are_refused(monkeypatch):
    monkeypatch.setattr(ranks, "num_ranks", lambda: 4)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    with pytest.raises(ValueError, match="started 4 processes on this machine, where torch sees 1 GPU: expected"):
        ranks.use_device("cuda")
    ranks.use_device("cpu")


def test_without_torchrun_nothing_is_shared():
    tensor = torch.ones(3)
    with ranks.joined():
        ranks.add_(tensor)
        ranks.copy_first_(tensor)
    assert tensor.tolist() == [1.0] * 3
    assert (ranks.num_ranks(), ranks.rank(), ranks.is_first()) == (1, 0, True)
    assert ranks.any_rank(True)
    assert not ranks.any_rank(False)
    assert ranks.text_of_first("run") == "run"


# On GPUs -------------------------------------------------------------------------------------------------------------


@ON_TWO_GPUS
@pytest.mark.parametrize("graph", [False, True])
def test_two_gpus_end_with_the_same_bits_and_a_run_that_opens(data, tmp_path, graph):
    config = dataclasses.replace(config_of(data, tmp_path, graph=graph), device="cuda")
    assert two_ranks.start(tmp_path, two_ranks.train, config) == [0, 0]
    first, second = results(tmp_path)
    assert first["digest"] == second["digest"]
    assert first["iteration"] == tiny.LENGTH
    assert checkpoint.load(checkpoint.path_of(tmp_path / "run", tiny.LENGTH)).metadata.iteration == tiny.LENGTH
