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
    found = parse_builtin(data)
    require_factor(data, factor)
    if found.name == "room":
        from .room import builtin_capture  # imports torch

        return builtin_capture(quiet=quiet)
    if found.name == "balls":
        from .balls import balls_capture

        return balls_capture(quiet=quiet)
    if found.name == "rig":
        from .rig import RigSize, rig_capture

        size = RigSize(num_frames=found.num_frames, num_cameras=found.num_cameras, offset=found.offset)
        return rig_capture(size=size, quiet=quiet)
    from .studio import StudioSize, studio_capture

    studio_size = StudioSize(num_frames=found.num_frames)
    folder = studio_capture(found.depth, size=studio_size, quiet=quiet, sky=found.sky)
    if found.tracks == "none":
        return folder
    from .studio_tracks import with_tracks

    return with_tracks(folder, found.tracks, studio_size, quiet)
