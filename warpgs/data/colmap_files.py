"""Reading COLMAP models; a damaged file is refused before COLMAP reads it.

COLMAP trusts the numbers of entries that its binary files state: where one is wrong, it reads on behind the end of the
file until memory is exhausted. So the sizes of all entries are added up first. The format (COLMAP's
``scene/reconstruction_io_binary.cc``), little-endian; every file begins with the number of its entries as uint64:

    cameras   uint32 id, int32 model, uint64 width, uint64 height, float64 for every parameter of the model
    images    uint32 id, 7 float64 pose, uint32 camera, name, zero byte, uint64 n, n × (2 float64, uint64)
    points3D  uint64 id, 3 float64 position, 3 uint8 color, float64 error, uint64 n, n × (2 uint32)
    rigs      uint32 id, uint32 n, if n > 0: int32, uint32, and n - 1 × (int32, uint32, uint8 p, if p > 0: 7 float64)
    frames    uint32 id, uint32 rig, 7 float64 pose, uint32 n, n × (int32, uint32, uint64)
"""

from __future__ import annotations

import reprlib
import shutil
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from warpgs.files import MAX_NUMBER, read_bounded, require_file

from .colmap_text import lacks_features, names_with_spaces, rewrite_text_model
from .images import MAX_SIDE

if TYPE_CHECKING:
    import pycolmap

MAX_BYTES = 1 << 30
"""Maximum size of each file of a model [bytes]; 1000 images with 10,000 features each have a quarter of that."""

NUM_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
"""Number of parameters of each camera model, by its index in COLMAP's ``CameraModelId``."""

MISFIT = "one refers to a camera, image or point that another lacks; copy all files of one model again"

MAX_NAME = 1024
"""Maximum length of the name of an image, with its folders."""

REQUIRED, OPTIONAL = ("cameras", "images", "points3D"), ("rigs", "frames")


def read_model(folder: Path, note: Callable[[str], None] = lambda text: None) -> pycolmap.Reconstruction:
    """A COLMAP model in binary or text files; its numbers are finite, and its image names stay within a folder.

    Args:
        folder: Folder of the files.
        note: Receives what had to be skipped or interpreted, one sentence each.

    Raises:
        ValueError: If a file is missing, too large or damaged, or refers to what is not there; the message names it.
    """
    suffix = _suffix(folder)
    present = [name for name in (*REQUIRED, *OPTIONAL) if (folder / f"{name}{suffix}").exists()]
    for name in present:
        path = folder / f"{name}{suffix}"
        require_file(path, MAX_BYTES)
        if suffix == ".bin":
            _check_entries(path)
    lonely = [name for name in OPTIONAL if name in present] if not set(OPTIONAL) <= set(present) else []
    for name in lonely:
        (other,) = (other for other in OPTIONAL if other != name)
        note(f"{folder} has {name}{suffix} but not {other}{suffix}: poses are read from images{suffix}")
    model = _opened(folder, suffix, [name for name in present if name not in lonely], note)
    for number, full in (names_with_spaces(folder) if suffix == ".txt" else {}).items():
        if number in model.images:
            model.images[number].name = full
    try:
        _check_values(model)
    except (ValueError, RuntimeError, IndexError) as error:
        reason = error if isinstance(error, ValueError) else MISFIT
        raise ValueError(f"{folder} is not a COLMAP model of files that fit together: {reason}") from error
    return model


def _suffix(folder: Path) -> str:
    """The suffix of the files of a model; binary files are preferred."""
    missing = {s: [n + s for n in REQUIRED if not (folder / (n + s)).exists()] for s in (".bin", ".txt")}
    suffix = min(missing, key=lambda s: len(missing[s]))
    if len(missing[suffix]) == len(REQUIRED):
        raise ValueError(f"{folder} is not a COLMAP model: expected cameras, images and points3D as .bin or .txt")
    if missing[suffix]:
        raise ValueError(
            f"{folder} is not a COLMAP model: {' and '.join(missing[suffix])} must lie with its other files; "
            "copy all files of the model from where COLMAP wrote them"
        )
    return suffix


def _lend(file: Path, path: Path) -> None:
    """A link to a file; a copy where links need rights that users do not have, as on Windows."""
    try:
        path.symlink_to(file)
    except OSError:
        shutil.copyfile(file, path)


