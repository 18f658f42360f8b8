"""Warp's cache of compiled kernels: what is damaged is compiled again, and a temporary folder replaces a missing home.

Warp trusts its files: a truncated one stops every start, and machine code with a flipped bit ends in an illegal
instruction. So the SHA-256 of a module's files is written beside them once the module has been loaded, and checked
before it is loaded by a later process.
"""

import atexit
import contextlib
import functools
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import warp as wp

from warpgs.command_line.screen import show_error
from warpgs.files import read_bounded

SEAL = "warpgs.sha256"
"""File in a module's folder with a line ``<SHA-256> <name>`` for each of its other files."""

MAX_SEAL, MAX_BYTES = 1 << 16, 1 << 28
"""Maximum size of this file and of a compiled module [bytes]; modules have less than a MiB."""

GPU_DEVICES = ("/dev/nvidiactl", "/dev/dxg")
"""Files of which one is there where Linux or WSL has an NVIDIA GPU."""

STDERR = 2
"""File descriptor of standard error, to which native libraries print."""

NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver."


def init_warp() -> None:
    """Initializes Warp, with its kernel cache in a temporary folder if the usual one cannot be written."""
    wp.config.log_level = wp.LOG_WARNING
    with _without_driver_warning():
        try:
            wp.init()
        except OSError as error:
            _use_temporary_folder(error)
            wp.init()
    folder = Path(wp.config.kernel_cache_dir)
    if not os.access(folder, os.W_OK) and not any(folder.iterdir()):  # a filled one may be part of an image
        _use_temporary_folder(f"{folder} cannot be written")


@contextlib.contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Drops what Warp's library says about a missing CUDA driver: a machine without a GPU needs none.

    ``choose_device`` raises an error where CUDA is asked for. Everything else on standard error is passed on. Where
    there is a GPU, or no way to filter, nothing is dropped.
    """
    printed: IO[bytes] | None = None
    if sys.stderr is not None and not any(Path(device).exists() for device in GPU_DEVICES):
        with contextlib.suppress(OSError):  # standard error is closed, or no folder for temporary files can be written
            os.fstat(STDERR)
            printed = tempfile.TemporaryFile()  # noqa: SIM115
    if printed is None:
        yield
        return
    sys.stderr.flush()
    stderr = os.dup(STDERR)
    with printed:
        os.dup2(printed.fileno(), STDERR)
        try:
            yield
        finally:
            sys.stderr.flush()
            os.dup2(stderr, STDERR)
            os.close(stderr)
            printed.seek(0)
            others = [line for line in printed if not line.startswith(NO_DRIVER)]
            os.write(STDERR, b"".join(others))


def _use_temporary_folder(reason: object) -> None:
    folder = tempfile.mkdtemp(prefix="warpgs-kernels-")  # a fixed name might hold kernels of another user
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    wp.config.kernel_cache_dir = folder
    show_error(
        f"warpgs: no cache for compiled kernels ({reason}): they are compiled at every start; "
        "set WARP_CACHE_PATH to a folder that can be written"
    )


_loaded: set[tuple[wp.Module, str, int]] = set()


def load(kernel: wp.Kernel, device: wp.Device, block_dim: int) -> None:
    """Loads the module of a kernel; what is damaged in its folder of the cache is compiled again, with a warning."""
    key = kernel.module, device.alias, 1 if device.is_cpu else block_dim  # as in wp.launch
    if key in _loaded:
        return
    folder = _folder(kernel.module, key[2])
    if damaged := _damaged_file(folder):
        _discard(folder, f"{damaged} is not what was written")
    elif not _has_code(folder, device):
        _announce_compilation()
    was_cached = folder.is_dir()
    try:
        wp.load_module(kernel.module, device, block_dim=key[2])
    except OSError:
        raise
    except Exception as error:  # of json, of Warp or of its linker
        if not was_cached:
            raise
        _discard(folder, error)
        wp.load_module(kernel.module, device, block_dim=key[2])
    _seal(folder)
    _loaded.add(key)


def is_compiled(kernel: wp.Kernel, device: wp.Device, block_dim: int) -> bool:
    """Whether the code of a kernel for a device is in the cache."""
    return _has_code(_folder(kernel.module, 1 if device.is_cpu else block_dim), device)


def _folder(module: wp.Module, block_dim: int) -> Path:
    return Path(wp.config.kernel_cache_dir) / str(module.get_module_identifier(block_dim))


def _has_code(folder: Path, device: wp.Device) -> bool:
    """Whether the folder of a module has code for a device: it may have that of GPUs of another compute capability."""
    names = "*.o" if device.is_cpu else f"*.sm{device.get_cuda_compile_arch()}[.af]*"
    return any(folder.glob(names))


@functools.cache
def _announce_compilation() -> None:
    """Says once per process why nothing happens for a while."""
    show_error(f"warpgs: compiling kernels that are not in {wp.config.kernel_cache_dir} yet: this can take a minute")


def _discard(folder: Path, reason: object) -> None:
    show_error(f"warpgs: warning: the kernel cache is damaged ({reason}): {folder} is compiled again")
    gone = folder.with_name(f"{folder.name}.damaged{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):  # another process was faster
        folder.rename(gone)
    shutil.rmtree(gone, ignore_errors=True)


def _read_seal(folder: Path) -> dict[str, str]:
    """SHA-256 by file name; empty if the module was never sealed."""
    try:
        lines = read_bounded(folder / SEAL, MAX_SEAL).decode(errors="replace").splitlines()
    except ValueError:
        return {}
    return {name: digest for digest, _, name in (line.partition(" ") for line in lines)}


def _damaged_file(folder: Path) -> Path | None:
    sealed = _read_seal(folder)
    return next((folder / name for name, digest in sealed.items() if _hash(folder / name) != digest), None)


def _hash(path: Path) -> str:
    """SHA-256 of a file; empty if it cannot be read."""
    try:
        return hashlib.sha256(read_bounded(path, MAX_BYTES)).hexdigest()
    except ValueError:
        return ""


def _seal(folder: Path) -> None:
    """Adds the hashes of the files that Warp has written since the last time; a cache that is not writable has none."""
    sealed = _read_seal(folder)
    names = sorted(path.name for path in folder.iterdir() if path.is_file() and not path.name.startswith(SEAL))
    if set(names) <= set(sealed):
        return
    partial = folder / f"{SEAL}.{os.getpid()}"  # other processes may seal the same module now
    with contextlib.suppress(OSError):
        partial.write_text("".join(f"{sealed.get(name) or _hash(folder / name)} {name}\n" for name in names), "utf-8")
        partial.replace(folder / SEAL)
