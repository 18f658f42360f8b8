"""What happens when: the stages and everything that depends on the iteration."""

import dataclasses

import pytest

from warpgs.config import PRESETS, DensifyConfig, LossConfig, ModelConfig, Schedule, TrainConfig, scaled
from warpgs.training.schedule import Protocol

SHORT = Schedule(
    pretrain=20,
    stage1=100,
    stage2=80,
    realign_at=10,
    densify_from=15,
    densify_until=60,
    reset_every=20,
    prune_every=30,
    deform_from=25,
    appearance_from=35,
    noise_until=40,
    sh_degree_every=12,
)
CONFIG = TrainConfig(
    schedule=SHORT,
    densify=DensifyConfig(every=10),
    model=ModelConfig(sh_degree=3),
    loss=LossConfig(depth=2.0, depth_end=0.02),
)
STAGE1, STAGE2, END = 20, 120, 200
"""First iterations of the stages of ``SHORT``, and how many there are."""


def protocol(has_depth=True, schedule=None, **changes):
    config = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SHORT, **(schedule or {})), **changes)
    return Protocol(config, has_depth)


def moments(*arguments, **changes):
    made = protocol(*arguments, **changes)
    return [made.at(iteration) for iteration in range(made.num_iterations)]


def iterations_where(name, *arguments, **changes):
    """The iterations of which a property of ``Moment`` is true."""
    return [i for i, moment in enumerate(moments(*arguments, **changes)) if getattr(moment, name)]


def boundaries(made):
    """Names of the stages that take place with their first and last iterations."""
    stages = [(s.name, s.start, s.end - 1) for s in (made.pretrain, made.stage1, made.stage2) if s.end > s.start]
    for name, first, last in stages:
        assert {made.at(first).stage.name, made.at(last).stage.name} == {name}
    return stages


# Stages --------------------------------------------------------------------------------------------------------------


def test_the_papers_protocol_is_pretraining_then_30k_apart_then_40k_jointly():
    stages = boundaries(Protocol(PRESETS["paper"], has_depth=True))
    assert stages == [("pretrain", 0, 1_999), ("stage1", 2_000, 31_999), ("stage2", 32_000, 71_999)]


def test_every_iteration_belongs_to_the_stage_it_lies_in():
    names = [moment.stage.name for moment in moments()]
    assert names == ["pretrain"] * 20 + ["stage1"] * 100 + ["stage2"] * 80


@pytest.mark.parametrize(("has_depth", "dap"), [(False, True), (True, False), (False, False)])
def test_without_pretraining_stage_1_takes_its_iterations(has_depth, dap):
    assert boundaries(protocol(has_depth, dap=dap)) == [("stage1", 0, 119), ("stage2", 120, 199)]


def test_without_stage_2_stage_1_takes_its_iterations():
    assert boundaries(protocol(stage2=False)) == [("pretrain", 0, 19), ("stage1", 20, 199)]


def test_without_both_all_is_stage_1():
    assert boundaries(protocol(dap=False, stage2=False)) == [("stage1", 0, 199)]


@pytest.mark.parametrize("off", ["dap", "vdp", "app", "stage2"])
def test_runs_with_a_component_off_are_as_long_as_the_whole(off):
    assert protocol(**{off: False}).num_iterations == protocol().num_iterations == END


@pytest.mark.parametrize("off", ["vdp", "app"])
def test_stages_do_not_depend_on_pruning_or_the_appearance_network(off):
    assert boundaries(protocol(**{off: False})) == boundaries(protocol())


# Networks and losses -------------------------------------------------------------------------------------------------


def test_the_joint_image_counts_in_stage_2_alone():
    assert iterations_where("joint") == list(range(STAGE2, END))


def test_static_gaussians_are_relit_from_their_iteration_of_stage_1_on():
    assert iterations_where("relit") == list(range(STAGE1 + 35, END))


def test_static_gaussians_are_relit_in_stage_2_in_any_case():
    assert iterations_where("relit", schedule={"appearance_from": 1000}) == list(range(STAGE2, END))


def test_without_the_appearance_network_stage_2_is_joint_all_the_same():
    assert iterations_where("relit", app=False) == []
    assert iterations_where("joint", app=False) == list(range(STAGE2, END))


def test_without_stage_2_nothing_is_joint():
    assert iterations_where("joint", stage2=False) == []


def test_without_stage_2_networks_begin_when_they_did():
    assert iterations_where("relit", stage2=False) == iterations_where("relit")
    assert iterations_where("moving", stage2=False) == iterations_where("moving")


def test_dynamic_gaussians_move_from_their_iteration_of_stage_1_on():
    assert iterations_where("moving") == list(range(STAGE1 + 25, END))


def test_dynamic_gaussians_move_in_stage_2_in_any_case():
    assert iterations_where("moving", schedule={"deform_from": 1000}) == list(range(STAGE2, END))