def _opened(folder: Path, suffix: str, names: list[str], note: Callable[[str], None]) -> pycolmap.Reconstruction:
    """The model of some files of a folder."""
    import pycolmap  # takes 0.2 s

    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary)
        for name in names:  # COLMAP would read others that it finds in the folder
            _lend((folder / (name + suffix)).resolve(), copy / (name + suffix))
        try:
            if suffix == ".bin" or not lacks_features(folder):
                return pycolmap.Reconstruction(str(copy))
        except (ValueError, RuntimeError, IndexError) as error:  # with expressions of COLMAP's source
            if suffix == ".bin":
                raise ValueError(f"{folder} is not a COLMAP model of files that fit together: {MISFIT}") from error
        rewritten = copy / "rewritten"
        rewritten.mkdir()
        rewrite_text_model(folder, rewritten, note)
        try:
            return pycolmap.Reconstruction(str(rewritten))
        except (ValueError, RuntimeError, IndexError) as error:
            raise ValueError(f"{folder} is not a COLMAP model of files that fit together: {MISFIT}") from error


def _check_entries(path: Path) -> None:
    """Checks that a binary file ends where its last entry does."""
    data, end_of_entry = read_bounded(path, MAX_BYTES), _ENTRIES[path.stem]
    count, end = 0, 8
    try:
        (count,) = struct.unpack_from("<Q", data)
        for _ in range(count):  # every entry reads from the data, so this ends with them at the latest
            end = end_of_entry(data, end)
    except (struct.error, IndexError, OverflowError) as error:
        raise ValueError(
            f"{path} is damaged: {len(data):,} bytes do not hold the {count:,} entries it claims"
        ) from error
    if end != len(data):
        raise ValueError(f"{path} is damaged: expected {end:,} bytes for its {count:,} entries, got {len(data):,}")


def _end_of_camera(data: bytes, start: int) -> int:
    (model,) = struct.unpack_from("<4xi16x", data, start)
    return start + 24 + 8 * NUM_PARAMETERS[model if model >= 0 else len(NUM_PARAMETERS)]


def _end_of_image(data: bytes, start: int) -> int:
    name_end = data.find(b"\0", start + 64)
    if name_end < 0:
        raise IndexError(start)
    (count,) = struct.unpack_from("<Q", data, name_end + 1)
    return name_end + 9 + 24 * count


def _end_of_point(data: bytes, start: int) -> int:
    (count,) = struct.unpack_from("<43xQ", data, start)
    return start + 51 + 8 * count


def _end_of_rig(data: bytes, start: int) -> int:
    (count,) = struct.unpack_from("<4xI", data, start)
    end = start + (16 if count else 8)
    for _ in range(count - 1):
        (has_pose,) = struct.unpack_from("<8xB", data, end)
        end += 65 if has_pose else 9
    return end


def _end_of_frame(data: bytes, start: int) -> int:
    (count,) = struct.unpack_from("<64xI", data, start)
    return start + 68 + 16 * count


_ENTRIES = {
    "cameras": _end_of_camera,
    "images": _end_of_image,
    "points3D": _end_of_point,
    "rigs": _end_of_rig,
    "frames": _end_of_frame,
}


def _check_values(model: pycolmap.Reconstruction) -> None:
    for number, camera in model.cameras.items():
        sizes = np.array([camera.width, camera.height, *camera.params], dtype=np.float64)
        if not (np.abs(sizes) <= MAX_NUMBER).all() or not 0 < min(sizes[:2]) <= max(sizes[:2]) <= MAX_SIDE:
            raise ValueError(
                f"camera {number} is out of range: {camera.width}×{camera.height}, {camera.params.tolist()}"
            )
    for number, image in model.images.items():
        if image.has_pose and not (np.abs(image.cam_from_world().matrix()) <= MAX_NUMBER).all():
            raise ValueError(f"the pose of image {number} is not finite")
        name = PurePosixPath(_name(image, number).replace("\\", "/"))
        if name.is_absolute() or ".." in name.parts or not name.parts or "\0" in image.name:
            raise ValueError(f"the name of image {number} leads out of the folder: {reprlib.repr(image.name)}")
        if len(image.name) > MAX_NAME:
            raise ValueError(f"the name of image {number} has {len(image.name):,} characters")


def _name(image: pycolmap.Image, number: int) -> str:
    try:
        return image.name
    except UnicodeDecodeError as error:
        raise ValueError(f"the name of image {number} is not in UTF-8: {error.object!r:.60}") from error
