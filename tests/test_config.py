"""Numbers out of range are refused by name before training starts."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests import plain
from tests.scenes import make_camera
from warpgs.config import LossConfig, ModelConfig, TrainConfig, scaled, validate
from warpgs.config.presets import PRESETS
from warpgs.data.capture import Capture
from warpgs.initialization.plan import determined_bands, make_plan
from warpgs.training.command import parse


def changed(name, value, config=PRESETS["paper"]):
    first, _, rest = name.partition(".")
    return dataclasses.replace(config, **{first: changed(rest, value, getattr(config, first)) if rest else value})


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_are_valid(name):
    validate(PRESETS[name])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("checkpoint_every", 0),
        ("densify.every", 0),
        ("densify.gradient", -1e-4),
        ("densify.weakest", 1.0),  # would leave no Gaussian
        ("model.depth", 0),
        ("model.width", -4),
        ("model.max_static_points", -1),
        ("optim.means", -1.0),
        ("optim.means", float("nan")),
        ("optim.networks_end", 0.0),
        ("loss.depth", float("inf")),
        ("schedule.sh_degree_every", 0),
        ("factor", 0),
        ("max_alpha", 0.0),
        ("max_alpha", 0.9999),  # no Gaussian of this alpha would be composited
        ("model.width", 100_000),
        ("model.depth", 65),
        ("model.time_bands", 10**9),
        ("resident_bytes", 10**400),
        ("loss.ssim", 1e300),
    ],
)
def test_a_number_out_of_its_range_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be "):
        scaled(changed(name, value))


def test_an_sh_degree_above_3_is_refused():
    with pytest.raises(ValueError, match=r"expected model\.sh_degree <= 3, got 4"):
        validate(changed("model.sh_degree", 4))


@pytest.mark.parametrize("size", [(0, 128), (4, 0), (65, 128), (4, 4097)])
def test_a_size_of_the_appearance_network_that_cannot_be_is_refused(size):
    with pytest.raises(
        ValueError, match=r"each number of model\.appearance_size must be a number of at (least 1|most)"
    ):
        validate(changed("model.appearance_size", size))


@pytest.mark.parametrize("bands", ["position_bands", "time_bands"])
def test_networks_without_any_input_of_position_or_time_are_refused(bands):
    model = ModelConfig(**{bands: 0})
    validate(TrainConfig(model=model))
    with pytest.raises(ValueError, match=r"without model\.raw_input the networks need"):
        validate(TrainConfig(model=dataclasses.replace(model, raw_input=False)))


def test_a_schedule_with_only_pretraining_is_refused():
    schedule = dataclasses.replace(TrainConfig().schedule, stage1=0, stage2=0)
    with pytest.raises(ValueError, match="nothing to train"):
        validate(dataclasses.replace(TrainConfig(), schedule=schedule))


def test_the_config_imports_neither_torch_nor_numpy():
    program = "import sys; import warpgs.config; print({'torch', 'numpy'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout == "set()\n"


def test_a_config_of_defaults_is_the_preset_best():
    assert TrainConfig() == PRESETS["best"]
    assert all(config.preset == name for name, config in PRESETS.items())


@pytest.mark.parametrize(
    ("arguments", "preset"),
    [([], "quick"), (["--data", "capture"], "best"), (["--data", "capture", "--preset", "paper"], "paper")],
)
def test_the_default_preset_depends_on_whether_there_is_a_capture(arguments, preset):
    config = parse(arguments)
    assert config == dataclasses.replace(PRESETS[preset], data=Path("capture") if arguments else None)
    assert config.preset == preset


@pytest.mark.parametrize(
    ("num_frames", "bands"), [(75, 6), (65, 6), (64, 5), (12, 3), (3, 1), (2, 1), (1, 1), (10_000, 10)]
)
def test_frequencies_of_time_are_those_that_the_frames_determine(num_frames, bands):
    """The highest one has a period of at least 4 frames: 2 (T − 1) / 2ᵏ ≥ 4."""
    model = ModelConfig(time_bands=10, min_period=4.0)
    assert determined_bands(model, num_frames) == bands
    assert bands == 1 or 2 * (num_frames - 1) / 2 ** (bands - 1) >= 4.0


def test_cameras_at_one_time_do_not_determine_more_frequencies():
    """Three cameras with small offsets see 20 times each."""
    moments = {f"{i} {k}": (i, (k + 0.1 * i) / 20) for k in range(20) for i in range(3)}
    cameras = {name: dataclasses.replace(make_camera(), id=i, time=t) for name, (i, t) in moments.items()}
    capture = Capture("rig", cameras, [*cameras], [], torch.zeros(0, 3), None, no_frame)
    config = plain.config(model=ModelConfig(time_bands=10, min_period=4.0))
    assert make_plan(config, capture)[0].model.time_bands == determined_bands(config.model, 21) == 4


def no_frame(name):
    raise AssertionError(name)


@pytest.mark.parametrize("assume", ["masks", "dynamic"])
@pytest.mark.parametrize("asked", ["yes", "no", "given-masks"])
@pytest.mark.parametrize("estimated", [False, True])
def test_stage_2_compares_branches_unless_masks_are_estimates(assume, asked, estimated):
    cameras = {"a": make_camera()}
    capture = Capture("shot", cameras, ["a"], [], torch.zeros(0, 3), None, no_frame, estimated_masks=estimated)
    plan, notes, _ = make_plan(plain.config(assume=assume, loss=LossConfig(branches_in_stage2=asked)), capture)
    distrusted = asked == "given-masks" and estimated and assume == "masks"
    assert plan.branches_in_stage2 == (asked != "no" and not distrusted)
    assert [note.partition(":")[0] for note in notes] == (["the masks are estimates"] if distrusted else [])


@pytest.mark.parametrize(("num", "rate"), [(1, 1.25e-5), (8, 1e-4), (40, 5e-4), (80, 1e-3), (200, 1e-3)])
def test_corrections_of_poses_are_slower_for_few_frames(num, rate):
    shift = torch.zeros(4, 4)
    shift[0, 3] = 0.01
    still = make_camera()
    moving = {f"{k}": dataclasses.replace(still, viewmat=still.viewmat + k * shift) for k in range(num)}
    cameras = moving | {f"{k} again": camera for k, camera in moving.items()}
    capture = Capture("shot", cameras, list(cameras), [], torch.zeros(0, 3), None, no_frame)
    plan, notes, _ = make_plan(plain.config(optim=plain.optim(poses=1e-3)), capture)
    assert plan.optim.poses == pytest.approx(rate)
    said = f"corrections of {num} pose{'s' * (num > 1)} learn at {rate:.1e}: each is seen often"
    assert (said in notes) == (rate < 1e-3)


def test_without_a_minimum_period_all_frequencies_are_used():
    assert determined_bands(ModelConfig(time_bands=10, min_period=0.0), 3) == 10
    assert determined_bands(ModelConfig(time_bands=0, min_period=4.0), 3) == 0
