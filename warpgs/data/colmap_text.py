"""Text files of COLMAP models as other programs write them, rewritten so that COLMAP reads them.

Cameras, poses, points and colours are kept. Written otherwise are colours with decimals (``128.0``), images without the
second line for their features, and tracks of points where the images have no features.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

from warpgs.files import read_bounded

from .lens import unsupported_model

MAX_BYTES = 1 << 30
"""Maximum size of each file [bytes]."""

CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
POINT = "POINT3D_ID X Y Z R G B ERROR TRACK"


class _Line(NamedTuple):
    path: Path
    number: int
    text: str

    @property
    def words(self) -> list[str]:
        return self.text.split()

    def refuse(self, problem: str) -> NoReturn:
        raise ValueError(f"{self.path}, line {self.number}: {problem}")

    def require(self, fields: str, kinds: Sequence[Callable[[str], object]]) -> None:
        """Refuses the line if it does not begin with values of some kinds; ``fields`` names them in the message."""
        try:
            values = [kind(word) for kind, word in zip(kinds, self.words[: len(kinds)], strict=True)]
        except (ValueError, OverflowError):
            self.refuse(f"expected {fields}, got {self.text.strip()[:60]!r}")
        if not all(math.isfinite(value) for value in values if isinstance(value, float)):
            self.refuse(f"expected finite numbers, got {self.text.strip()[:60]!r}")


def rewrite_text_model(folder: Path, target: Path, note: Callable[[str], None]) -> None:
    """Writes cameras.txt, images.txt and points3D.txt of a folder into another one, as COLMAP reads them.

    Args:
        folder: Folder of the model.
        target: An existing folder.
        note: Receives what was interpreted, one sentence each.

    Raises:
        ValueError: If a line is not as the format demands; the message names it.
    """
    cameras = _cameras(folder / "cameras.txt")
    images, num_features = _images(folder / "images.txt", set(cameras), note)
    points = _points(folder / "points3D.txt", num_features, note)
    for name, lines in (("cameras", [*cameras.values()]), ("images", images), ("points3D", points)):
        (target / f"{name}.txt").write_text("".join(f"{line}\n" for line in lines), errors="surrogateescape")


def lacks_features(folder: Path) -> bool:
    """Whether images.txt has one line per image: COLMAP would take every second one for features."""
    return all(_is_image(line) for line in itertools.islice(_lines(folder / "images.txt"), 2))


def names_with_spaces(folder: Path) -> dict[int, str]:
    """The names in images.txt that have spaces, by ids of images; COLMAP writes them, but reads the first word."""
    found = {}
    for line, _ in _pairs(_lines(folder / "images.txt")):
        fields = line.text.strip().split(None, 9)
        if len(fields) == 10 and " " in fields[9] and fields[0].isdecimal():
            found[int(fields[0])] = fields[9]
    return found


def _lines(path: Path) -> Iterator[_Line]:
    """The lines of a file that are not comments."""
    text = read_bounded(path, MAX_BYTES).decode(errors="surrogateescape")
    for number, line in enumerate(text.split("\n"), 1):
        if not line.lstrip().startswith("#"):
            yield _Line(path, number, line.rstrip("\r"))


def _cameras(path: Path) -> dict[int, str]:
    """The lines of cameras by their ids."""
    import pycolmap  # takes 0.2 s

    found = {}
    for line in _lines(path):
        if not line.words:
            continue
        line.require(CAMERA, (int, str, int, int, float))
        number, model, width, height, *params = line.words
        kind = pycolmap.CameraModelId.__members__.get(model, pycolmap.CameraModelId.INVALID)
        if kind == pycolmap.CameraModelId.INVALID:
            line.refuse(unsupported_model(model, "COLMAP has no such model"))
        line.require(CAMERA, (int, str, int, int, *[float] * len(params)))
        expected = len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 2, 2).params)
        if len(params) != expected:
            line.refuse(f"{model} has {expected} parameters, got {len(params)}")
        found[int(number)] = f"{int(number)} {model} {width} {height} {' '.join(params)}"
    return found


def _images(path: Path, cameras: set[int], note: Callable[[str], None]) -> tuple[list[str], dict[int, int]]:
    """The two lines of every image, and the numbers of their features by image."""
    lines = list(_lines(path))
    while lines and not lines[-1].words:
        lines.pop()
    pairs: list[tuple[_Line, _Line | None]]
    if len(lines) > 1 and all(_is_image(line) for line in lines):
        note(f"{path} has one line per image, without the second one for features")
        pairs = [(line, None) for line in lines]
    else:
        pairs = list(_pairs(lines))
    written: list[str] = []
    num_features = {}
    for line, features in pairs:
        line.require(IMAGE, (int, *[float] * 7, int, str))
        number, camera = int(line.words[0]), int(line.words[8])
        if camera not in cameras:
            line.refuse(f"cameras.txt has no camera {camera}")
        if features is not None:
            features.require("X Y POINT3D_ID for every feature", [float] * (3 * -(-len(features.words) // 3)))
        words = features.words if features is not None else []
        written += [line.text.strip(), " ".join(words)]
        num_features[number] = len(words) // 3
    return written, num_features


def _pairs(lines: Iterable[_Line]) -> Iterator[tuple[_Line, _Line | None]]:
    """The two lines of every image, for itself and for its features, as COLMAP reads them."""
    remaining = iter(lines)
    for line in remaining:
        if line.words:
            yield line, next(remaining, None)


def _is_image(line: _Line) -> bool:
    """Whether a line describes an image, not features: its last word is a name."""
    if len(line.words) < 10:
        return False
    try:
        float(line.words[-1])
    except ValueError:
        return True
    return False


def _points(path: Path, num_features: dict[int, int], note: Callable[[str], None]) -> list[str]:
    """The lines of points; without tracks if no image has features."""
    has_features, with_tracks, with_decimals, written = any(num_features.values()), 0, 0, []
    for line in _lines(path):
        if not line.words:
            continue
        line.require(POINT, (int, *[float] * 6))
        words, track = line.words[:8], line.words[8:]
        colors = [float(word) for word in words[4:7]]
        if not all(value.is_integer() and 0 <= value <= 255 for value in colors):
            line.refuse(f"colours must be whole numbers from 0 to 255, got {' '.join(words[4:7])}")
        with_decimals += any(not word.isdecimal() for word in words[4:7])
        with_tracks += bool(track)
        if has_features:
            _check_track(line, track, num_features)
        written.append(
            " ".join([*words[:4], *(str(int(value)) for value in colors), *words[7:], *track * has_features])
        )
    if with_decimals:
        note(f"{path} has colours with decimals, read as whole numbers")
    if with_tracks and not has_features:
        note(f"{path} has tracks of features that images.txt does not have; they are not needed")
    return written


def _check_track(line: _Line, track: list[str], num_features: dict[int, int]) -> None:
    if len(track) % 2 or not all(word.isdecimal() for word in track):
        line.refuse("a track must be pairs of IMAGE_ID POINT2D_IDX")
    for image, feature in zip(map(int, track[::2]), map(int, track[1::2]), strict=True):
        if feature >= num_features.get(image, 0):
            has = f"has {num_features[image]} features" if image in num_features else "is missing"
            line.refuse(f"the track refers to feature {feature} of image {image}, which {has} in images.txt")
