"""Which frames are of one camera, where the files of a capture do not say it."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

from .capture import Capture


def with_camera_ids(capture: Capture) -> Capture:
    """The capture with frames of one camera and one time told apart: they must be of several cameras.

    If they have poses that recur, each pose is a still camera. Else, if only frames of ``train`` and ``val`` have times
    in common, those of ``val`` are of another camera. Else a note says that the cameras are not known.

    Raises:
        ValueError: If the files have ids of several cameras, and one of them for several; the message names two frames.
    """
    shared = [frames for frames in capture.by_camera(capture.cameras).values() if share_times(capture, frames)]
    is_static = len({camera.time for camera in capture.cameras.values()}) == 1
    if not shared or is_static:
        return capture
    next_id, ids, notes = max(camera.id for camera in capture.cameras.values()) + 1, dict[str, int](), list[str]()
    for frames in shared:
        parts = _still(capture, frames) or _by_split(capture, frames)
        if not parts:
            notes.append(_unknown(capture, frames))
        elif len(parts) > 2:
            notes.append(f"{len(parts)} still cameras are told apart by their poses, as no file names them")
        for part in parts[1:]:
            ids |= dict.fromkeys(part, next_id)
            next_id += 1
    told = capture.with_cameras({name: replace(capture.cameras[name], id=i) for name, i in ids.items()})
    told.notes = (*capture.notes, *notes)
    return told


def share_times(capture: Capture, names: Iterable[str]) -> bool:
    """Whether two of some frames have one time."""
    times = [capture.cameras[name].time for name in names]
    return len({*times}) < len(times)


def _still(capture: Capture, names: Sequence[str]) -> list[list[str]]:
    """The frames of each pose, ordered by their first frame; none if poses do not recur, or recur at one time."""
    groups = defaultdict(list)
    for name in sorted(names):
        camera = capture.cameras[name]
        groups[camera.viewmat.numpy().tobytes(), camera.K.numpy().tobytes(), camera.size].append(name)
    parts = [*groups.values()]
    return parts if all(len(part) > 1 and not share_times(capture, part) for part in parts) else []


def _by_split(capture: Capture, names: Sequence[str]) -> list[list[str]]:
    """Frames to train on and others; none if frames of one of them have one time."""
    train = {*capture.train}
    parts = [[name for name in names if (name in train) == is_train] for is_train in (True, False)]
    return parts if all(part and not share_times(capture, part) for part in parts) else []


def _unknown(capture: Capture, names: Sequence[str]) -> str:
    times = {name: capture.cameras[name].time for name in names}
    first, second = next((a, b) for a, b in pairwise(sorted(names, key=times.__getitem__)) if times[a] == times[b])
    if len({camera.id for camera in capture.cameras.values()}) > 1:
        same = f"frames {first} and {second} are of camera {capture.cameras[first].id} at one time"
        raise ValueError(f"{capture.name}: {same}: give each camera an id of its own")
    return (
        f"frames such as {first} and {second} have one time, but neither names nor poses tell their cameras: no frame "
        "is compared with the next one"
    )
