"""The folders of the built-in captures."""

from pathlib import Path

from warpgs.config.builtin import parse_builtin, require_factor


def builtin_folder(data: Path | str, quiet: bool = False, factor: int | None = None) -> Path:
    """The folder of a built-in capture, which is created on the first call.

    Args:
        data: Its name.
        quiet: Whether to hide that it is made.
        factor: Downscaling factor that is wanted; there is only 1.

    Raises:
        ValueError: If there is no such capture, or it lacks the factor.
        OSError: If it cannot be written.
    """
    name, depth, num_frames = parse_builtin(data)
    require_factor(data, factor)
    if name == "room":
        from .room import builtin_capture  # imports torch

        return builtin_capture(quiet=quiet)
    if name == "balls":
        from .balls import balls_capture

        return balls_capture(quiet=quiet)
    from .studio import StudioSize, studio_capture

    return studio_capture(depth, size=StudioSize(num_frames=num_frames), quiet=quiet)
