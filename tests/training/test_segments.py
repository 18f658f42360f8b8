"""Training with several segments of time."""

import dataclasses
from unittest.mock import MagicMock, Mock

import pytest
import torch

from tests import plain, tiny
from warpgs.editing.contribution import blend_weights_in
from warpgs.initialization.plan import make_plan
from warpgs.initialization.prepare_start import prepare_again
from warpgs.model import segments as segments_module
from warpgs.model.segments import nearest, window
from warpgs.rendering import DEFAULTS, render
from warpgs.runs import checkpoint
from warpgs.runs.config_file import read_config
from warpgs.runs.logger import TrainingLogger
from warpgs.runs.run import Run
from warpgs.runtime import ranks
from warpgs.training.density import gradient, prune
from warpgs.views.views import Views

pytestmark = pytest.mark.usefixtures("quickly")

CONFIG = dataclasses.replace(tiny.CONFIG, model=dataclasses.replace(tiny.MODEL, segments=2))


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """A run without interruption."""
    folder = tmp_path_factory.mktemp("segments")
    Run.create(folder, plain.plan(dataclasses.replace(CONFIG, data=data)))
    assert tiny.train(tiny.trainer(data, folder, CONFIG))
    return folder


def test_dynamic_gaussians_of_each_segment_start_where_its_frames_show_them(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path, CONFIG)
    trainer.iteration = trainer.protocol.stage1.start
    trainer._add_dynamic_gaussians()
    dynamic, networks = trainer.scene.dynamic, trainer.scene.deformation.network.trunk.values
    assert dynamic.segments.bincount().tolist() == [tiny.MODEL.dynamic_points] * 2
    assert not torch.equal(networks[0], networks[1])
    times = torch.tensor([trainer.capture.cameras[name].time for name in trainer.capture.train])
    for segment in range(2):
        start, end = window(segment, 2)
        others = times[(times < start) | (times > end)]
        assert len(others)
        assert (nearest(others, 2) != segment).all()


def test_the_fits_of_all_segments_are_one_progress(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path, CONFIG)
    trainer.iteration, logger = trainer.protocol.stage1.start, MagicMock(spec=TrainingLogger)
    trainer._add_dynamic_gaussians(logger=logger)
    show = logger.fitting.return_value.__enter__.return_value
    steps = CONFIG.schedule.fit_motion
    assert [call.args[0] for call in show.call_args_list] == pytest.approx(
        [k / (2 * steps) for k in range(1, 2 * steps + 1)]
    )


def test_gaussians_of_a_segment_count_by_the_images_in_which_they_are_there(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path, CONFIG)
    trainer.iteration = trainer.protocol.stage1.start
    trainer._add_dynamic_gaussians()
    scene, views = trainer.scene, trainer.views
    summed = torch.zeros(len(scene.static) + len(scene.dynamic))
    for view in map(views.__getitem__, range(len(views))):
        with torch.no_grad():
            summed += blend_weights_in(scene.splats(view.time, sh_degree=1), view.camera, DEFAULTS)
    expected = summed * torch.cat([torch.ones(len(scene.static)), 2.0 * torch.ones(len(scene.dynamic))])
    found = prune.blend_weights(scene, views, plain.phase(stage="stage2"))
    assert torch.allclose(found, expected, rtol=1e-5)
    assert found[len(scene.static) :].sum() > 0.0


def test_both_segments_are_trained_to_the_end(whole):
    first, last = (checkpoint.load(path).tensors for path in (checkpoint.path_of(whole, 7), _newest(whole)))
    values = "scene.deformation.network.trunk.values"
    assert (first[values] != last[values]).any(1).all()
    assert last["scene.dynamic.segments"].unique().tolist() == [0, 1]


# After the first densification, and at the start of stage II.
@pytest.mark.parametrize("stop", [9, 22])
def test_a_resumed_run_is_bit_identical(data, whole, tmp_path, stop):
    first = tiny.trainer(data, tmp_path, CONFIG)
    assert not tiny.train(first, tiny.StopWhen(lambda: first.iteration >= stop))
    trainer = tiny.trainer(data, tmp_path, CONFIG)
    trainer.restore_newest(print)
    assert tiny.train(trainer)
    assert tiny.differences(tiny.state(tmp_path), tiny.state(whole)) == []


