"""Commands on damaged files and with malformed options end with 0, or with one line and 1 or 2; never otherwise."""

import os
import random
import shlex
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.campaign.damage import Hang, bounded, damage
from tests.data.captures import edit_json
from tests.prepare.boards import write_video
from warpgs import cli
from warpgs.command_line.parsing import flags
from warpgs.errors import FAILED
from warpgs.evaluation import evaluate_run
from warpgs.export.writers import WRITERS
from warpgs.runs import checkpoint
from warpgs.viewer import serve

pytestmark = pytest.mark.usefixtures("quickly")

VALUES = ("", "nan", "inf", "-inf", "-1", "0", "1e300", "9" * 400, "null", "\x1b[31mred", "\udcff", "Tür/日本", "a,b")
PATHS = ("missing", "fifo", "/dev/zero", "empty", "capture/dataset.json", "run/config.json", "capture", "run", "huge")
PER_INPUT = 6
"""Inputs of the other campaigns per command, which takes longer."""

FILES = ("capture", "run", "keyframes.json", "capture/rgb/1x", "video.mp4")
TINY = ("--model.width", "8", "--model.depth", "2", "--model.skip", "1", "--iterations", "3", "--factor", "1")
FLAT = "hardly any texture"  # of a video that can still be read
FORMATS = sorted(WRITERS.keys() - {"usd", "4dgs"})  # those need packages that may be missing
KEYFRAMES = """{"keyframes": [
    {"view": "left_000001", "time": 0.0}, {"position": [0, 0, -2], "target": [0, 0, 0], "time": 1.0, "focal": 40}]}"""


def command(r: random.Random) -> list[str]:
    """A command line that would succeed on files that are intact, in the folder that holds them."""
    name = r.choice(["check", "import", "train", "resume", "eval", "render", "export", "report", "view", "prepare"])
    match name:
        case "check":
            return ["check", "capture", *r.choice([(), ("--json",)])]
        case "import":
            return ["import", "capture", "imported"]
        case "train":
            return ["train", "--data", "capture", "--out", "trained", "--device", "cpu", *TINY]
        case "resume":
            return ["train", "--resume", "run"]
        case "render":
            path = r.choice([("--path", "fixed"), ("--keyframes", "keyframes.json"), ("--path", "moving")])
            return ["render", "run", "--frames", "2", *path, "--write", r.choice(["png", "mp4", "gif"])]
        case "export":
            return ["export", "run", *r.choice([("--format", name) for name in FORMATS] + [("--frames", "2")])]
        case "view":
            return ["view", "run", "--port", "0"]
        case "prepare":
            options = ["--masks", "none", "--depth", "none"]
            return ["prepare", r.choice(["capture/rgb/1x", "video.mp4"]), "prepared", *options]
        case _:
            return [name, "run"]


def files_of(arguments: list[str]) -> list[Path]:
    """The files that a command reads, in the current folder."""
    given = [Path(argument) for argument in arguments if argument in FILES]
    roots = [*given, Path("capture")] if Path("run") in given else given
    files = [file for root in roots for file in ([root] if root.is_file() else root.rglob("*"))]
    return sorted(file for file in files if file.is_file() and "events" not in file.parts)


def malformed(arguments: list[str], r: random.Random) -> list[str]:
    """A command line with one wrong option or path."""
    options = sorted(flags(cli.COMMANDS[arguments[0]].load()))
    value = r.choice(VALUES if r.random() < 0.6 else PATHS)
    if r.random() < 0.7:
        return [*arguments, r.choice(options), *r.choice([(value,), (value,), ()])]
    chosen = r.choice([k for k, argument in enumerate(arguments) if argument in FILES])
    return [value if k == chosen else argument for k, argument in enumerate(arguments)]


@pytest.fixture
def original(tmp_path, finished_run):
    """A folder with a capture, a run of it, keyframes, a video, and paths that are not what is expected."""
    folder = tmp_path / "original"
    (data,) = (finished_run.parent / "capture").glob("*/builtin")
    shutil.copytree(data, folder / "capture")
    shutil.copytree(finished_run, folder / "run")
    for path in checkpoint.list_checkpoints(folder / "run")[:-2]:
        path.unlink()
    edit_json(folder / "run" / "config.json", data=str(folder / "capture"))
    assert cli.main(["eval", str(folder / "run"), "--quiet"]) == 0
    edit_json(folder / "run" / "config.json", data="capture")
    (folder / "keyframes.json").write_text(KEYFRAMES)
    (folder / "empty").mkdir()
    write_video(folder / "video.mp4", [np.full((24, 32, 3), 20 * k, np.uint8) for k in range(6)])
    return folder


def end(arguments: list[str], capsys) -> tuple[int, str]:
    """Exit code and last line on stderr of a command; both bounded and in the expected form."""
    with bounded(" ".join(arguments)):
        try:
            code = cli.main(arguments)
        except SystemExit as stop:
            code = 0 if stop.code is None else int(stop.code)
    output, errors = capsys.readouterr()
    lines = errors.replace("\r", "\n").strip().splitlines() or [""]
    assert code in (0, 1, FAILED), arguments
    assert "Traceback" not in errors, arguments
    assert "\x1b[31m" not in output + errors, arguments
    if code == FAILED:
        assert lines[-1].startswith("warpgs"), (arguments, errors)
    return code, lines[-1]


def test_commands_on_damaged_files_and_with_malformed_options(tmp_path, original, count, capsys, monkeypatch):
    monkeypatch.setattr(serve, "_wait", lambda: None)
    monkeypatch.setattr(evaluate_run, "VIDEO_FRAMES", 4)  # launches are slow where annotations are checked
    codes = Counter[int]()
    for seed in range(count // PER_INPUT):
        r, damaged = random.Random(seed), None
        work = tmp_path / "work"
        shutil.copytree(original, work)
        monkeypatch.chdir(work)
        os.mkfifo("fifo")
        arguments = command(r)
        if r.random() < 0.5:
            damaged = r.choice(files_of(arguments))
            damage(damaged, r)
        else:
            arguments = malformed(arguments, r)
        try:
            code, line = end(arguments, capsys)
            if damaged is not None and code == FAILED and FLAT not in line:
                assert damaged.name.split(".")[0] in line, line
        except (Exception, Hang) as error:
            raise AssertionError(f"input {seed}: warpgs {shlex.join(arguments)}, damaged: {damaged}") from error
        codes[code] += 1
        monkeypatch.chdir(tmp_path)
        shutil.rmtree(work)
    assert codes[FAILED] > 0.2 * count / PER_INPUT
    assert codes[0] > 0
