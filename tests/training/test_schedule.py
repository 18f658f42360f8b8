"""What every iteration does: the stages and everything that depends on the iteration."""

import dataclasses
from fractions import Fraction
from typing import get_args

import pytest

from tests import plain
from warpgs.config import scaled
from warpgs.config.presets import PRESETS
from warpgs.training.loss_terms import TERMS
from warpgs.training.schedule import Action, Phase, Protocol

SHORT = plain.schedule(
    pretrain=20,
    stage1=100,
    stage2=80,
    densify_from=15,
    densify_until=60,
    reset_every=20,
    prune_every=30,
    fit_motion=0,
    deform_from=25,
    appearance_from=35,
    noise_until=40,
    sh_degree_every=12,
)
CONFIG = plain.config(
    schedule=SHORT,
    densify=plain.densify(every=10),
    model=plain.model(sh_degree=3),
    loss=plain.loss(depth=2.0, depth_end=0.02),
)
STAGE1, STAGE2, END = 20, 120, 200
"""First iterations of the stages of ``SHORT``, and its length."""


def protocol(has_depth=True, schedule=None, **changes):
    config = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SHORT, **(schedule or {})), **changes)
    return Protocol(config, has_depth)


def plans(*arguments, **changes):
    made = protocol(*arguments, **changes)
    return [made.at(iteration) for iteration in range(made.num_iterations)]


def iterations_where(name, **changes):
    """The iterations whose plan, or its phase, has a true attribute of this name."""
    return [i for i, value in enumerate(values_of(name, **changes)) if value]


def iterations_that(action, **changes):
    """The iterations after which this is done."""
    return [i for i, plan in enumerate(plans(**changes)) if action in plan.actions]


def values_of(name, **changes):
    """The attribute of this name of every plan, or of its phase; of a dictionary the value of a key after a dot."""
    name, _, key = name.partition(".")
    values = [getattr(plan if hasattr(plan, name) else plan.phase, name) for plan in plans(**changes)]
    return [value[key] for value in values] if key else values


def boundaries(made):
    """Names of the stages that are not empty, with their first and last iterations."""
    stages = [(s.name, s.start, s.end - 1) for s in (made.pretrain, made.stage1, made.stage2) if s.end > s.start]
    for name, first, last in stages:
        assert {made.at(first).phase.stage, made.at(last).phase.stage} == {name}
    return stages


def test_the_protocol_of_the_paper_has_2k_30k_and_40k_iterations():
    stages = boundaries(Protocol(PRESETS["paper"], has_depth=True))
    assert stages == [("pretrain", 0, 1_999), ("stage1", 2_000, 31_999), ("stage2", 32_000, 71_999)]


def test_every_iteration_belongs_to_the_stage_it_lies_in():
    names = [plan.phase.stage for plan in plans()]
    assert names == ["pretrain"] * 20 + ["stage1"] * 100 + ["stage2"] * 80


WHOLE = [("pretrain", 0, 19), ("stage1", 20, 119), ("stage2", 120, 199)]
WITHOUT_PRETRAINING = [("stage1", 0, 119), ("stage2", 120, 199)]


@pytest.mark.parametrize(
    ("changes", "stages"),
    [
        ({"omit": ("vdp",)}, WHOLE),
        ({"omit": ("app",)}, WHOLE),
        ({"has_depth": False}, WITHOUT_PRETRAINING),
        ({"omit": ("dap",)}, WITHOUT_PRETRAINING),
        ({"has_depth": False, "omit": ("dap",)}, WITHOUT_PRETRAINING),
        ({"omit": ("stage2",)}, [("pretrain", 0, 19), ("stage1", 20, 199)]),
        ({"omit": ("dap", "stage2")}, [("stage1", 0, 199)]),
    ],
    ids=str,
)
def test_stage_1_takes_the_iterations_of_stages_that_are_switched_off(changes, stages):
    made = protocol(**changes)
    assert boundaries(made) == stages
    assert made.num_iterations == END


def test_equal_phases_are_equal_keys():
    """A CUDA graph is captured once per phase."""
    made = [plan.phase for plan in plans()]
    assert {type(phase) for phase in made} == {Phase}
    assert made[STAGE2] == made[END - 1]
    assert hash(made[STAGE2]) == hash(made[END - 1])
    assert len(set(made)) == 9  # three stages, three increments of the SH degree, two networks, no more densification


def test_gaussians_of_the_preset_best_settle_in_the_last_sixth():
    schedule = PRESETS["best"].schedule
    assert schedule.settle == (schedule.stage1 + schedule.stage2) / 6


