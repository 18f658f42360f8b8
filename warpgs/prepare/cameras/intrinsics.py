"""Known intrinsics of a lens, from a file of COLMAP (text), OpenCV or ROS (YAML, XML, JSON).

COLMAP's cameras.txt has one line per camera: its id, model, width, height and parameters. OpenCV and ROS write
``camera_matrix`` and ``distortion_coefficients`` (k1, k2, p1, p2, k3), ``image_width`` and ``image_height``; a fisheye
lens (k1 to k4) has ``fisheye_model: 1`` in OpenCV's calibration tool, ``distortion_model: equidistant`` in ROS. OpenCV
measures pixels from the centre of the first one, half a pixel from the corner, where COLMAP and we begin.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from warpgs.data.colmap import lens_of_parameters
from warpgs.data.lens import DistortionModel, Lens
from warpgs.files import read_bounded, read_json, read_numbers
from warpgs.parsed import reason

MAX_BYTES = 1 << 20
"""Maximum size of a file [bytes]."""

MAX_NESTING = 100
"""Maximum depth of what a YAML file nests; OpenCV's parser uses up the stack at some thousands."""

MAX_DIFFERENCE = 0.01
"""Maximum difference of the aspect ratios of the file's images and the frames: sides are rounded."""

MATRIX, DISTORTION = "camera_matrix", "distortion_coefficients"

KEYS = (MATRIX, DISTORTION, "image_width", "image_height", "distortion_model", "fisheye_model")
"""Fields that are read; others are ignored."""


def read_intrinsics(path: Path, size: tuple[int, int] | None = None) -> Lens:
    """The lens that a file describes, in pixels of the source's frames.

    Args:
        path: cameras.txt of COLMAP, or JSON, YAML or XML of OpenCV.
        size: (width, height) of the source's frames; None if unknown. The lens is scaled to it if the file is of images
            of another size and the same aspect ratio.

    Raises:
        ValueError: If the file is missing or damaged, its camera model cannot be represented, its lens folds back
            inside the image, or it is of images of another aspect ratio.
    """
    suffix = path.suffix.lower()
    if suffix != ".txt" and suffix not in READERS:
        raise ValueError(f"{path}: intrinsics are read from files that end with {', '.join(('.txt', *READERS))}")
    lens = _of_colmap(path) if suffix == ".txt" else _of_opencv(path, READERS[suffix](path), size)
    try:
        _ = lens.distortion
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if size is None:
        return lens
    width, height = size
    if abs(lens.width * height / (lens.height * width) - 1.0) > MAX_DIFFERENCE:
        raise ValueError(
            f"{path} is of images of {lens.width}×{lens.height}, the source's frames are {width}×{height}: "
            "another aspect ratio, so it cannot be scaled to them"
        )
    return lens.resized(width, height)


def _of_colmap(path: Path) -> Lens:
    text = read_bounded(path, MAX_BYTES).decode("utf-8", "replace")
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if len(lines) != 1 or len(lines[0]) < 5:
        raise ValueError(f"{path} must have one line with a camera's id, model, width, height and parameters")
    _, model, width, height, *params = lines[0]
    try:
        return lens_of_parameters(model, (int(width), int(height)), [float(p) for p in params])
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {reason(error)}") from error


def _of_yaml(path: Path) -> dict[str, Any]:
    """The fields of a YAML file, by OpenCV."""
    text = _text(path)
    _check_nesting(path, text)
    if not text.startswith("%YAML"):
        text = "%YAML:1.0\n---\n" + text.removeprefix("---")  # ROS omits the first line
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = {key: storage.getNode(key) for key in KEYS}
        return {key: _plain(node) for key, node in nodes.items() if not node.empty()}
    except (cv2.error, SystemError) as error:
        raise ValueError(f"{path} is not a file of OpenCV: {str(error).splitlines()[0]}") from error


def _text(path: Path) -> str:
    return read_bounded(path, MAX_BYTES).decode("utf-8-sig", "replace")


