"""The example programs, on tiny sizes."""

import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

import warpgs
from tests import tiny
from warpgs.runs.run import Run
from warpgs.visualize.images import to_bytes

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs an example with arguments, as ``python examples/NAME.py ARGUMENTS``; returns what it printed."""

    def run(name: str, *arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    with tiny.in_haste():
        yield run


@pytest.mark.parametrize("name", sorted(path.stem for path in EXAMPLES.glob("*.py")))
def test_every_example_has_a_help_text(name, run, capsys):
    with pytest.raises(SystemExit) as ended:
        run(name, "--help")
    assert ended.value.code == 0
    assert "--out" in capsys.readouterr().out


def test_fit_image_improves_the_psnr_by_more_than_12_decibels_in_60_steps(run, tmp_path):
    printed = run("fit_image", "--width", 48, "--gaussians", 400, "--steps", 60, "--out", tmp_path)
    before, after = (float(value) for value in re.findall(r"([\d.]+) dB", printed))
    assert after > before + 12
    for name in ("before.png", "after.png"):
        assert cv2.imread(str(tmp_path / name)).shape == (48, 48, 3)


@pytest.mark.parametrize("is_bilevel", [0, 1])
def test_fit_image_reads_images_without_colours(run, tmp_path, is_bilevel):
    grey = cv2.imread(str(EXAMPLES.parent / "docs" / "images" / "page.jpg"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "grey.png"), grey[:90, :180], [cv2.IMWRITE_PNG_BILEVEL, is_bilevel])
    run("fit_image", tmp_path / "grey.png", "--width", 32, "--gaussians", 20, "--steps", 1, "--out", tmp_path)
    assert cv2.imread(str(tmp_path / "after.png")).shape == (16, 32, 3)


def test_train_from_python_leaves_a_run_with_metrics(run, finished_run, tmp_path):
    data = Run.open(finished_run).config.data
    run("train_from_python", "--data", data, "--iterations", 6, "--out", tmp_path / "run")
    assert (tmp_path / "run" / "metrics.json").is_file()


def test_render_a_time_writes_the_image_of_that_view_and_time(run, finished_run, tmp_path):
    out = tmp_path / "time.png"
    run("render_a_time", finished_run, "--time", 0.25, "--view", 2, "--out", out)
    capture, scene = Run.open(finished_run).open_capture(), warpgs.open_run(finished_run)
    camera = capture.cameras[capture.train[2]].to(scene.device)
    expected = to_bytes(scene.render(camera, 0.25).joint.image)
    assert (cv2.imread(str(out))[..., ::-1] == expected).all()


def cells(name: str) -> list[str]:
    """The code of a notebook, cell by cell."""
    notebook = json.loads((EXAMPLES / f"{name}.ipynb").read_text())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook["cells"])
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def executed(name: str, **changed: tuple[str, str]) -> dict[str, Any]:
    """The variables that a notebook leaves, with other values in some of its assignments."""
    code = "\n".join(cells(name))
    for before, after in changed.values():
        assert code.count(before) == 1, before
        code = code.replace(before, after)
    variables: dict[str, Any] = {}
    with tiny.in_haste():
        exec(compile(code, f"{name}.ipynb", "exec"), variables)
    return variables


def test_the_notebook_about_an_image_fits_it():
    sizes = ("WIDTH, NUM_GAUSSIANS, STEPS = 128, 2000, 300", "WIDTH, NUM_GAUSSIANS, STEPS = 48, 400, 60")
    left = executed("fit_an_image", sizes=sizes)
    assert left["psnr"][-1] > left["psnr"][0] + 12
    assert left["pixels"].shape == (48, 96, 3)


def test_the_notebook_about_a_run_renders_it(finished_run, capsys):
    left = executed("open_a_run", run=('RUN = Path("runs/builtin-quick")', f"RUN = Path({str(finished_run)!r})"))
    scene, camera = warpgs.open_run(finished_run), left["camera"]
    assert torch.equal(left["layers"][0], scene.render(camera).joint.image)
    assert left["strip"].shape == (camera.height, 5 * camera.width, 3)
    assert left["closer"].size == camera.size
    assert "scene units" in capsys.readouterr().out


def test_rendering_a_view_or_a_run_that_does_not_exist_is_an_error_of_one_line(run, finished_run, tmp_path, capsys):
    for arguments, words in (
        ((finished_run, "--view", 1000), "--view must be from 0 to"),
        ((tmp_path / "no",), "not exist"),
    ):
        with pytest.raises(SystemExit) as ended:
            run("render_a_time", *arguments)
        assert ended.value.code == 2
        assert words in capsys.readouterr().err.splitlines()[-1]
