import dataclasses
import functools
import json
import sys
from types import SimpleNamespace

import pytest
import torch

from tests import tiny
from tests.errors import error_line
from warpgs.bench import measure
from warpgs.bench.measure import STAGES, time_in_turn
from warpgs.bench.options import Bench
from warpgs.bench.run_bench import bench
from warpgs.bench.scenes import SCENES, Scene, in_disc, random_splats
from warpgs.bench.training import measure_steps, plain_phase, random_scene
from warpgs.bench.workloads import OTHERS, graphed, make_workload, parameter_names, sh_degree_of
from warpgs.cli import main
from warpgs.config import RenderSettings
from warpgs.config.presets import PRESETS
from warpgs.runs.run import Run
from warpgs.training.schedule import Protocol

TINY = Scene("tiny", 48, 32, 100, 3.0)
REPEATS = 2
OPTIONS = Bench(device="cpu", repeats=REPEATS)


def report(tmp_path, **options):
    path = tmp_path / "report.json"
    options = dataclasses.replace(OPTIONS, json=path, **options)
    bench(options, [TINY.views(options.branches, "cpu", options.sh_degree)], "cpu")
    return json.loads(path.read_text())


def test_the_report_names_the_machine_and_the_versions(tmp_path):
    machine = report(tmp_path)["machine"]
    assert set(machine) == {"cpu", "threads", "torch", "warp", "date", "commit"}
    assert machine["torch"] == torch.__version__


def test_the_report_has_total_times_and_times_of_all_stages(tmp_path):
    (result,) = report(tmp_path)["results"]
    assert set(result["one_image"]) == {"forward_ms", "forward_backward_ms", "stages_ms"}
    assert set(result["one_image"]["stages_ms"]) == set(STAGES)
    assert all(isinstance(ms, float) and ms > 0 for ms in result["one_image"]["stages_ms"].values())


def test_compared_steps_alternate():
    calls = []
    times = time_in_turn({name: [functools.partial(calls.append, name + k) for k in "12"] for name in "ab"}, "cpu", 2)
    assert calls == ["a1", "b1", "a2", "b2"] * 3  # the first turn warms up
    assert set(times) == {"a", "b"}


def test_the_time_of_several_cameras_is_the_median_of_their_medians(monkeypatch):
    samples = iter([1.0, 50.0, 3.0, 2.0, 5.0, 4.0, 1.0, 40.0, 3.0])  # of three cameras in turn
    monkeypatch.setattr(measure, "milliseconds", lambda step, device: next(samples))
    assert time_in_turn({"a": [lambda: None] * 3}, "cpu", 3) == {"a": 3.0}


def test_warm_ups_are_shared_between_cameras():
    assert [measure.warm_ups("cuda", cameras) for cameras in (1, 5, 7)] == [50, 10, 8]
    assert measure.warm_ups("cpu", 5) == 1


def test_the_tail_has_quantiles_of_tiles_and_the_share_of_the_fullest():
    lengths = torch.ones(200, dtype=torch.int32)
    lengths[[3, 77]] = torch.tensor([60, 42], dtype=torch.int32)  # of 300 in sum
    assert measure.tail(lengths) == {
        "median": 1,
        "99_percent": 42,
        "maximum": 60,
        "share_of_fullest_1_percent": pytest.approx(102 / 300),
    }


def test_the_tail_of_an_empty_image_is_zero():
    assert set(measure.tail(torch.zeros(6, dtype=torch.int32)).values()) == {0}


def test_differences_from_another_renderer_are_the_largest_of_all_cameras():
    first = {"max_image": 0.5, "relative_gradients": {"means": 0.1, "sh": 0.4}}
    second = {"max_image": 0.2, "relative_gradients": {"means": 0.3, "sh": 0.2}}
    assert measure.worst([first, second]) == {"max_image": 0.5, "relative_gradients": {"means": 0.3, "sh": 0.4}}


def test_the_report_counts_gaussians_and_intersections(tmp_path):
    (result,) = report(tmp_path)["results"]
    assert result["num_gaussians"] == TINY.num_gaussians
    assert result["intersections"] > 0
    assert 0 < result["intersections_per_tile"]["median"] <= result["intersections_per_tile"]["maximum"]


@pytest.mark.parametrize("branches", ["random", "disc"])
def test_branches_are_measured_against_one_image(tmp_path, branches):
    (result,) = report(tmp_path, branches=branches)["results"]
    assert set(result["three_images"]) == set(result["one_image"])
    assert set(result["ratios_to_one_image"]["three_images"]) == {"forward", "forward_backward"}


def test_depth_can_be_measured_with_branches(tmp_path):
    (result,) = report(tmp_path, branches="random", depth=True)["results"]
    assert set(result["three_images"]["stages_ms"]) == set(STAGES)


