"""Packages of npm that are installed for all projects (``npm install --global``)."""

import functools
import shutil
import subprocess
from pathlib import Path

NODE = shutil.which("node")


@functools.cache
def packages():
    """The folder of global packages; None without npm."""
    npm = shutil.which("npm")
    if npm is None:
        return None
    done = subprocess.run([npm, "root", "--global"], capture_output=True, text=True, check=False)
    return Path(done.stdout.strip()) if done.returncode == 0 else None


def has(*names):
    """Whether packages are installed, and node."""
    folder = packages()
    return NODE is not None and folder is not None and all((folder / name).is_dir() for name in names)


def run(folder, program, *arguments):
    """Runs an ES module, which imports global packages by their paths."""
    (folder / "program.mjs").write_text(program)
    done = subprocess.run(
        [str(NODE), "program.mjs", *map(str, arguments)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
