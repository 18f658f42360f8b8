"""How the package is installed: its version, and where its extras come from."""

import shlex
from pathlib import Path


def version() -> str:
    """Of the installed package; ``0+unknown`` where a checkout runs without being installed."""
    from importlib import metadata  # slow to import

    try:
        return metadata.version("warpgs")
    except metadata.PackageNotFoundError:
        return "0+unknown"


def install_command(extra: str) -> str:
    """How to install an extra of the package: from the checkout that it runs from, or else from the package index."""
    checkout = Path(__file__).parents[2]
    if (checkout / "pyproject.toml").exists():
        constraints = checkout / "constraints.txt"
        versions = f"-c {shlex.quote(str(constraints))} " if constraints.exists() else ""
        return f"pip install {versions}-e {shlex.quote(f'{checkout}[{extra}]')}"
    return f"pip install 'warpgs[{extra}]'"