def iterations_with_joint_term(**changes):
    is_active = TERMS["joint"].is_active
    return [i for i, plan in enumerate(plans(**changes)) if is_active(plan.phase, CONFIG.loss)]


@pytest.mark.parametrize("omit", [(), ("app",)])
def test_the_joint_term_is_active_in_stage_2_only(omit):
    assert iterations_with_joint_term(omit=omit) == list(range(STAGE2, END))


BRANCH_TERMS = {"static", "dynamic", "depth", "depth_dynamic"}


@pytest.mark.parametrize("keeps", [True, False])
def test_in_stage_2_the_terms_of_single_branches_can_end(keeps):
    loss, config = CONFIG.loss, dataclasses.replace(CONFIG, schedule=SHORT)
    found = Protocol(config, has_depth=True, branches_in_stage2=keeps)
    before, after = (found.at(iteration).phase for iteration in (STAGE1, STAGE2))
    terms = {name: TERMS[name] for name in (*BRANCH_TERMS, "joint")}
    assert {name for name, term in terms.items() if term.is_active(before, loss)} == BRANCH_TERMS
    active = {name for name, term in terms.items() if term.is_active(after, loss)}
    assert active == ({*BRANCH_TERMS, "joint"} if keeps else {"joint"})


def test_without_stage_2_there_is_no_joint_term():
    assert iterations_with_joint_term(omit=("stage2",)) == []


@pytest.mark.parametrize("degree", range(4))
def test_the_sh_degree_never_exceeds_that_of_the_model(degree):
    degrees = {plan.phase.sh_degree for plan in plans(model=plain.model(sh_degree=degree))}
    assert degrees == set(range(degree + 1))


def test_noise_until_iteration_0_ends_after_one_iteration():
    noise = values_of("time_noise", schedule={"noise_until": 0})
    assert max(noise[STAGE1 + 1 :]) == 0.0


