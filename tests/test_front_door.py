"""``import warpgs``, ``python -m warpgs`` and ``warpgs --help``: public, typed, and quick to start."""

import importlib.metadata
import os
import shlex
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

import warpgs
from warpgs.cli import COMMANDS
from warpgs.command_line import version

HEAVY = {"torch", "warp", "cv2", "pycolmap", "viser", "scipy", "skimage", "av", "tensorboard"}
"""Packages that take longer to import than a user waits for a help text."""


def run(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)


def imported_by(program):
    """The heavy packages that a program imports."""
    code = f"import sys\ntry:\n    {program}\nexcept SystemExit:\n    pass\nprint(*sys.modules)"
    ended = run("-c", code)
    assert ended.returncode == 0, ended.stderr
    return HEAVY & set(ended.stdout.splitlines()[-1].split())


def test_importing_the_package_imports_nothing_heavy():
    assert imported_by("import warpgs") == set()


@pytest.mark.parametrize("name", sorted({"Camera", "RenderSettings", "Splats", "load_capture", "open_run", "render"}))
def test_public_names_are_exported_and_documented(name):
    assert name in warpgs.__all__
    assert name in dir(warpgs)
    assert callable(getattr(warpgs, name))
    assert getattr(warpgs, name).__doc__


def test_render_is_the_function_whatever_was_imported_before():
    import warpgs.rendering

    assert warpgs.render is warpgs.rendering.render


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        warpgs.no_such_name  # noqa: B018


def test_the_version_is_that_of_the_installed_package():
    assert warpgs.__version__ == importlib.metadata.version("warpgs")
    assert run("-m", "warpgs", "--version").stdout.startswith(f"warpgs {warpgs.__version__}\n")


def test_a_checkout_that_is_not_installed_has_a_version(monkeypatch):
    missing = Mock(side_effect=importlib.metadata.PackageNotFoundError)
    monkeypatch.setattr(importlib.metadata.Distribution, "from_name", missing)
    assert warpgs.__version__ == "0+unknown"


def test_an_extra_comes_from_the_checkout_or_from_the_index(monkeypatch, tmp_path):
    checkout = Path(version.__file__).parents[2]
    assert version.install_command("viewer") == shlex.join(
        ["pip", "install", "-c", f"{checkout}/constraints.txt", "-e", f"{checkout}[viewer]"]
    )
    monkeypatch.setattr(version, "__file__", str(tmp_path / "warpgs" / "command_line" / "version.py"))
    assert version.install_command("viewer") == "pip install 'warpgs[viewer]'"


def test_the_package_is_typed():
    assert (Path(warpgs.__file__).parent / "py.typed").is_file()


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_imports_nothing_heavy(command):
    arguments = [command, "--help"] if command else ["--help"]
    assert imported_by(f"from warpgs.cli import main; main({arguments})") == set()


@pytest.mark.parametrize(
    "command",
    [
        "prepare nothing capture",
        "prepare nothing --add masks",
        "import nothing capture",
        "check nothing",
        "check builtin:studoi",
        "check builtin:studio?depht=none",
        "train --data nothing",
        "train --data builtin:studoi",
        "train --data builtin:studio?frames=161",
        "train --resume nothing",
        "train --iteratoins 5",
        "sweep nothing",
        "sweep nothing.toml",
        "eval nothing",
        "view nothing",
        "view",
        "render nothing",
        "render --nothing",
        "export nothing",
        "report nothing",
        "bench --scene nothing",
        "bench --fps nothing",
        "nothing",
    ],
)
def test_wrong_names_and_options_are_refused_before_anything_heavy_is_imported(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(warpgs.__file__).parents[1]))
    assert imported_by(f"from warpgs.cli import main; assert main({command.split()}) == 2") == set()


def test_train_is_a_command_and_a_script():
    script = Path(__file__).parents[1] / "train.py"
    by_command, by_script = run("-m", "warpgs", "train", "--help"), run(str(script), "--help")
    assert by_command.returncode == by_script.returncode == 0
    assert by_command.stdout.replace("warpgs train", "train.py").split() == by_script.stdout.split()


@pytest.mark.parametrize(
    "command",
    [
        "prepare video capture",
        "prepare capture --add masks",
        "demo",
        "import source capture",
        "check capture",
        "train",
        "sweep ablation",
        "eval run",
        "view run",
        "render run",
        "export run",
        "report run",
        "bench",
    ],
)
def test_ctrl_c_that_a_package_swallows_while_it_is_imported_ends_with_one_line_and_130(command, tmp_path):
    """The imports of numpy and torch turn it into other errors."""
    swallow = (
        "import os\nimport signal\ntry:\n    os.kill(os.getpid(), signal.SIGINT)\nexcept BaseException:\n    pass\n"
    )
    for package in ("numpy", "torch"):
        (tmp_path / f"{package}.py").write_text(swallow)
    # Background jobs and their children ignore SIGINT: restore the handler of a terminal.
    restore = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    (tmp_path / "sitecustomize.py").write_text(restore)
    for folder in ("source", "capture", "run"):
        (tmp_path / folder).mkdir()
    path = os.pathsep.join([str(tmp_path), str(Path(warpgs.__file__).parents[1])])
    program = [sys.executable, "-m", "warpgs", *command.split()]
    ended = subprocess.run(
        program, capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", f"warpgs {command.split()[0]}: stopped\n")


@pytest.mark.parametrize("program", [["-m", "warpgs"], [str(Path(__file__).parents[1] / "train.py")]])
@pytest.mark.parametrize(("arguments", "code"), [(["--version"], 0), (["--zzz"], 2), (["--help"], 0)])
def test_ctrl_c_while_python_ends_leaves_the_exit_code_and_the_output_as_they_are(program, arguments, code, tmp_path):
    """Python calls what is registered for its end, gives signals back to the system, then deletes objects."""
    interrupt = (
        "import atexit, os, signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Last:\n    def __del__(self, kill=os.kill, process=os.getpid()):\n        kill(process, 2)\n"
        "last = Last()\natexit.register(os.kill, os.getpid(), signal.SIGINT)\n"
    )
    (tmp_path / "sitecustomize.py").write_text(interrupt)
    expected = run(*program, *arguments)
    path = os.pathsep.join([str(tmp_path), str(Path(warpgs.__file__).parents[1])])
    environment = {**os.environ, "PYTHONPATH": path}
    ended = subprocess.run([sys.executable, *program, *arguments], capture_output=True, text=True, env=environment)
    assert ended.returncode == expected.returncode == code
    assert (ended.stdout, ended.stderr) == (expected.stdout, expected.stderr)


def test_a_command_refuses_wrong_input_in_one_line(tmp_path):
    ended = run("-m", "warpgs", "eval", str(tmp_path))
    assert ended.returncode == 2
    assert ended.stderr.strip().splitlines()[-1].startswith("warpgs eval: ")
    assert "Traceback" not in ended.stderr
