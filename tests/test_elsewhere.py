"""Commands work where there is nothing that only POSIX has, as far as that can be told on this system."""

import builtins
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests import elsewhere

ROOT = Path(__file__).parent.parent

COMMANDS = """
import importlib
import pkgutil
import sys
from pathlib import Path
from tests import elsewhere

elsewhere.install()
import warpgs
from warpgs import posix
from warpgs.cli import main
from warpgs.viewer import serve

assert posix.sys.platform == "win32" and not hasattr(posix.os, "fork") and not hasattr(posix.signal, "SIGKILL")
serve._wait = lambda: None
capture, out = sys.argv[1:]
tiny = "--preset quick --model.width 8 --model.depth 2 --model.skip 1 --checkpoint-every 1 --device cpu".split()

def run(*arguments):
    try:
        code = main(list(arguments))
    except SystemExit as end:
        code = end.code
    assert code in (0, None), (arguments, code)

for module in pkgutil.walk_packages(warpgs.__path__, "warpgs."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
run("--version")
run("--help")
run("train", "--help")
run("train", "--data", capture, "--out", out, "--iterations", "3", *tiny)
newest = max(Path(out, "checkpoints").iterdir())
newest.unlink()
run("train", "--resume", out)
assert newest.is_file()
run("check", capture)
Path(out + "-copy").mkdir()
run("import", capture, out + "-copy", "--quiet")
run("export", out, "--quiet")
run("render", out, "--path", "fixed", "--frames", "2", "--device", "cpu", "--quiet")
run("report", out)
run("view", out, "--port", "0", "--device", "cpu")
"""


def python(code: str, *arguments: object) -> None:
    """Runs code in a process whose output is encoded as on Windows."""
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", timeout=600)
    assert result.returncode == 0, result.stderr


def test_a_capture_is_trained_resumed_copied_exported_and_viewed(finished_run, tmp_path):
    capture = shutil.copytree(finished_run.parent / "capture", tmp_path / "capture")
    python(COMMANDS, next(path.parent for path in capture.rglob("dataset.json")), tmp_path / "run")


@pytest.mark.parametrize(
    ("code", "error"),
    [
        ("import fcntl", ModuleNotFoundError),
        ("from os import fork", ImportError),
        ("import os\nos.O_NONBLOCK", AttributeError),
        ("import signal\nsignal.SIGHUP", AttributeError),
    ],
)
def test_what_is_missing_is_an_error_in_this_package_alone(code, error, monkeypatch):
    """Otherwise the commands above could not fail."""
    monkeypatch.setattr(builtins, "__import__", builtins.__import__)  # restores it
    elsewhere.hide()
    exec(code, {"__name__": "a_library.module"})
    with pytest.raises(error):
        exec(code, {"__name__": "warpgs.module"})


FILES = """
import os, mmap, sys
from pathlib import Path
from tests import elsewhere

elsewhere.install()
os.chdir(sys.argv[1])
Path("a").write_text("a", "utf-8")
Path("b").write_text("b", "utf-8")
os.replace("a", "b")
with open("b", "rb") as file:
    mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if {mapped} else None
    if {mapped}:
        file.close()
    try:
        {code}
    except OSError:
        sys.exit(0)
sys.exit("was not refused")
"""


@pytest.mark.parametrize(
    ("code", "mapped"),
    [
        ("os.replace('b', 'c')", False),
        ("Path('c').touch(); os.replace('c', 'b')", False),
        ("Path('b').unlink()", False),
        ("Path('b').unlink()", True),
        ("os.rename(os.getcwd(), os.getcwd() + '2')", False),
        ("Path('d').mkdir(); Path('e').mkdir(); os.rename('d', 'e')", False),
        ("os.symlink('b', 'c')", False),
        ("open('a:b', 'w')", False),
        ("open('nul.txt', 'wb')", False),
        ("os.mkdir('a.')", False),
    ],
)
def test_files_are_as_on_windows(code, mapped, tmp_path):
    """Otherwise the commands above could not fail."""
    python(FILES.replace("{mapped}", str(mapped)).replace("{code}", code), tmp_path)