def test_the_depth_weight_may_decay_to_zero():
    weights = values_of("depth_weight", loss=plain.loss(depth=2.0, depth_end=0.0))
    assert weights[0] == pytest.approx(2.0)
    assert weights[-1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("branch", ["static", "dynamic"])
def test_by_default_the_rate_of_positions_decays_over_the_run(branch):
    assert values_of(f"means_progress.{branch}") == values_of("progress")


def test_a_deformation_that_was_fitted_to_points_is_in_use_from_the_start_of_stage_1():
    made = protocol(schedule={"fit_motion": 5})
    assert [made.phase_at(k).use_deformation for k in (STAGE1 - 1, STAGE1)] == [False, True]
    assert not protocol().phase_at(STAGE1).use_deformation


# After iteration i of a run, i + 1 − STAGE1 iterations of stage I are done.


def after(*done):
    return [STAGE1 + number - 1 for number in done]


DROPPING = {"model": dataclasses.replace(CONFIG.model, dropout=0.1)}
NEEDLES = {"densify": plain.densify(every=50, max_elongation=10.0)}
WEAKEST = {"densify": plain.densify(every=10, weakest=0.02)}
WAITING = {"schedule": {"appearance_from": None}}
LATE = {"schedule": {"appearance_from": 1000, "deform_from": 1000}}
SETTLING = {"schedule": {"settle": 30}}
OFTEN = {"schedule": {"prune_every": 10, "warmup": 20}}
RESEED = {"densify": plain.densify(every=10, reseed=0.05), **OFTEN}
NO_DEPTH = {"loss": plain.loss(depth=0.0)}


def last(first):
    return list(range(first, END))


FLAGS = {
    "appearance: from its iteration of stage 1 on": ("use_appearance", {}, last(STAGE1 + 35)),
    "appearance: likewise without stage 2": ("use_appearance", {"omit": ("stage2",)}, last(STAGE1 + 35)),
    "appearance: at the latest from stage 2 on": ("use_appearance", LATE, last(STAGE2)),
    "appearance: can wait for stage 2": ("use_appearance", WAITING, last(STAGE2)),
    "appearance: can wait for stage 2 without depth": ("use_appearance", {"has_depth": False, **WAITING}, last(STAGE2)),
    "appearance: never without the stage 2 it waits for": ("use_appearance", {"omit": ("stage2",), **WAITING}, []),
    "appearance: never if it is switched off": ("use_appearance", {"omit": ("app",)}, []),
    "deformation: from its iteration of stage 1 on": ("use_deformation", {}, last(STAGE1 + 25)),
    "deformation: likewise without stage 2": ("use_deformation", {"omit": ("stage2",)}, last(STAGE1 + 25)),
    "deformation: at the latest from stage 2 on": ("use_deformation", LATE, last(STAGE2)),
    "dropout: from stage 1 on": ("use_dropout", DROPPING, last(STAGE1)),
    "dropout: until Gaussians settle": ("use_dropout", {**DROPPING, **SETTLING}, list(range(STAGE1, END - 30))),
    "dropout: not unless asked to": ("use_dropout", SETTLING, []),
    "densification: until its last iteration": ("densifies", {}, list(range(STAGE1 + 60))),
    "densification: never in stage 2": ("densifies", {"schedule": {"densify_until": 1000}}, list(range(STAGE2))),
    "settling: not unless asked to": ("settle_progress", {"schedule": {"settle": 0}}, []),
    "depth weight: without pretraining, too": ("depth_weight", {"omit": ("dap",)}, last(0)),
    "depth weight: none without depth": ("depth_weight", {"has_depth": False}, []),
    "depth weight: none without depth and pretraining": ("depth_weight", {"has_depth": False, "omit": ("dap",)}, []),
    "depth weight: none if it is zero": ("depth_weight", NO_DEPTH, []),
    "depth: not rendered if there is none": ("with_depth", {"has_depth": False}, []),
    "depth: not rendered without depth and pretraining": ("with_depth", {"has_depth": False, "omit": ("dap",)}, []),
    "depth: not rendered if its weight is zero": ("with_depth", NO_DEPTH, []),
}


@pytest.mark.parametrize(("name", "changes", "expected"), FLAGS.values(), ids=FLAGS)
def test_parts_of_a_step_are_in_use_when_the_schedule_says(name, changes, expected):
    assert iterations_where(name, **changes) == expected


ACTIONS = {
    "densify: at intervals in a range of stage 1": ("densify", {}, after(20, 30, 40, 50, 60)),
    "densify: never in stage 2": ("densify", {"schedule": {"densify_until": 1000}}, after(*range(20, 101, 10))),
    "reset: at intervals before the last densification": ("reset", {}, after(20, 40)),
    "prune: at intervals and at the end of stage 1": ("prune", {}, after(30, 60, 90, 100)),
    "prune: never if it is switched off": ("prune", {"omit": ("vdp",)}, []),
    "prune: without stage 2 not after the last iteration": (
        "prune",
        {"omit": ("stage2",)},
        after(30, 60, 90, 120, 150),
    ),
    "weakest: once densification has ended": ("prune_weakest", WEAKEST, after(60, 90, 100)),
    "weakest: also without pruning by visibility": ("prune_weakest", {**WEAKEST, "omit": ("vdp",)}, after(60, 90, 100)),
    "weakest: without stage 2, too": ("prune_weakest", {**WEAKEST, "omit": ("stage2",)}, after(60, 90, 120)),
    "weakest: not unless asked to": ("prune_weakest", {}, []),
    "shorten: at intervals and at the end": ("shorten", NEEDLES, [STAGE1 - 1, *after(50, 100, 150), END - 1]),
    "shorten: not unless asked to": ("shorten", {}, []),
    "reseed: while densifying, once the deformation has warmed up": ("reseed", RESEED, after(50)),
    "reseed: not unless asked to": ("reseed", OFTEN, []),
    "realign: in the middle of the pretraining": ("realign", {}, [9]),
    "realign: also in the shortest pretraining": ("realign", {"schedule": {"pretrain": 1}}, [0]),
    "realign: never without pretraining": ("realign", {"omit": ("dap",)}, []),
}


@pytest.mark.parametrize(("action", "changes", "expected"), ACTIONS.values(), ids=ACTIONS)
def test_actions_follow_the_iterations_that_the_schedule_says(action, changes, expected):
    assert iterations_that(action, **changes) == expected


def test_actions_are_done_in_the_order_of_their_type():
    made = protocol(**WEAKEST, schedule={"prune_every": 10, "reset_every": 10}).at(after(30)[0])
    assert made.actions == tuple(action for action in get_args(Action) if action in ("densify", "prune", "reset"))


@pytest.mark.parametrize("action", get_args(Action))
def test_statistics_start_anew_after_actions_that_add_or_remove_gaussians(action):
    plan = dataclasses.replace(protocol().at(0), actions=(action,))
    assert plan.replaces_gaussians == (action not in ("realign", "shorten", "reset"))


def test_iterations_that_are_done_count_from_the_start_of_stage_1():
    assert values_of("done") == list(range(1 - STAGE1, END - STAGE1 + 1))


@pytest.mark.parametrize("changes", [changes for name, changes, _ in FLAGS.values() if name == "use_appearance"])
def test_iterations_with_the_appearance_network_cost_twice_as_much_as_others(changes):
    costs, doubled = protocol(**changes).remaining_cost, iterations_where("use_appearance", **changes)
    assert [costs(k) - costs(k + 1) for k in range(END)] == [2 if k in doubled else 1 for k in range(END)]
    assert costs(END) == 0


def rising_from(first):
    """Rises linearly from 0 at an iteration to 1 at the end of the run."""
    return [0.0] * first + [k / (END - first) for k in range(END - first)]


TRAINED = {"optim": plain.optim(means_anneal="trained")}
LATE_MOTION, LATE_COLOURS = ({"schedule": {name: 1000}} for name in ("deform_from", "appearance_from"))
UNTIL_STAGE2 = [min(1.0, k / STAGE2) for k in range(END)]
SETTLED = [0.0] * (END - 30) + [k / 30 for k in range(30)]
LATER_HALF = [0.5 + k / (2 * END) for k in range(END)]
NOISE = [0.0] * STAGE1 + [0.1 * (40 - k) / 40 for k in range(40)] + [0.0] * (END - STAGE1 - 40)
DEGREES = [0] * (STAGE1 + 12) + [1] * 12 + [2] * 12 + [3] * (END - STAGE1 - 36)
COURSES = {
    "Gaussians settle in the last iterations": ("settle_progress", SETTLING, SETTLED),
    "likewise without pretraining": ("settle_progress", {"has_depth": False, **SETTLING}, SETTLED),
    "a settling longer than the run begins before it": (
        "settle_progress",
        {"schedule": {"settle": 2 * END}},
        LATER_HALF,
    ),
    "the SH degree rises in steps from stage 1 on": ("sh_degree", {}, DEGREES),
    "noise on time decays linearly from a tenth of a frame interval": ("time_noise", {}, NOISE),
    "the depth weight decays exponentially": ("depth_weight", {}, [2.0 * 0.01 ** (k / END) for k in range(END)]),
    "the depth weight may stay constant": ("depth_weight", {"loss": plain.loss(depth=2.0, depth_end=2.0)}, [2.0] * END),
    "progress rises linearly from zero to one": ("progress", {}, rising_from(0)),
    "that of static positions can end before stage 2": ("means_progress.static", TRAINED, UNTIL_STAGE2),
    "but not if stage 2 trains them": ("means_progress.static", {"frozen": "appearance", **TRAINED}, rising_from(0)),
    "nor if there is no stage 2": ("means_progress.static", {"omit": ("stage2",), **TRAINED}, rising_from(0)),
    "that of dynamic positions can begin in stage 1": ("means_progress.dynamic", TRAINED, rising_from(STAGE1)),
    "that of a deformation begins with it": ("network_progress.deformation", {}, rising_from(STAGE1 + 25)),
    "that of an appearance begins with it": ("network_progress.appearance", {}, rising_from(STAGE1 + 35)),
    "that of a late deformation begins in stage 2": ("network_progress.deformation", LATE_MOTION, rising_from(STAGE2)),
    "that of a late appearance begins in stage 2": ("network_progress.appearance", LATE_COLOURS, rising_from(STAGE2)),
}


@pytest.mark.parametrize(("name", "changes", "expected"), COURSES.values(), ids=COURSES)
def test_values_follow_the_schedule(name, changes, expected):
    assert values_of(name, **changes) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_the_paper_preset_resets_opacities_every_3000_iterations_before_15000():
    made = Protocol(PRESETS["paper"], has_depth=True)
    resets = [k for k in range(1, 30_001, 100) if "reset" in made.at(2_000 + k + 98).actions]
    assert [k + 99 for k in resets] == [3_000, 6_000, 9_000, 12_000]


def with_iterations(preset, iterations):
    return dataclasses.replace(PRESETS[preset], iterations=iterations)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("iterations", [3, 4, 40, 999, 30_000, 200_001])
def test_a_rescaled_run_has_exactly_the_requested_iterations(preset, iterations):
    config = scaled(with_iterations(preset, iterations))
    assert Protocol(config, has_depth=True).num_iterations == iterations
    assert min(config.schedule.pretrain, config.schedule.stage1, config.schedule.stage2) >= 1


@pytest.mark.parametrize(("preset", "factor"), [*((preset, 3) for preset in PRESETS), ("paper", Fraction(1, 10))])
def test_every_schedule_but_those_of_adam_is_scaled_by_the_same_factor(preset, factor):
    schedule = PRESETS[preset].schedule
    after = dataclasses.asdict(scaled(with_iterations(preset, int(factor * schedule.num_iterations))).schedule)
    assert after == {
        name: value and (1 if name in ("warmup", "fit_motion") else factor) * value
        for name, value in dataclasses.asdict(schedule).items()
    }


@pytest.mark.parametrize("off", [["pretrain"], ["stage2"], ["pretrain", "stage2"], ["densify_from", "appearance_from"]])
@pytest.mark.parametrize("iterations", [5, 50, 1003])
def test_zeros_of_a_schedule_stay_zero_when_it_is_rescaled(off, iterations):
    schedule = dataclasses.replace(SHORT, settle=30, fit_motion=5, **dict.fromkeys(off, 0))
    after = scaled(dataclasses.replace(CONFIG, schedule=schedule, iterations=iterations)).schedule
    assert after.num_iterations == iterations
    assert {name for name, value in dataclasses.asdict(after).items() if value == 0} == set(off)


@pytest.mark.parametrize("lengths", [(2_000, 70_000, 1_000), (1, 1, 100_000), (40_000, 1, 40_000), (5, 5, 5)])
@pytest.mark.parametrize("iterations", [3, 4, 5, 100])
def test_no_stage_becomes_empty_in_a_short_run(lengths, iterations):
    pretrain, stage1, stage2 = lengths
    schedule = dataclasses.replace(SHORT, pretrain=pretrain, stage1=stage1, stage2=stage2)
    after = scaled(dataclasses.replace(CONFIG, schedule=schedule, iterations=iterations)).schedule
    assert after.num_iterations == iterations
    assert min(after.pretrain, after.stage1, after.stage2) >= 1


def test_rescaling_changes_only_the_schedule():
    config = with_iterations("quick", 40)
    changed = scaled(config)
    assert dataclasses.replace(changed, schedule=config.schedule, iterations=40) == config
    assert changed.iterations is None


@pytest.mark.parametrize("preset", PRESETS)
def test_without_a_number_of_iterations_nothing_is_rescaled(preset):
    assert scaled(PRESETS[preset]) == PRESETS[preset]


@pytest.mark.parametrize(
    ("preset", "iterations", "reset_every"),
    [("paper", 12_000, 500), ("best", 6_500, 157), ("paper", 2_400, 100), ("paper", 60, 100), ("best", 60, 100)],
)
def test_opacities_of_a_short_run_have_at_least_100_iterations_between_resets(preset, iterations, reset_every):
    assert scaled(with_iterations(preset, iterations)).schedule.reset_every == reset_every


def test_a_shorter_interval_between_resets_is_not_shortened_further():
    config = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SHORT, reset_every=20), iterations=5)
    assert scaled(config).schedule.reset_every == 20