def _check_nesting(path: Path, text: str) -> None:
    """Refuses what may be nested so deep that OpenCV's parser, which is recursive, would use up the stack.

    It nests with indentation, with brackets, and within a line at every colon, dash and question mark.
    """
    depth = brackets = 0
    for opened in re.findall(r"([\[{])|[\]}]", text):
        depth += 1 if opened else -1
        brackets = max(brackets, depth)
    steps = max((len(found) for found in re.findall(r"^(?: |- ?|\? )+", text, re.MULTILINE)), default=0) // 2
    within = max(len(re.findall(r"[:?]|-\s", part)) for part in re.split(r"[,\[\]{}\n]", text))
    if (1 + steps + brackets) * max(1, within) > MAX_NESTING:
        raise ValueError(f"{path} is nested deeper than {MAX_NESTING} levels")


def _plain(node: Any) -> Any:
    """A number, a string, or the numbers of a sequence or a matrix."""
    if node.isMap():
        node = node.getNode("data")
    if node.isSeq():
        return [_plain(node.at(k)) for k in range(node.size())]
    return node.string() if node.isString() else node.real()


def _of_xml(path: Path) -> dict[str, Any]:
    """The fields of an XML file: below its root, numbers, strings, and matrices with their numbers in ``data``."""
    text = _text(path)
    if "<!DOCTYPE" in text:  # whose entities may stand for gigabytes
        raise ValueError(f"{path} has a document type declaration, which files of OpenCV do not have")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not a file of OpenCV: {error}") from error
    fields = {}
    for element in root:
        data = element.find("data")
        if element.tag in KEYS and element.tag in fields:
            raise ValueError(f"{path} has {element.tag} twice")
        words = (element if data is None else data).text or ""
        fields[element.tag] = [_value(word) for word in words.split()]
    return {key: value[0] if len(value) == 1 else value for key, value in fields.items() if key in KEYS}


def _value(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word.strip('"')


def _of_json(path: Path) -> dict[str, Any]:
    return read_json(path, max_bytes=MAX_BYTES)


READERS = {".json": _of_json, ".yaml": _of_yaml, ".yml": _of_yaml, ".xml": _of_xml}
"""Readers of OpenCV's and ROS's fields by the suffix of the file."""


def _of_opencv(path: Path, fields: dict[str, Any], size: tuple[int, int] | None) -> Lens:
    matrix = _numbers(path, fields, MATRIX)
    if len(matrix) != 9:
        raise ValueError(f"{path}: {MATRIX} must hold 9 numbers, got {len(matrix)}")
    fx, skew, cx, _, fy, cy, *_ = matrix.tolist()
    if skew:
        raise ValueError(f"{path}: cameras must have no skew, got {skew}")
    is_fisheye = fields.get("distortion_model") in ("equidistant", "fisheye") or bool(fields.get("fisheye_model"))
    max_count, meaning = (4, "k1 to k4") if is_fisheye else (8, "k1, k2, p1, p2, k3 to k6")
    distortion = _numbers(path, {DISTORTION: [], **fields}, DISTORTION)
    if distortion[max_count:].any():
        raise ValueError(f"{path}: {DISTORTION} may have {meaning}, got {distortion.tolist()}")
    if "image_width" in fields or "image_height" in fields:
        size = round(_number(path, fields, "image_width")), round(_number(path, fields, "image_height"))
    width, height = size or (round(2.0 * cx) + 1, round(2.0 * cy) + 1)  # only to check the file: no frames yet
    coefficients = tuple(distortion.tolist())
    model: DistortionModel = "fisheye" if is_fisheye else "radial"
    try:
        return Lens(width, height, (fx, fy), (cx + 0.5, cy + 0.5), coefficients, model).checked()
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _number(path: Path, fields: dict[str, Any], key: str) -> float:
    return float(read_numbers(path, fields, key, ()))


def _numbers(path: Path, fields: dict[str, Any], key: str) -> Float[np.ndarray, " N"]:
    """The numbers of a matrix, as OpenCV or ROS writes it, or as nested lists."""
    if key not in fields:
        raise ValueError(f"{path} has no {key}")
    given = fields[key]["data"] if isinstance(fields[key], dict) and "data" in fields[key] else fields[key]
    flat = list(_flat(given))
    return read_numbers(path, {key: flat}, key, (len(flat),)) if flat else np.zeros(0)


def _flat(given: Any) -> Iterator[Any]:
    """The entries of lists in lists, three deep at most, which is what matrices need."""
    rows = given if isinstance(given, list) else [given]
    for row in rows:
        for entry in row if isinstance(row, list) else [row]:
            yield from entry if isinstance(entry, list) else [entry]