@pytest.mark.parametrize(("action", "replaced"), [("reset", False), ("densify", True)])
def test_ranks_leave_segments_where_cuda_graphs_read_them_unless_gaussians_are_replaced(
    data, tmp_path, monkeypatch, action, replaced
):
    trainer = tiny.trainer(data, tmp_path, CONFIG)
    trainer.iteration = trainer.protocol.stage1.start
    trainer._add_dynamic_gaussians()
    others = {"num_ranks": lambda: 2, "is_first": lambda: False, "any_rank": bool}
    for name, value in (others | dict.fromkeys(("add_", "copy_first_"), lambda *tensors: None)).items():
        monkeypatch.setattr(ranks, name, value)
    monkeypatch.setattr(trainer.step.density, "merge", lambda: None)
    monkeypatch.setattr(trainer.step, "begin_density", lambda num_kept: None)
    before = trainer.scene.dynamic.segments
    trainer._adapt(tiny.plan_to(trainer, action), None)
    assert (trainer.scene.dynamic.segments is not before) == replaced


def test_a_run_opens_as_a_scene_that_changes_its_gaussians_over_time(whole):
    trained = Run(whole, read_config(whole)).trained_scene()
    num_static = len(trained.scene.static)
    seen = [trained.splats(time).opacities[num_static:] > 0 for time in (0.1, 0.5, 0.9)]
    assert not (seen[0] & seen[2]).any()
    assert (seen[1] == (seen[0] | seen[2])).all()


def test_a_checkpoint_with_a_segment_that_there_is_not_is_damaged(whole, tmp_path):
    loaded = checkpoint.load(_newest(whole))
    loaded.tensors["scene.dynamic.segments"][0] = 2
    with pytest.raises(checkpoint.DamagedCheckpointError, match="segment outside of 0 to 1"):
        checkpoint.load_scene(loaded, CONFIG.model)


def test_a_plan_knows_the_number_of_segments(data, monkeypatch):
    capture = tiny.trainer(data, data, tiny.CONFIG).capture
    config = dataclasses.replace(tiny.CONFIG, model=dataclasses.replace(tiny.MODEL, segments=None))
    assert make_plan(config, capture)[0].model.segments == 1
    monkeypatch.setattr("warpgs.model.segments.MAX_TIMES", 3)
    plan, notes, _ = make_plan(config, capture)
    assert plan.model.segments == 2
    assert any("2 segments of about 4 times" in note for note in notes)


@pytest.mark.parametrize(("most", "warns"), [(0, True), (1, False)])
def test_a_limit_that_the_gaussians_of_all_segments_reach_at_the_start_is_told(data, most, warns):
    capture = tiny.trainer(data, data, tiny.CONFIG).capture
    start = tiny.MODEL.max_static_points + 2 * tiny.MODEL.dynamic_points
    densify = dataclasses.replace(CONFIG.densify, max_gaussians=start + most)
    notes = make_plan(dataclasses.replace(CONFIG, densify=densify), capture).notes
    message = f"warning: up to {start} initial Gaussians may reach --densify.max-gaussians {start}, the limit of all"
    assert any(note.startswith(message) for note in notes) == warns


def test_a_run_that_is_resumed_says_its_number_of_segments(data):
    capture = tiny.trainer(data, data, tiny.CONFIG).capture
    for segments, told in ((2, True), (1, False)):
        config = dataclasses.replace(tiny.CONFIG, model=dataclasses.replace(tiny.MODEL, segments=segments))
        notes = prepare_again(make_plan(config, capture).plan, capture).notes
        assert any(note.startswith("2 segments of about 4 times have") for note in notes) == told


def test_splines_and_segments_exclude_each_other(data):
    config = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, deformation="splines"))
    with pytest.raises(ValueError, match=r'model.segments 2 needs model.deformation "mlp", got "splines"'):
        make_plan(config, tiny.trainer(data, data, tiny.CONFIG).capture)


def _newest(run):
    return checkpoint.list_checkpoints(run)[-1]


def test_more_segments_than_times_are_refused(data):
    capture = tiny.trainer(data, data, tiny.CONFIG).capture
    config = dataclasses.replace(tiny.CONFIG, model=dataclasses.replace(tiny.MODEL, segments=7))
    with pytest.raises(ValueError, match=r"model\.segments 7: expected at most the 6 times of training frames"):
        make_plan(config, capture)