def test_the_degree_of_harmonics_rises_step_by_step_from_stage_1_on():
    degrees = [moment.sh_degree for moment in moments()]
    assert degrees == [0] * (STAGE1 + 12) + [1] * 12 + [2] * 12 + [3] * (END - STAGE1 - 36)


@pytest.mark.parametrize("degree", range(4))
def test_the_degree_of_harmonics_never_passes_that_of_the_model(degree):
    degrees = {moment.sh_degree for moment in moments(model=ModelConfig(sh_degree=degree))}
    assert degrees == set(range(degree + 1))


def test_noise_on_time_fades_linearly_from_a_tenth_of_a_frame_interval():
    noise = [moment.noise for moment in moments()]
    expected = [0.0] * STAGE1 + [0.1 * (40 - k) / 40 for k in range(40)] + [0.0] * (END - STAGE1 - 40)
    assert noise == pytest.approx(expected, abs=1e-12)


def test_noise_that_ends_at_once_is_gone_after_one_iteration():
    noise = [moment.noise for moment in moments(schedule={"noise_until": 0})]
    assert max(noise[STAGE1 + 1 :]) == 0.0


def test_the_weight_of_depth_falls_exponentially_over_the_run():
    weights = [moment.depth_weight for moment in moments()]
    assert weights == pytest.approx([2.0 * 0.01 ** (k / END) for k in range(END)], rel=1e-9)


@pytest.mark.parametrize(
    ("has_depth", "changes"), [(False, {}), (True, {"dap": False}), (True, {"loss": LossConfig(depth=0.0)})]
)
def test_without_depth_its_weight_is_zero(has_depth, changes):
    assert iterations_where("depth_weight", has_depth, **changes) == []


@pytest.mark.parametrize("end", [0.0, 2.0])
def test_the_weight_of_depth_may_vanish_or_stay(end):
    weights = [moment.depth_weight for moment in moments(loss=LossConfig(depth=2.0, depth_end=end))]
    assert weights[0] == pytest.approx(2.0)
    assert weights[-1] == pytest.approx(end, abs=1e-9)


def test_progress_runs_evenly_from_zero_to_one():
    assert [moment.progress for moment in moments()] == pytest.approx([k / END for k in range(END)])


def network_progress(name, **schedule):
    return [moment.network_progress[name] for moment in moments(schedule=schedule)]


@pytest.mark.parametrize(("name", "first"), [("deformation", STAGE1 + 25), ("appearance", STAGE1 + 35)])
def test_a_network_progresses_from_its_first_iteration_to_the_end(name, first):
    expected = [0.0] * first + [k / (END - first) for k in range(END - first)]
    assert network_progress(name) == pytest.approx(expected)


@pytest.mark.parametrize(("name", "start"), [("deformation", "deform_from"), ("appearance", "appearance_from")])
def test_a_network_that_waits_for_stage_2_progresses_from_there(name, start):
    expected = [0.0] * STAGE2 + [k / (END - STAGE2) for k in range(END - STAGE2)]
    assert network_progress(name, **{start: 1000}) == pytest.approx(expected)


# What changes the Gaussians ------------------------------------------------------------------------------------------
# After iteration i of a run, i + 1 − STAGE1 iterations of stage I are done.


def after(*done):
    return [STAGE1 + number - 1 for number in done]


def test_gaussians_are_densified_at_intervals_between_two_iterations_of_stage_1():
    assert iterations_where("densify") == after(20, 30, 40, 50, 60)


def test_gaussians_are_not_densified_in_stage_2():
    assert max(iterations_where("densify", schedule={"densify_until": 1000})) == STAGE2 - 1


def test_opacities_are_reset_at_intervals_while_there_is_densification_to_come():
    assert iterations_where("reset") == after(20, 40)


def test_the_papers_run_resets_opacities_every_3000_iterations_before_15000():
    made = Protocol(PRESETS["paper"], has_depth=True)
    resets = [k for k in range(1, 30_001, 100) if made.at(2_000 + k + 98).reset]
    assert [k + 99 for k in resets] == [3_000, 6_000, 9_000, 12_000]


def test_static_gaussians_are_pruned_at_intervals_and_at_the_end_of_stage_1():
    assert iterations_where("prune") == after(30, 60, 90, 100)


def test_without_visibility_driven_pruning_nothing_is_pruned():
    assert iterations_where("prune", vdp=False) == []


def test_without_stage_2_pruning_goes_on_but_not_after_the_last_iteration():
    assert protocol(stage2=False).num_iterations == STAGE1 + 6 * SHORT.prune_every
    assert iterations_where("prune", stage2=False) == after(30, 60, 90, 120, 150)


