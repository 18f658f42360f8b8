"""Optional packages that read and write files."""

import importlib
from pathlib import Path
from types import ModuleType

from warpgs.command_line.version import install_command


def required(path: Path, module: str, package: str, extra: str = "export") -> ModuleType:
    """A module of an optional package, of an extra of this one, that reads or writes a file.

    Raises:
        OSError: If the package is not installed; the message names it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise OSError(f"{path} needs {package}: {install_command(extra)}") from error