def test_dynamic_gaussians_densify_when_each_segment_was_seen_as_often_as_a_capture(data, tmp_path, monkeypatch):
    """The static ones densify after every 4 iterations, after 9, 13 and 17, the dynamic ones after 13 alone."""
    trainer, done, views, densify = (
        tiny.trainer(data, tmp_path, CONFIG),
        {"static": [], "dynamic": []},
        [],
        gradient.densify,
    )

    def seen(gaussians, *others):
        is_dynamic = gaussians is trainer.scene.dynamic
        done["dynamic" if is_dynamic else "static"].append(trainer.iteration)
        if is_dynamic:
            counts = trainer.step.density.count[-len(gaussians) :]
            views.append(sum(int(counts[gaussians.segments == k].max()) for k in range(2)))
        densify(gaussians, *others)

    monkeypatch.setattr(gradient, "densify", seen)
    assert tiny.train(trainer)
    assert done == {"static": [9, 13, 17], "dynamic": [13]}
    assert views[0] > 4  # also those before static Gaussians were replaced


@pytest.mark.parametrize("waits", [True, False])
def test_dynamic_gaussians_that_wait_keep_their_part_of_the_capacity(data, tmp_path, monkeypatch, waits):
    config = dataclasses.replace(CONFIG, densify=dataclasses.replace(CONFIG.densify, max_gaussians=100))
    trainer, limits = tiny.trainer(data, tmp_path, config), []
    trainer.iteration = trainer.protocol.stage1.start
    trainer._add_dynamic_gaussians()
    trainer.step.density.total += 1.0  # all Gaussians want to grow
    monkeypatch.setattr(gradient, "densify", lambda *arguments: limits.append(arguments[4].capacity))
    plan = dataclasses.replace(tiny.plan_to(trainer, "densify"), densifies_dynamic=not waits)
    trainer.step.density.densify(trainer._adaptation(plan, Mock(spec=TrainingLogger)))
    numbers = len(trainer.scene.static), len(trainer.scene.dynamic)
    left = 100 - sum(numbers)
    assert left > 0
    assert limits == [left * num // sum(numbers) for num in numbers][: 1 if waits else 2]


def test_an_image_has_room_for_the_dynamic_gaussians_of_its_segment(data, tmp_path):
    config = dataclasses.replace(CONFIG, densify=dataclasses.replace(CONFIG.densify, max_gaussians=10**6, min_pixels=8))
    trainer = tiny.trainer(data, tmp_path, config)
    trainer.iteration = trainer.protocol.stage1.start
    trainer._add_dynamic_gaussians()
    views = MagicMock(spec=Views, num_pixels=10_000 * 32 * 24)
    views.__len__.return_value = 10_000
    change = trainer._adaptation(tiny.plan_to(trainer, "densify"), Mock(spec=TrainingLogger))
    capacity = dataclasses.replace(change, views=views).capacity
    assert capacity == 3 * 32 * 24 - len(trainer.scene.static) - tiny.MODEL.dynamic_points


def test_views_of_an_overlap_show_each_segment_alone_in_a_third_of_the_iterations(data, tmp_path, monkeypatch):
    trainer, seen = tiny.trainer(data, tmp_path, CONFIG), set()
    trainer.iteration = trainer.protocol.stage1.start
    trainer._add_dynamic_gaussians()
    trainer.views._times[:] = 0.5
    segments = trainer.scene.dynamic.segments

    def rendered(splats, *others):
        opacities = splats.opacities[len(trainer.scene.static) :]
        seen.add(tuple(bool((opacities[segments == k] > 0.0).any()) for k in range(2)))
        return render(splats, *others)

    monkeypatch.setattr("warpgs.training.step.render", rendered)
    for seed in range(3):
        plan = trainer.protocol.at(trainer.iteration)
        trainer.step(plan, trainer._sample(plan)._replace(dropout_seed=seed))
    assert seen == {(True, False), (True, True), (False, True)}


def test_a_step_fades_opacities_once(data, tmp_path, monkeypatch):
    trainer, calls = tiny.trainer(data, tmp_path, CONFIG), []
    trainer.iteration = trainer.protocol.stage1.start
    trainer._add_dynamic_gaussians()
    faded = segments_module.faded
    monkeypatch.setattr(segments_module, "faded", lambda *args: (calls.append(len(args[0])), faded(*args))[1])
    plan = trainer.protocol.at(trainer.iteration)
    trainer.step(plan, trainer._sample(plan))
    assert calls == [len(trainer.scene.dynamic)]
