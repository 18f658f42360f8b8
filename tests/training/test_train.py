"""``python train.py`` as a user runs it, and ``warpgs.train``."""

import csv
import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch

import warpgs
from tests import tiny
from tests.data.captures import edit_json, look_away, stop_time
from warpgs import cli
from warpgs.captures.check import require_fit
from warpgs.captures.findings import UnfitCaptureError
from warpgs.captures.opening import load_capture
from warpgs.config import TrainConfig
from warpgs.config.presets import PRESETS
from warpgs.data.images import read_image
from warpgs.evaluation import evaluate_run
from warpgs.initialization import prepare_start
from warpgs.runs import checkpoint
from warpgs.runs.config_file import parse_config, read_config
from warpgs.runs.run import Run
from warpgs.synthetic.room import BuiltinScene, builtin_capture
from warpgs.training import train as script
from warpgs.views import view_cache

SCRIPT = str(Path(__file__).parents[2] / "train.py")
SMALL = BuiltinScene(width=64, height=36, num_frames=6, num_samples=2, num_points=400)
QUICK = ["--preset", "quick", "--device", "cpu"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return builtin_capture(tmp_path_factory.mktemp("cache"), SMALL, quiet=True)


@pytest.fixture(scope="module")
def finished(data, tmp_path_factory):
    """A run of the script in a process of its own, and its folder."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    command = [sys.executable, SCRIPT, "--data", str(data), *QUICK, "--iterations", "40", "--out", str(folder)]
    return subprocess.run(command, capture_output=True, text=True, check=False), folder


@pytest.fixture
def train(capsys, contracts_off):
    """Runs the script in this process; returns its exit code, and what it wrote to both outputs."""

    def run(*arguments):
        try:
            code = cli.train(list(map(str, arguments)), "train.py")
        except SystemExit as stop:
            code = stop.code
        return code, "".join(capsys.readouterr())

    return run


@pytest.fixture
def refused(train):
    """Runs the script with wrong input; returns what it wrote."""

    def run(*arguments):
        code, text = train(*arguments)
        assert code == 2
        assert "Traceback" not in text
        return text

    return run


def test_a_run_ends_with_a_summary_of_its_metrics(finished):
    run, _ = finished
    assert run.returncode == 0, run.stderr
    assert "PSNR" in run.stdout
    assert "LPIPS not measured" in run.stdout
    assert "MS-SSIM not measured (a side is below 161 px)" in run.stdout


def test_a_run_says_how_far_its_depth_can_be_trusted(finished):
    assert re.search(
        r"depth is off by 0\.\d% at the sparse points, its weight is 1\.00 \(medians\)", finished[0].stdout
    )


def test_a_run_that_is_being_trained_cannot_be_resumed(finished, refused):
    run = Run.open(finished[1])
    with run.lock():
        text = refused("--resume", finished[1], "--device", "cpu")
    assert f"train.py: {finished[1]} is being trained by another process" in text
    with run.lock():
        pass  # unlocked


def test_a_run_is_trained_without_the_compiler_of_torch(data, tmp_path):
    """It takes seconds to import."""
    code = (
        "import sys\n"
        "from warpgs import cli\n"
        "cli.train(sys.argv[1:], 'train.py')\n"
        "print('compiler:', 'torch._dynamo' in sys.modules)"
    )
    options = ["--data", str(data), "--iterations", "12", "--optim.poses", "1e-4", "--out", str(tmp_path / "run")]
    run = subprocess.run([sys.executable, "-c", code, *QUICK, *options], capture_output=True, text=True, check=True)
    assert run.stdout.endswith("compiler: False\n")


def test_a_run_writes_its_metrics(finished):
    metrics = json.loads((finished[1] / "metrics.json").read_text())
    wanted = (
        "psnr ssim lpips psnr_static psnr_dynamic flicker fps train_seconds num_static num_dynamic iterations commit"
    )
    assert set(wanted.split()) <= set(metrics)
    assert metrics["iterations"] == 40
    assert metrics["lpips"] is None
    assert metrics["psnr"] > 10


def test_a_run_writes_metrics_of_every_view(finished):
    with open(finished[1] / "views.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["right_000000", "right_000002", "right_000004"]
    assert rows[0]["lpips"] == ""
    assert float(rows[0]["psnr"]) > 10


def test_a_run_writes_images_a_video_and_events(finished):
    folder = finished[1]
    sheet = cv2.imread(str(folder / "images/right_000002.png"))
    assert sheet.shape[1] == 5 * SMALL.width
    video = cv2.VideoCapture(str(folder / "time.mp4"))
    assert video.read()[0]
    assert list((folder / "events").glob("events*"))


def test_a_run_writes_its_resolved_config(finished):
    config = json.loads((finished[1] / "config.json").read_text())
    schedule = config["schedule"]
    assert schedule["pretrain"] + schedule["stage1"] + schedule["stage2"] == 40
    assert config["device"] == "cpu"


def test_a_run_keeps_its_config_as_it_was_asked_for(finished):
    start = json.loads((finished[1] / "start.json").read_text())
    asked = parse_config(start["asked"], "start.json")
    assert (asked.iterations, read_config(finished[1]).iterations) == (40, None)
    assert (asked.schedule, asked.background) == (PRESETS["quick"].schedule, "auto")


def test_a_run_keeps_in_its_metrics_what_was_noted_before_the_first_step(finished):
    notes = json.loads((finished[1] / "metrics.json").read_text())["notes"]
    assert any(note.startswith("depth is off by ") for note in notes)
    assert all(note in finished[0].stdout for note in notes)


def test_a_finished_run_can_be_evaluated_again(finished, capsys, monkeypatch):
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
    before = (finished[1] / "views.csv").read_text()
    assert cli.main(["eval", str(finished[1])]) == 0
    assert "PSNR" in capsys.readouterr().out
    assert (finished[1] / "views.csv").read_text() == before


def test_a_folder_without_a_capture_is_refused_in_one_line_with_exit_code_2(tmp_path, refused):
    text = refused("--data", tmp_path, *QUICK)
    assert "has no dataset.json" in text
    assert len([line for line in text.splitlines() if line.startswith("train.py:")]) == 1


def test_a_damaged_image_is_refused_by_name(tmp_path, refused):
    data = builtin_capture(tmp_path, SMALL, quiet=True)
    path = data / "rgb/1x/left_000003.png"
    path.write_bytes(path.read_bytes()[:100])
    assert "left_000003.png" in refused("--data", data, *QUICK, "--iterations", 40, "--out", tmp_path / "run")


def test_an_unfit_capture_is_refused_in_one_line_with_exit_code_1(tmp_path, train):
    data = builtin_capture(tmp_path, SMALL, quiet=True)
    look_away(data)
    code, text = train("--data", data, *QUICK, "--iterations", 40, "--out", tmp_path / "run")
    assert code == 1
    assert [line for line in text.splitlines() if line.startswith("error:")] == [
        "error: the cameras do not see the points: orientation, position or scene.json's center and scale are wrong"
    ]
    assert "Traceback" not in text
    assert not (tmp_path / "run").exists()


def test_one_time_for_all_frames_is_a_warning_if_everything_is_assumed_static(tmp_path):
    root = tiny.write(tmp_path)
    stop_time(root)
    capture, lines = load_capture(root), []
    require_fit(capture.assuming("static"), lines.append)
    assert any(line.startswith("warning: all training frames have one time") for line in lines)
    with pytest.raises(UnfitCaptureError, match="all training frames have one time") as error:
        require_fit(capture, lines.append)
    assert [finding.level for finding in error.value.findings] == ["error"]


def test_warnings_about_the_capture_are_printed(finished):
    run, _ = finished
    warnings = [line for line in run.stdout.splitlines() if line.startswith("warning:")]
    assert warnings == ["warning: 6 training frames are very few"]


def test_an_existing_run_is_not_overwritten(data, finished, refused):
    assert "is not empty" in refused("--data", data, *QUICK, "--out", finished[1])


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--bogus", 1), "bogus"),
        (("--iterations", 1), "iterations must be a number of at least 3"),
        (("--model.width", 0), "model.width must be a number of at least 1, got 0"),
    ],
)
def test_a_wrong_option_is_refused(data, refused, option, words):
    assert words in refused("--data", data, *QUICK, *option)


def test_resuming_with_other_options_is_refused(finished, refused):
    assert "omit --seed" in refused("--resume", finished[1], "--seed", 3)


def test_resuming_a_folder_without_a_run_is_refused(tmp_path, refused):
    assert "is not a run folder" in refused("--resume", tmp_path)


def test_ctrl_c_saves_a_checkpoint_and_tells_how_to_continue(data, tmp_path):
    # Background jobs and their children ignore SIGINT: restore the handler of a terminal.
    program = (
        "import runpy, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    folder = tmp_path / "run"
    options = ["--data", str(data), *QUICK, "--iterations", "100000", "--out", str(folder)]
    command = [sys.executable, "-c", program, SCRIPT, *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # what it does until it is stopped is wasted
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as run:
        while not checkpoint.list_checkpoints(folder):
            assert run.poll() is None
            time.sleep(0.05)
        time.sleep(2.0)
        run.send_signal(signal.SIGINT)
        try:
            _, stderr = run.communicate(timeout=60)
        finally:
            run.kill()
    assert run.returncode == 130
    assert "Traceback" not in stderr
    assert f"--resume {folder}" in stderr
    assert checkpoint.load(checkpoint.list_checkpoints(folder)[-1]).metadata.iteration > 0


def test_a_moved_capture_is_given_to_eval_and_to_resume(config, tmp_path, refused, train):
    warpgs.train(config)
    moved = config.data.rename(tmp_path / "elsewhere")
    error = refused("--resume", config.out)
    assert f"the capture of {config.out}, {config.data}, does not exist; if it was moved, give it by --data" in error
    (config.out / "metrics.json").unlink()
    assert cli.main(["eval", str(config.out), "--data", str(moved), "--device", "cpu"]) == 0
    assert (config.out / "metrics.json").exists()
    assert read_config(config.out).data == config.data
    code, _ = train("--resume", config.out, "--data", moved)
    assert code == 0
    assert read_config(config.out).data == moved
    assert cli.main(["eval", str(config.out), "--device", "cpu"]) == 0


def test_train_returns_the_finished_run_and_prints_nothing_unless_it_is_given_a_log(config, capsys):
    run = warpgs.train(config)
    assert run.folder == config.out
    assert run.trained_scene().metadata.iteration == tiny.LENGTH
    assert (run.folder / "metrics.json").is_file()
    assert capsys.readouterr() == ("", "")


@pytest.fixture
def only_described(monkeypatch):
    """Runs are neither trained nor evaluated."""
    for step in ("_train", "_evaluate"):
        monkeypatch.setattr(script, step, Mock())


@pytest.mark.parametrize(("preset", "is_slow"), [("best", True), ("paper", True), ("patient", False), (None, False)])
@pytest.mark.usefixtures("only_described")
def test_a_preset_for_a_gpu_says_so_on_the_cpu(config, preset, is_slow):
    lines = []
    warpgs.train(dataclasses.replace(config, preset=preset), log=lines.append)
    assert any(f"the preset {preset} is for a GPU" in line for line in lines) == is_slow


@pytest.mark.parametrize("has_half_size", [True, False])
@pytest.mark.usefixtures("only_described")
def test_on_the_cpu_half_the_size_is_suggested_only_if_the_capture_has_it(config, has_half_size):
    for folder in ("rgb", "resized_mask") if has_half_size else ():
        shutil.copytree(config.data / folder / "1x", config.data / folder / "2x")
    lines = []
    warpgs.train(dataclasses.replace(config, preset="paper"), log=lines.append)
    (line,) = [line for line in lines if "the preset paper is for a GPU" in line]
    assert "--preset patient" in line
    assert ("--factor 2" in line) == has_half_size


def test_training_says_that_depth_is_switched_off(config):
    lines = []
    warpgs.train(dataclasses.replace(config, depth=False), log=lines.append)
    assert "depth is switched off: training without depth, and without the pretraining that needs it" in lines
    assert not any("aligned" in line for line in lines)


def test_without_depth_training_says_so_and_needs_no_pretraining(config, tmp_path):
    shutil.copytree(config.data, tmp_path / "flat", ignore=shutil.ignore_patterns("depth"))
    lines = []
    warpgs.train(dataclasses.replace(config, data=tmp_path / "flat"), log=lines.append)
    assert any("the capture has no depth" in line and ": training without depth" in line for line in lines)


@pytest.mark.parametrize("is_builtin", [True, False])
def test_of_built_in_captures_neither_the_files_nor_advice_on_them_is_said(config, tmp_path, monkeypatch, is_builtin):
    shutil.copytree(config.data, tmp_path / "flat", ignore=shutil.ignore_patterns("depth"))
    monkeypatch.setattr("warpgs.captures.opening.builtin_folder", lambda *_: tmp_path / "flat")
    lines = []
    data = Path("builtin:balls") if is_builtin else tmp_path / "flat"
    warpgs.train(dataclasses.replace(config, data=data, out=tmp_path / "run"), log=lines.append)
    assert any("the capture has no depth" in line for line in lines)
    assert any("warpgs prepare" in line for line in lines) == (not is_builtin)
    assert any("metadata.json" in line for line in lines) == (not is_builtin)


def test_a_training_says_what_it_does_and_that_a_run_which_is_resumed_is_finished(config):
    lines = []
    warpgs.train(config, log=lines.append)
    assert any(line.startswith("builtin (read as nerfds): 6 views, on cpu, into ") for line in lines)
    assert any("PSNR" in line for line in lines)
    assert not any("is finished" in line for line in lines)
    assert any(re.fullmatch(r"evaluating \d+ views", line) for line in lines)
    assert warpgs.train(TrainConfig(resume=config.out), log=lines.append).config.schedule == config.schedule
    assert f"training is finished ({tiny.LENGTH} iterations), and the run is evaluated again" in "\n".join(lines)


def test_a_run_that_is_resumed_is_evaluated_as_it_is_told_now(config, tmp_path, monkeypatch):
    warpgs.train(config)
    given = []
    monkeypatch.setattr(script, "evaluate_run", lambda *arguments: given.append(arguments[2:]) or "")
    for name in ("alexnet.pth", "lpips_v0.1_alex_lin.pth"):
        (tmp_path / name).touch()
    warpgs.train(TrainConfig(resume=config.out, lpips=tmp_path, lpips_net="alex"))
    assert given == [((tmp_path, "alex"), "cpu", True)]


def test_ctrl_c_in_the_evaluation_says_how_to_evaluate(config, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(script, "evaluate_run", interrupted)
    with pytest.raises(KeyboardInterrupt, match=f"run it with warpgs eval {config.out}$"):
        warpgs.train(config)
    (config.out / "alexnet.pth").touch()
    (config.out / "lpips_v0.1_alex_lin.pth").touch()
    given = TrainConfig(resume=config.out, lpips=config.out, lpips_net="alex")
    with pytest.raises(KeyboardInterrupt, match=f"{config.out} --lpips {config.out} --lpips-net alex$"):
        warpgs.train(given)


def cut_off(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def shrink(path):
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[1:])


@pytest.fixture
def held_out(config, tmp_path):
    """The config of a run on a capture of its own, and the image and the mask of its last evaluation frame."""
    data = shutil.copytree(config.data, tmp_path / "damaged")
    name = json.loads((data / "dataset.json").read_text())["val_ids"][-1]
    files = {"image": data / f"rgb/1x/{name}.png", "mask": data / f"resized_mask/1x/{name}.png.png"}
    return dataclasses.replace(config, data=data), files


@pytest.mark.parametrize("is_resumed", [False, True], ids=["new", "resumed"])
@pytest.mark.parametrize(
    ("damage", "text"), [(cut_off, "is truncated"), (shrink, "expected 32×24")], ids=["truncated", "size"]
)
@pytest.mark.parametrize("kind", ["image", "mask"])
def test_a_damaged_evaluation_frame_is_refused_before_training(held_out, kind, damage, text, is_resumed, monkeypatch):
    given, files = held_out
    if is_resumed:
        script.make_trainer(given).save()
        given = TrainConfig(resume=given.out)
    damage(files[kind])
    monkeypatch.setattr(script, "Trainer", Mock(side_effect=AssertionError("training has begun")))
    with pytest.raises(ValueError, match=f"^{files[kind]}.* {text}"):
        warpgs.train(given)
    assert is_resumed or not given.out.exists()


def test_evaluation_frames_are_read_after_what_costs_no_time(held_out, monkeypatch):
    given, _ = held_out
    read = Mock(side_effect=ValueError("read"))
    monkeypatch.setattr(script, "check_views", read)
    given.out.mkdir()
    (given.out / "file").touch()
    with pytest.raises(ValueError, match="is not empty"):
        script.make_trainer(given)
    read.assert_not_called()
    (given.out / "file").unlink()
    for log in (None, Mock()):
        with pytest.raises(ValueError, match=r"^read$"):
            script.make_trainer(given, log)
        assert read.call_args.args[1:] == (log is None,)


def test_an_evaluation_frame_damaged_in_training_leaves_a_trained_run_and_says_how_to_evaluate_it(held_out):
    config, files = held_out
    frame, lines = files["image"], []
    whole = frame.read_bytes()

    def damage(progress):
        frame.write_bytes(whole[: len(whole) // 2])

    with pytest.raises(ValueError, match=f"{frame} is truncated"):
        warpgs.train(config, log=lines.append, callbacks=[damage])
    assert lines[-1].endswith(f"failed with the error below; once that is solved, run it with warpgs eval {config.out}")
    frame.write_bytes(whole)
    assert evaluate_run.evaluate_run(config.out, quiet=True)


@pytest.mark.parametrize("error", [OSError(28, "No space left"), torch.OutOfMemoryError("1 GB"), RuntimeError("a bug")])
def test_an_evaluation_that_fails_says_how_to_evaluate(config, monkeypatch, error):
    monkeypatch.setattr(script, "evaluate_run", Mock(side_effect=error))
    lines = []
    with pytest.raises(type(error)) as raised:
        warpgs.train(config, log=lines.append)
    assert raised.value is error
    assert lines[-1].endswith(f"failed with the error below; once that is solved, run it with warpgs eval {config.out}")


def test_half_precision_on_part_of_the_multiprocessors_is_refused_before_training(config, monkeypatch):
    warpgs.train(config)
    monkeypatch.setenv("CUDA_MPS_ACTIVE_THREAD_PERCENTAGE", "35")
    monkeypatch.setattr(script, "_own_device", lambda asked: "cuda")
    for given in (dataclasses.replace(config, out=config.out.with_name("new")), TrainConfig(resume=config.out)):
        with pytest.raises(ValueError, match="CUDA_MPS_ACTIVE_THREAD_PERCENTAGE=35: with part"):
            warpgs.train(given)
    assert not config.out.with_name("new").exists()
    assert not Run.open(config.out).trained_scene().scene.appearance.trunk.uses_half


@pytest.mark.parametrize("distortion", [True, False])
def test_a_run_is_trained_and_evaluated_on_recorded_frames_with_the_lens_or_a_centred_pinhole(
    config, tmp_path, distortion
):
    data = shutil.copytree(config.data, tmp_path / "bent")
    for path in (data / "camera").iterdir():
        edit_json(path, radial_distortion=[0.5, 0.0, 0.0], principal_point=[14.0, 13.0])
    config, shown = dataclasses.replace(config, data=data, distortion=distortion), []
    run = warpgs.train(config, callbacks=[lambda progress: shown.append(progress.capture)])
    name = shown[0].val[0]
    recorded = read_image(data / f"rgb/1x/{name}.png", (32, 24))
    for capture in (shown[0], warpgs.open_run(run.folder, "cpu").open_capture(quiet=True)):
        camera = capture.cameras[name]
        assert camera.K[:2, 2].tolist() == ([14.0, 13.0] if distortion else [16.0, 12.0])
        assert (camera.distortion is not None) == distortion
        assert np.array_equal(capture.frame(name).image.numpy(), recorded)


@pytest.mark.parametrize("written", [{"undistort": True}, {}])
def test_a_run_on_undistorted_frames_is_evaluated_but_not_resumed(config, tmp_path, written):
    data = shutil.copytree(config.data, tmp_path / "bent")
    run = warpgs.train(dataclasses.replace(config, data=data))
    edit_json(run.folder / "config.json", distortion=None, **written)
    assert warpgs.train(TrainConfig(resume=run.folder)).config.distortion
    for path in (data / "camera").iterdir():
        edit_json(path, radial_distortion=[0.1, 0.0, 0.0])
    edit_json(run.folder / "config.json", distortion=None, **written)
    with pytest.raises(ValueError, match=r"cannot be resumed: its frames were undistorted"):
        warpgs.train(TrainConfig(resume=run.folder))
    assert "PSNR" in evaluate_run.evaluate_run(run.folder, quiet=True)


def test_train_raises_on_an_unknown_dataset_or_model(config):
    for changes in ({"dataset": "imaginary"}, {"model": dataclasses.replace(tiny.MODEL, deformation="imaginary")}):
        with pytest.raises(ValueError, match="imaginary"):
            warpgs.train(dataclasses.replace(config, **changes))
        assert not config.out.exists()


def test_train_raises_on_an_unfit_capture(config):
    look_away(config.data)
    with pytest.raises(UnfitCaptureError, match="the cameras do not see the points"):
        warpgs.train(config)


def described(data, folder, **changes):
    """What a training says before its first iteration."""
    lines = []
    config = dataclasses.replace(PRESETS["quick"], data=data, device="cpu", out=folder / "run", **changes)
    script._describe(script.make_trainer(config, lines.append), lines.append)
    return lines


def test_views_without_an_alignment_do_not_count_in_the_error_of_depth(data, tmp_path, monkeypatch):
    whole = prepare_start.align_to_points

    def mostly_unknown(*arguments, **options):
        found = whole(*arguments, **options)
        found.alignments[1:], found.errors[1:] = torch.nan, torch.inf
        return found

    monkeypatch.setattr(prepare_start, "align_to_points", mostly_unknown)
    lines = described(data, tmp_path)
    assert any(re.match(r"depth is off by \d\.\d% ", line) for line in lines)
    assert any("depth can be aligned with the sparse points in 1 of" in line for line in lines)


@pytest.mark.parametrize("free", [1e15, 0])
def test_views_that_do_not_fit_on_the_device_are_announced(data, tmp_path, monkeypatch, free):
    monkeypatch.setattr(view_cache.shutil, "disk_usage", lambda folder: types.SimpleNamespace(free=free))
    expected = "read from a file in" if free else "decoded in every iteration: there is no space for a file in"
    lines = described(data, tmp_path, resident_bytes=1000)
    assert any("--resident-bytes" in line and expected in line for line in lines)


@pytest.mark.parametrize(("joint_from", "trust"), [(0, [1, 0, 1, 0, 1, 0]), (None, [1] * 6)])
def test_masks_that_are_wrongly_empty_are_trusted_only_where_nothing_else_is_learned(data, tmp_path, joint_from, trust):
    root = shutil.copytree(data, tmp_path / "capture")
    for name in load_capture(root).train[1::2]:
        path = root / f"resized_mask/1x/{name}.png.png"
        cv2.imwrite(str(path), np.full_like(cv2.imread(str(path)), 255))
    schedule = dataclasses.replace(tiny.SCHEDULE, joint_from=joint_from)
    config = dataclasses.replace(tiny.CONFIG, data=root, out=tmp_path / "run", schedule=schedule)
    lines = []
    assert script.make_trainer(config, lines.append).views.mask_trust.tolist() == trust
    assert any("3 of 6 masks mark nothing" in line for line in lines)
