"""Checks the numbers, times and files of the frames of a capture."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from warpgs.data.capture import MASKS_REMEDY, Capture
from warpgs.errors import counted

from .check_sample import Content
from .findings import Finding, few_of

MAX_ERRORS = 20
"""Maximum number of kinds of errors that are named."""

FILE = re.compile(r"(?i).*?\.(png|jpe?g|exr|npy)(?=[: ])")


def check_counts(capture: Capture) -> Iterator[Finding]:
    """Notes of the loader, numbers of frames and their times."""
    yield from (Finding("note", "files", text) for text in capture.notes)
    sizes = sorted({camera.size for camera in capture.cameras.values()})
    shown = ", ".join(f"{w}×{h}" for w, h in sizes[:4])
    yield Finding(
        "note", "counts", f"{counted(len(capture.train), 'frame')} to train on, {len(capture.val)} to evaluate, {shown}"
    )
    times = sorted(capture.cameras[name].time for name in capture.train)
    distinct = len(set(times))
    is_guessed = capture.time_source.problem and capture.assumption != "static"
    if not capture.is_builtin:
        yield Finding("warning" if is_guessed else "note", "time", str(capture.time_source))
    if distinct == 1 and len(times) > 1:
        text = f"all training frames have one time, but every moment needs its own ({capture.time_source.text})"
        if capture.assumption == "static":
            yield Finding("warning", "time", text)
        else:
            yield Finding("error", "time", f"{text}; train a scene without motion with --assume static")
    elif len(times) > 1 and times[-1] - times[0] < 0.5:
        yield Finding("warning", "time", "training frames cover less than half of the time range")
    late = [n for n in capture.val if not times[0] <= capture.cameras[n].time <= times[-1]]
    if late:
        number = "1 evaluation frame lies" if len(late) == 1 else f"{len(late)} evaluation frames lie"
        yield Finding("warning", "time", f"{number} before or after all training frames")
    if len(times) == 1 and capture.assumption != "static":
        yield Finding("warning", "counts", "1 training frame shows no motion: give frames of other moments")
    elif len(times) < 10:
        number = "1 training frame is" if len(times) == 1 else f"{len(times)} training frames are"
        yield Finding("warning", "counts", f"{number} very few")


def check_files(capture: Capture, contents: Mapping[str, Content]) -> Iterator[Finding]:
    """What the files of the frames that were read hold, and whether those to train on have the masks they need."""
    total, num_read = len(capture.train) + len(capture.val), len(contents)
    if num_read < total:
        text = f"{num_read} of {total} frames were read, evenly spread: the check has no time for all"
        yield Finding("note", "files", f"{text}, training reads them all")
    for topic, split in (("files", capture.train), ("evaluation", capture.val)):  # other checks read the former only
        read = [contents[name].error for name in split if name in contents]
        yield from (Finding("error", topic, text) for text in _errors([e for e in read if e is not None], len(read)))
    readable = [content for content in contents.values() if content.error is None]
    num_masks, num_depths = sum(c.dynamic is not None for c in readable), sum(c.has_depth for c in readable)
    frames = "frames" if len(readable) == total else "readable frames" if num_read == total else "frames read"
    yield Finding("note", "files", f"{num_masks} of {len(readable)} {frames} have masks, {num_depths} have depth")
    yield from _missing_masks(capture, contents)


def _errors(errors: Sequence[str], num_read: int) -> Iterator[str]:
    """Errors of frames, one line for each kind of error: that of the first file, and the names of the others.

    Args:
        errors: One error for each damaged frame.
        num_read: Number of frames that were read.
    """
    kinds: dict[str, list[str]] = {}
    for error in errors:
        kinds.setdefault(error.removeprefix(_file_in(error)), []).append(error)
    for first, *others in list(kinds.values())[:MAX_ERRORS]:
        names = [Path(_file_in(error)).name for error in others]
        of = f"{len(others)} more files: {few_of(names)}"
        same = f"all {num_read} frames" if len(others) + 1 == num_read else of
        yield f"{first} (the same of {same})" if others else first
    if len(kinds) > MAX_ERRORS:
        yield f"{sum(map(len, list(kinds.values())[MAX_ERRORS:]))} more frames cannot be read"


def _file_in(error: str) -> str:
    """The path that an error begins with; empty if there is none."""
    found = FILE.match(error)
    return "" if found is None else found[0]


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