def test_oversized_gaussians_are_removed_only_after_the_first_reset():
    assert iterations_where("remove_large") == list(range(STAGE1 + 20, END))


def test_depth_is_aligned_again_once_in_the_pretraining():
    assert iterations_where("realign") == [9]


def test_a_pretraining_shorter_than_that_aligns_depth_at_its_end():
    assert iterations_where("realign", schedule={"realign_at": 500}) == [19]


def test_without_pretraining_depth_is_not_aligned_again():
    assert iterations_where("realign", dap=False) == []


# Scaling -------------------------------------------------------------------------------------------------------------


def with_iterations(preset, iterations):
    return dataclasses.replace(PRESETS[preset], iterations=iterations)


def total(schedule):
    return schedule.pretrain + schedule.stage1 + schedule.stage2


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("iterations", [3, 4, 40, 999, 30_000, 200_001])
def test_a_scaled_run_takes_exactly_the_iterations_asked_for(preset, iterations):
    config = scaled(with_iterations(preset, iterations))
    assert Protocol(config, has_depth=True).num_iterations == iterations


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("iterations", [3, 4, 40, 999])
def test_every_stage_of_a_scaled_run_takes_place(preset, iterations):
    schedule = scaled(with_iterations(preset, iterations)).schedule
    assert min(schedule.pretrain, schedule.stage1, schedule.stage2) >= 1


@pytest.mark.parametrize("preset", PRESETS)
def test_every_schedule_is_scaled_by_the_same_factor(preset):
    before = dataclasses.asdict(PRESETS[preset].schedule)
    after = dataclasses.asdict(scaled(with_iterations(preset, 3 * total(PRESETS[preset].schedule))).schedule)
    assert after == {name: 3 * value for name, value in before.items()}


def test_a_tenth_of_the_iterations_is_a_tenth_of_every_schedule():
    before = dataclasses.asdict(PRESETS["paper"].schedule)
    after = dataclasses.asdict(scaled(with_iterations("paper", 7_200)).schedule)
    assert after == {name: value // 10 for name, value in before.items()}


@pytest.mark.parametrize("off", [["pretrain"], ["stage2"], ["pretrain", "stage2"], ["densify_from", "appearance_from"]])
@pytest.mark.parametrize("iterations", [5, 50, 1003])
def test_what_a_schedule_leaves_out_stays_out_when_it_is_scaled(off, iterations):
    schedule = dataclasses.replace(SHORT, **dict.fromkeys(off, 0))
    after = scaled(dataclasses.replace(CONFIG, schedule=schedule, iterations=iterations)).schedule
    assert total(after) == iterations
    assert {name for name, value in dataclasses.asdict(after).items() if value == 0} == set(off)


@pytest.mark.parametrize("lengths", [(2_000, 70_000, 1_000), (1, 1, 100_000), (40_000, 1, 40_000), (5, 5, 5)])
@pytest.mark.parametrize("iterations", [3, 4, 5, 100])
def test_no_stage_is_lost_however_short_the_run(lengths, iterations):
    pretrain, stage1, stage2 = lengths
    schedule = dataclasses.replace(SHORT, pretrain=pretrain, stage1=stage1, stage2=stage2)
    after = scaled(dataclasses.replace(CONFIG, schedule=schedule, iterations=iterations)).schedule
    assert total(after) == iterations
    assert min(after.pretrain, after.stage1, after.stage2) >= 1


def test_scaling_changes_nothing_but_schedules():
    config = with_iterations("quick", 40)
    changed = scaled(config)
    assert dataclasses.replace(changed, schedule=config.schedule, iterations=40) == config
    assert changed.iterations is None


@pytest.mark.parametrize("preset", PRESETS)
def test_without_a_number_of_iterations_nothing_is_scaled(preset):
    assert scaled(PRESETS[preset]) == PRESETS[preset]


def test_scaling_twice_is_scaling_once():
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
def test_a_schedule_that_cannot_be_is_refused_by_name(name, value, iterations):
    config = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SHORT, **{name: value}), iterations=iterations)
    with pytest.raises(ValueError, match=f"schedule.{name} must be a number of at least ., got {value}"):
        scaled(config)


def test_a_network_begins_slowly():
    made = moments(schedule={"warmup": 10})
    for name, begins in (("deformation", lambda m: m.moving), ("appearance", lambda m: m.relit)):
        first = next(k for k, moment in enumerate(made) if begins(moment))
        values = [moment.network_warmth[name] for moment in made]
        assert values[:first] == [0.0] * first
        assert values[first : first + 12] == pytest.approx([*((k + 1) / 10 for k in range(10)), 1.0, 1.0])
        assert values[-1] == 1.0


def test_without_warmup_networks_begin_at_their_full_rate():
    assert all(set(m.network_warmth.values()) == {1.0} for m in moments(schedule={"warmup": 0}))
