"""The version of the package."""


def version() -> str:
    """Of the installed package; ``0+unknown`` where a checkout runs without being installed."""
    from importlib import metadata  # slow to import

    try:
        return metadata.version("warpgs")
    except metadata.PackageNotFoundError:
        return "0+unknown"