def test_the_profile_is_a_trace_of_forward_and_backward_kernels(tmp_path):
    path = tmp_path / "trace.json"
    bench(dataclasses.replace(OPTIONS, profile=path), [TINY.views("none", "cpu")], "cpu")
    events = json.loads(path.read_text())["traceEvents"]
    kernels = [event for event in events if event["ph"] == "X"]
    names = {kernel["name"] for kernel in kernels}
    assert names >= {"project_fwd", "sort_pairs", "composite_fwd", "composite_bwd", "project_bwd"}
    assert all(k["dur"] > 0 and k["ts"] >= 0 for k in kernels)


def test_the_output_is_plain_text_if_it_is_not_a_terminal(capsys):
    bench(OPTIONS, [TINY.views("none", "cpu")], "cpu")
    output = capsys.readouterr().out
    assert "tiny: 48x32, 100 Gaussians" in output
    assert "forward [ms]" in output
    assert output.isascii()


def test_the_output_has_names_and_no_keys(capsys):
    bench(dataclasses.replace(OPTIONS, branches="disc"), [TINY.views("disc", "cpu")], "cpu")
    output = capsys.readouterr().out
    for name in ("CPU: ", "forward and backward [ms]", "pass [ms]: composite, backward", "SSIM, forward and backward"):
        assert name in output
    assert "_" not in output.replace("x86_64", "")
    assert "fwd" not in output


def test_graphs_are_measured_beside_plain_calls(monkeypatch):
    """The test runs on the CPU, where calls are not recorded but repeated."""
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", lambda render, _parameters: render)
    monkeypatch.setattr(measure, "capture", lambda step: step)
    workload = tiny_workload()
    times = measure.time_passes({"one_image": [workload]}, ["one_image"], "cpu", repeats=1)
    graphs = ("callable_forward_backward", "graph_forward", "graph_forward_backward")
    passes = ("forward", "forward_backward", *graphs)
    assert list(times) == [("one_image", f"{name}_ms") for name in passes]
    assert all(ms > 0 for ms in times.values())
    for ours, plain in zip(graphed(workload).forward_backward(), workload.forward_backward(), strict=True):
        assert torch.equal(ours, plain)


def test_graphs_are_captured_after_plain_calls_are_measured(monkeypatch):
    """Beside a graphed callable, torch warns that plain calls may synchronise without need."""
    order = []
    monkeypatch.setattr(
        torch.cuda, "make_graphed_callables", lambda render, _parameters: order.append("graph") or render
    )
    monkeypatch.setattr(measure, "capture", lambda step: order.append("graph") or step)
    monkeypatch.setattr(measure, "milliseconds", lambda step, device: order.append("call") or 1.0)
    measure.time_passes({"one_image": [tiny_workload()]}, ["one_image"], "cpu", repeats=1)
    assert order == ["call", "call", *["graph", "call"] * 3]


def test_a_graph_is_compared_with_plain_calls_of_the_other_renderer():
    ours = {"forward_ms": 2.0, "forward_backward_ms": 4.0, "graph_forward_ms": 1.0, "graph_forward_backward_ms": 2.0}
    theirs = {"forward_ms": 6.0, "forward_backward_ms": 8.0}
    found = measure.ratios(theirs, ours)
    assert found == {"forward": 3.0, "forward_backward": 2.0, "graph_forward": 6.0, "graph_forward_backward": 4.0}


@pytest.mark.parametrize("degree", range(4))
def test_spherical_harmonics_of_any_degree_can_be_measured(degree, tmp_path, capsys):
    (result,) = report(tmp_path, sh_degree=degree)["results"]
    assert result["sh_degree"] == degree
    assert f"spherical harmonics of degree {degree}" in capsys.readouterr().out
    workload = tiny_workload(degree)
    assert sh_degree_of(workload) == degree
    difference = (workload.render()[0] - tiny_workload().render()[0]).abs().mean()
    assert difference < 1e-6 if degree == 0 else 1e-3 < difference < 0.1
    *_, v_sh = workload.forward_backward()
    assert v_sh[:, -1].any()


@pytest.mark.parametrize(
    ("sh_degree", "channels", "antialias", "mode"),
    [(None, (3,), False, "classic"), (2, (9, 3), True, "antialiased")],
)
def test_gsplat_gets_the_same_colours_and_the_same_antialiasing(monkeypatch, sh_degree, channels, antialias, mode):
    calls = []

    def rasterization(*args, **options):
        calls.append((args[4].shape[1:], options["sh_degree"], options["rasterize_mode"]))
        return torch.zeros(1, 32, 48, 3), None, None

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    workload = tiny_workload(sh_degree)
    settings = RenderSettings(antialias=antialias)
    (image,) = OTHERS["gsplat"](workload, TINY.make("none", "cpu")[1], settings).render()
    assert calls == [(channels, sh_degree, mode)]
    assert image.shape == workload.render()[0].shape


def test_a_workload_renders_the_given_parameters():
    workload = tiny_workload()
    images = workload.render()
    assert torch.equal(workload.render(*workload.parameters)[0], images[0])
    *geometry, colors = workload.parameters
    assert torch.allclose(workload.render(*geometry, 0.5 * colors)[0], 0.5 * images[0])


