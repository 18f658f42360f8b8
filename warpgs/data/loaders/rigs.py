"""Which names of images belong to cameras that film at the same time, and not to clips that follow each other."""

import re
from collections import defaultdict
from collections.abc import Sequence

CAMERA = r"cam|camera|view|viewpoint|kinect|gopro|sensor"
CAMERA_WORD = re.compile(rf"(?i)(({CAMERA})[a-z]?|left|right|front|back|rear|top|bottom|[lr])")
"""A word for one camera of a rig."""

BEFORE_NUMBER = re.compile(rf"(?i)(?<![a-z])({CAMERA})[^a-z0-9/]*$")
"""The end of the text before the number of a camera."""

CLIP = re.compile(r"(?i)(?<![a-z])(clip|part|take|seq|shot|scene|chapter|vid|session|run|day|burst|trial)")
"""Words for clips, whose frames have no times in common, whatever their numbers."""

MIN_COMMON = 0.8
"""Fraction of all numbers that cameras of a rig have in common."""


def follows_camera(text: str) -> bool:
    """Whether the number after a text counts cameras."""
    return BEFORE_NUMBER.search(text) is not None


def share_times(numbers: Sequence[int], rests: Sequence[str]) -> bool:
    """Whether frames with the same number were taken at the same time, by cameras of one rig.

    They were if the names differ in words for cameras or numbers after such words; and if they differ in folders or
    words, none of them a word for clips, and nearly all numbers are the same in all of them, which are not more than
    the numbers: folders of times hold the images of few cameras.

    Args:
        numbers: Of each frame.
        rests: The name of each frame without its number.
    """
    labels = sorted({*rests})
    if len(labels) < 2:
        return False
    tokens = [re.findall(r"[A-Za-z]+|[0-9]+|.", label) for label in labels]
    if len({*map(len, tokens)}) == 1:
        columns = [k for k, column in enumerate(zip(*tokens, strict=True)) if len({*column}) > 1]
        if all(_is_camera(token, k) for k in columns for token in tokens):
            return True
    if len({tuple(re.findall("[0-9]+", label.rpartition("/")[2])) for label in labels}) > 1:
        return False
    return not any(CLIP.search(label) for label in labels) and _are_common(numbers, rests)


def _is_camera(tokens: Sequence[str], k: int) -> bool:
    if tokens[k].isdecimal():
        return follows_camera("".join(tokens[:k]))
    return CAMERA_WORD.fullmatch(tokens[k]) is not None


def _are_common(numbers: Sequence[int], rests: Sequence[str]) -> bool:
    found = defaultdict(set)
    for number, rest in zip(numbers, rests, strict=True):
        found[rest].add(number)
    common, count = set.intersection(*found.values()), len({*numbers})
    return len(common) > 1 and len(common) >= MIN_COMMON * count and len(found) <= count
