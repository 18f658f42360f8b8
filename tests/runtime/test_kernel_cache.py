"""Damaged files in Warp's cache are compiled again, and a home that cannot be written is replaced."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from warpgs.runtime import kernel_cache

CPU = wp.get_device("cpu")


@wp.kernel
def add_one(values: wp.array(dtype=float)):
    i = wp.tid()
    values[i] = values[i] + 1.0


def load_in_a_new_process():
    """Forgets the module, as a new process has never loaded it."""
    add_one.module.unload()
    kernel_cache._loaded.clear()
    kernel_cache.load(add_one, CPU, 256)


def runs():
    values = wp.zeros(3, dtype=float, device=CPU)
    wp.launch(add_one, 3, [values], device=CPU)
    return values.numpy().tolist() == [1.0, 1.0, 1.0]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    before, folder = wp.config.kernel_cache_dir, tmp_path_factory.mktemp("kernels")
    wp.config.kernel_cache_dir = str(folder)
    yield folder
    wp.config.kernel_cache_dir = before
    load_in_a_new_process()


@pytest.fixture
def folder(cache):
    """The module's folder, with a seal."""
    load_in_a_new_process()
    (folder,) = cache.iterdir()
    assert (folder / kernel_cache.SEAL).is_file()
    return folder


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip_a_bit(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 16
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [truncate, flip_a_bit, Path.unlink], ids=["truncated", "bit", "missing"])
@pytest.mark.parametrize("ending", [".o", ".meta"])
def test_a_damaged_module_is_named_and_compiled_again(folder, capsys, damage, ending):
    (path,) = folder.glob(f"*{ending}")
    damage(path)
    load_in_a_new_process()
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"the kernel cache is damaged ({path} is not what was written): {folder} is compiled again" in error
    assert runs()
    load_in_a_new_process()
    assert capsys.readouterr().err == ""


def test_truncated_metadata_without_a_seal_is_compiled_again(folder, capsys):
    (folder / kernel_cache.SEAL).unlink()
    (path,) = folder.glob("*.meta")
    truncate(path)
    load_in_a_new_process()
    assert f"{folder} is compiled again" in capsys.readouterr().err
    assert runs()


def test_a_damaged_seal_costs_a_compilation_at_most(folder, capsys):
    random = np.random.default_rng(0)
    whole = (folder / kernel_cache.SEAL).read_bytes()
    for position in random.integers(0, len(whole), 3):
        data = bytearray((folder / kernel_cache.SEAL).read_bytes())
        data[position % len(data)] ^= 1
        (folder / kernel_cache.SEAL).write_bytes(data)
        load_in_a_new_process()
        assert runs()
    (folder / kernel_cache.SEAL).write_bytes(b"")
    load_in_a_new_process()
    assert (folder / kernel_cache.SEAL).read_bytes() == whole
    capsys.readouterr()


def test_the_first_compilation_of_a_process_is_announced(folder, capsys):
    kernel_cache._announce_compilation.cache_clear()
    for _ in range(2):
        shutil.rmtree(folder)
        load_in_a_new_process()
    error = capsys.readouterr().err
    assert error == f"warpgs: compiling kernels that are not in {folder.parent} yet: this can take a minute\n"


def test_an_undamaged_module_is_not_compiled_again(folder, capsys):
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    load_in_a_new_process()
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    assert capsys.readouterr().err == ""


WITHOUT_A_HOME = """
import sys
from pathlib import Path
from warpgs.runtime import kernel_cache
kernel_cache.init_warp()
import warp
print(warp.config.kernel_cache_dir)
"""


def test_without_a_writable_home_kernels_are_cached_in_a_temporary_folder(tmp_path):
    (tmp_path / "file").touch()  # nobody, not even root, can create a folder in it
    environment = {**os.environ, "HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    for name in ("WARP_CACHE_PATH", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    command = [sys.executable, "-c", WITHOUT_A_HOME]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    lines = [line for line in done.stderr.splitlines() if line.startswith("warpgs: ")]
    assert len(lines) == 1
    assert "set WARP_CACHE_PATH to a folder that can be written" in lines[0]
    assert done.stdout.startswith(str(tmp_path / "warpgs-kernels-"))
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]  # removed at the end


@pytest.mark.skipif(torch.cuda.is_available(), reason="about machines without a GPU")
def test_nothing_is_printed_where_there_is_no_cuda_driver():
    done = subprocess.run([sys.executable, "-c", "import warpgs.runtime.launch"], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


@pytest.mark.parametrize(
    "command", ["python -c 'import warpgs.runtime.launch' 2>&-", 'TMPDIR=/proc python -c "$START"']
)
def test_warp_starts_without_standard_error_or_a_folder_for_temporary_files(command):
    start = "import tempfile; tempfile.tempdir = '/proc'; import warpgs.runtime.launch"
    environment = {**os.environ, "START": start, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    subprocess.run(["sh", "-c", command], check=True, env=environment)


FAILING_START = """
import sys
import warp
from warpgs.runtime import kernel_cache

def init():
    sys.stderr.write("before\\n" + kernel_cache.NO_DRIVER.decode() + " GPU execution …\\nafter\\n")
    raise RuntimeError("no start")

warp.init = init
kernel_cache.init_warp()
"""


def test_other_messages_of_a_start_are_kept():
    done = subprocess.run([sys.executable, "-c", FAILING_START], capture_output=True, text=True, check=False)
    lines = done.stderr.splitlines()
    assert lines[:2] == ["before", "after"]
    assert lines[-1] == "RuntimeError: no start"