def test_rescaling_is_idempotent():
    once = scaled(with_iterations("paper", 1234))
    assert scaled(once) == once


@pytest.mark.parametrize("iterations", [2, 0, -5])
def test_too_few_iterations_are_refused(iterations):
    with pytest.raises(ValueError, match="iterations must be a number of at least 3"):
        scaled(with_iterations("paper", iterations))


@pytest.mark.parametrize(
    ("name", "value"), [("prune_every", 0), ("reset_every", 0), ("sh_degree_every", -1), ("stage1", -1)]
)
@pytest.mark.parametrize("iterations", [None, 100])
def test_an_invalid_schedule_is_refused_by_name(name, value, iterations):
    config = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SHORT, **{name: value}), iterations=iterations)
    with pytest.raises(ValueError, match=f"schedule.{name} must be a number of at least ., got {value}"):
        scaled(config)


def test_the_learning_rate_of_a_network_warms_up():
    made = plans(schedule={"warmup": 10})
    for name in ("deformation", "appearance"):
        first = next(k for k, plan in enumerate(made) if getattr(plan.phase, f"use_{name}"))
        values = [plan.warmup_factors[name] for plan in made]
        assert values[:first] == [0.0] * first
        assert values[first : first + 12] == pytest.approx([*((k + 1) / 10 for k in range(10)), 1.0, 1.0])
        assert values[-1] == 1.0


def test_without_warmup_networks_start_at_their_full_rate():
    assert all(set(plan.warmup_factors.values()) == {1.0} for plan in plans(schedule={"warmup": 0}))


@pytest.mark.parametrize("joint_from", [None, 0, 3])
def test_the_joint_image_is_compared_from_its_iteration_of_stage_1_on(joint_from):
    protocol = Protocol(
        plain.config(schedule=plain.schedule(pretrain=2, stage1=5, stage2=2, joint_from=joint_from)), True
    )
    start = protocol.stage2.start if joint_from is None else protocol.stage1.start + joint_from
    assert [protocol.phase_at(i).with_joint for i in range(9)] == [i >= start for i in range(9)]