def tiny_workload(sh_degree=None):
    splats, camera = TINY.make("none", "cpu", sh_degree)
    for name in parameter_names(splats):
        getattr(splats, name).requires_grad_()
    return make_workload(splats, camera, RenderSettings())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--against", "gsplat"], "--against gsplat needs --device cuda"),
        (["--graph"], "--graph needs --device cuda"),
        (["--repeats", "0"], "--repeats must be at least 1"),
        (["--json", "missing/report.json"], "no such folder"),
        (["--profile", "."], "it is a folder"),
        (["--sizes", "32x24"], "--sizes is for --scene and --fps"),
        (["--scene", "missing.ply"], "missing.ply does not exist"),
        (["--scene", ".", "--sizes", "32"], "--sizes must be WIDTHxHEIGHT"),
        (["--scene", ".", "--branches", "disc"], "--branches and --sh-degree are for random scenes"),
    ],
    ids=str,
)
def test_wrong_options_are_refused_with_one_line_before_anything_is_measured(capsys, options, words):
    assert words in error_line(capsys, "bench", "--device", "cpu", *options)


@pytest.mark.parametrize(
    "arguments", [["bench", "--no-such-option"], ["bench", "--scenes", "huge"], ["no-such-command"]]
)
def test_unknown_options_end_with_exit_code_2(arguments):
    with pytest.raises(SystemExit) as end:
        sys.exit(main(arguments))
    assert end.value.code == 2


def test_the_command_measures_the_given_scenes(monkeypatch, capsys):
    monkeypatch.setitem(SCENES, "wide", TINY)
    assert main(["bench", "--device", "cpu", "--repeats", "1", "--scenes", "wide"]) == 0
    assert "tiny: " in capsys.readouterr().out


def test_a_seed_always_gives_the_same_scene():
    first, second = (random_splats(10, 48, 32, 3.0, seed=5)[0] for _ in range(2))
    assert all(torch.equal(getattr(first, n), getattr(second, n)) for n in ("means", "quats", "scales", "colors"))


def test_the_disc_contains_a_fifth_of_the_gaussians():
    splats, _ = Scene("many", 48, 32, 100_000, 3.0).make("disc", "cpu")
    assert splats.is_dynamic.float().mean().item() == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("preset", ["paper", "best"])
def test_steps_of_both_stages_are_measured(preset):
    measured = measure_steps(300, (48, 32), "cpu", 1, preset)
    assert (measured["gaussians"], measured["width"], measured["height"]) == (300, 48, 32)
    assert measured["stage1_ms"] > 0
    assert measured["stage2_ms"] > 0
    assert measured["3dgs_ms"] > 0


def test_a_plain_step_compares_the_joint_image_alone_without_networks_and_depth():
    protocol = Protocol(PRESETS["paper"], has_depth=True)
    phase = protocol.phase_at(protocol.stage2.start)
    plain, omitted = plain_phase(phase), ("use_deformation", "use_appearance", "with_depth", "with_branches")
    assert all(getattr(phase, name) for name in omitted)
    assert not any(getattr(plain, name) for name in omitted)
    assert plain.with_joint


def test_the_scene_for_step_times_has_both_branches_and_the_networks_of_the_paper():
    splats, camera = random_splats(1000, 64, 48, 3.0, 0)
    scene = random_scene(splats, in_disc(splats.means, camera), PRESETS["paper"].model)
    assert 100 < len(scene.dynamic) < 300
    assert len(scene.static) + len(scene.dynamic) == 1000
    assert len(scene.deformation.trunk.sizes) == 9
    activated = scene.splats(torch.zeros(1))
    assert torch.allclose(activated.scales.sort(0).values, splats.scales.sort(0).values, rtol=1e-5)


def test_frames_per_second_of_a_run_are_written(tmp_path, capsys):
    data, run = tiny.write(tmp_path), tmp_path / "run"
    trainer = tiny.trainer(data, run, dataclasses.replace(tiny.CONFIG, data=data))
    Run.create(run, trainer.config)
    trainer.save()
    report = ["--json", str(tmp_path / "out.json")]
    assert main(["bench", "--device", "cpu", "--fps", str(run), *report]) == 0
    (measured,) = json.loads((tmp_path / "out.json").read_text())["fps"]
    assert measured["frames_per_second"] > 0
    assert measured["static"] == len(trainer.scene.static)
    assert (measured["width"], measured["height"]) == trainer.capture.cameras[trainer.capture.val[0]].size
    assert "frames per second" in capsys.readouterr().out
    assert main(["bench", "--device", "cpu", "--fps", str(run), "--sizes", "16x12", "40x30", *report]) == 0
    measured = json.loads((tmp_path / "out.json").read_text())["fps"]
    assert [(row["width"], row["height"]) for row in measured] == [(16, 12), (40, 30)]
