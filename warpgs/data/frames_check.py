"""Checks the numbers, times and files of the frames of a capture."""

from collections.abc import Iterator

from .capture import MASKS_REMEDY, Capture
from .findings import Finding
from .masks_check import check_masks, dynamic_counts


def check_counts(capture: Capture) -> Iterator[Finding]:
    """Notes of the loader, numbers of frames and their times."""
    yield from (Finding("note", "files", text) for text in capture.notes)
    sizes = sorted({camera.size for camera in capture.cameras.values()})
    shown = ", ".join(f"{w}×{h}" for w, h in sizes[:4])
    yield Finding("note", "counts", f"{len(capture.train)} frames to train on, {len(capture.val)} to evaluate, {shown}")
    times = sorted(capture.cameras[name].time for name in capture.train)
    distinct = len(set(times))
    yield Finding("warning" if capture.time_source.problem else "note", "time", str(capture.time_source))
    if distinct == 1 and len(times) > 1:
        text = "all training frames have one time: time_id in metadata.json, or what the layout has for it, is wrong"
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


def check_files(capture: Capture) -> Iterator[Finding]:
    """Reads every frame; counts masks and depth, and checks the masks of the training frames."""
    trained, unmasked, num_read, num_masks, num_depths = [], [], 0, 0, 0
    for name in (*capture.train, *capture.val):
        is_trained = name in capture.train
        try:
            frame = capture.frame(name)
        except ValueError as error:
            # The other checks read training frames only.
            yield Finding("error", "files" if is_trained else "evaluation", str(error))
            continue
        num_read += 1
        num_depths += frame.inverse_depth is not None
        has_mask = frame.static_mask is not None and capture.assumption == "masks"
        num_masks += has_mask
        if is_trained and has_mask:
            trained.append(dynamic_counts(frame))
        elif is_trained:
            unmasked.append(name)
    frames = "frames" if num_read == len(capture.train) + len(capture.val) else "readable frames"
    yield Finding("note", "files", f"{num_masks} of {num_read} {frames} have masks, {num_depths} have depth")
    if capture.assumption == "dynamic":
        yield Finding("note", "masks", "there are no masks, as this layout has none: everything is taken as dynamic")
        return
    if unmasked:
        some = f"{len(unmasked)} of {len(unmasked) + len(trained)} training frames, such as {unmasked[0]},"
        which = some if trained else "the training frames"
        yield Finding("error", "masks", f"{which} have no masks: make them {MASKS_REMEDY}")
    if trained:
        yield from check_masks(trained)
