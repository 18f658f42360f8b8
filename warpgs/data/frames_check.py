"""Checks the numbers, times and files of the frames of a capture."""

from collections.abc import Iterator, Mapping

from .capture import MASKS_REMEDY, Capture
from .check_sample import Content
from .findings import Finding

MAX_ERRORS = 20
"""Maximum number of unreadable frames that are named."""


def check_counts(capture: Capture) -> Iterator[Finding]:
    """Notes of the loader, numbers of frames and their times."""
    yield from (Finding("note", "files", text) for text in capture.notes)
    sizes = sorted({camera.size for camera in capture.cameras.values()})
    shown = ", ".join(f"{w}×{h}" for w, h in sizes[:4])
    yield Finding("note", "counts", f"{len(capture.train)} frames to train on, {len(capture.val)} to evaluate, {shown}")
    times = sorted(capture.cameras[name].time for name in capture.train)
    distinct = len(set(times))
    is_guessed = capture.time_source.problem and capture.assumption != "static"
    yield Finding("warning" if is_guessed else "note", "time", str(capture.time_source))
    if distinct == 1 and len(times) > 1:
        text = f"all training frames have one time, but every moment needs its own ({capture.time_source.text})"
        if capture.assumption == "static":
            yield Finding("warning", "time", text)
        else:
            yield Finding("error", "time", f"{text}; train a scene without motion with --assume static")
    elif times[-1] - times[0] < 0.5:
        yield Finding("warning", "time", "training frames cover less than half of the time range")
    late = [n for n in capture.val if not times[0] <= capture.cameras[n].time <= times[-1]]
    if late:
        yield Finding("warning", "time", f"{len(late)} evaluation frames lie before or after all training frames")
    if len(capture.train) < 10:
        yield Finding("warning", "counts", f"{len(capture.train)} training frames are very few")


def check_files(capture: Capture, contents: Mapping[str, Content]) -> Iterator[Finding]:
    """What the files of the frames that were read hold, and whether those to train on have the masks they need."""
    total, num_read = len(capture.train) + len(capture.val), len(contents)
    if num_read < total:
        text = f"{num_read} of {total} frames were read, evenly spread: the check has no time for all"
        yield Finding("note", "files", f"{text}, training reads them all")
    damaged = {name: content.error for name, content in contents.items() if content.error is not None}
    for name, error in list(damaged.items())[:MAX_ERRORS]:
        # The other checks read training frames only.
        yield Finding("error", "files" if name in capture.train else "evaluation", error)
    if len(damaged) > MAX_ERRORS:
        text = f"{len(damaged) - MAX_ERRORS} more frames cannot be read"
        yield Finding("error", "files" if any(name in capture.train for name in damaged) else "evaluation", text)
    readable = [content for content in contents.values() if content.error is None]
    num_masks, num_depths = sum(c.dynamic is not None for c in readable), sum(c.has_depth for c in readable)
    frames = "frames" if len(readable) == total else "readable frames" if num_read == total else "frames read"
    yield Finding("note", "files", f"{num_masks} of {len(readable)} {frames} have masks, {num_depths} have depth")
    yield from _missing_masks(capture, contents)


def _missing_masks(capture: Capture, contents: Mapping[str, Content]) -> Iterator[Finding]:
    """Says what is taken as dynamic without masks, or which training frames need one."""
    if capture.assumption != "masks":
        lack = ": there are no masks, as this layout has none" if capture.unmasked == "dynamic" else ""
        yield Finding("note", "masks", f"everything is taken as {capture.assumption}{lack}")
        return
    trained = [name for name in capture.train if name in contents and contents[name].error is None]
    unmasked = [name for name in trained if contents[name].dynamic is None]
    if unmasked:
        some = f"{len(unmasked)} of {len(trained)} training frames, such as {unmasked[0]},"
        which = "the training frames" if len(unmasked) == len(trained) else some
        yield Finding("error", "masks", f"{which} have no masks: make them {MASKS_REMEDY}")
