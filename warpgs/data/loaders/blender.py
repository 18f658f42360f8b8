"""D-NeRF and other datasets rendered by Blender: transforms_train.json, transforms_val.json, transforms_test.json."""

from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path

import numpy as np

from warpgs.data.capture import Capture, Conventions
from warpgs.data.images import is_transparent
from warpgs.data.resized import read_metric_depth, read_resized_mask, read_resized_over_white
from warpgs.data.time_source import TimeSource, with_steps
from warpgs.data.units import SceneUnits

from .options import LoadOptions
from .posed import PosedFrame, World, plain_names, posed_capture
from .skipped import skipped_images
from .transforms import Transforms
from .turned import turning_notes

TRAIN, TEST, VAL = "transforms_train.json", "transforms_test.json", "transforms_val.json"

HALF_SIZE = 1.3
"""The scenes lie within this distance of the origin, along each axis [world units], as Deformable-3DGS assumes."""

MAX_REMEMBERED = 65_536
"""Maximum number of images of which it is remembered whether they are transparent."""


class BlenderLoader:
    """Loads the training frames, and for evaluation the test frames, or those of validation if there are none.

    Transparent pixels are white, and so is the background if a pixel of a training image is transparent. Everything is
    dynamic, except where nothing but the background is seen, unless frames have a mask_path.
    """

    def recognizes(self, root: Path) -> bool:
        """Whether there is a transforms_train.json."""
        return (root / TRAIN).is_file()

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_with``."""
        evaluated = next((root / name for name in (TEST, VAL) if (root / name).is_file()), None)
        indices = [Transforms(path) for path in (root / TRAIN, evaluated) if path is not None]
        train, *others = (_frames(index, index.path.stem.split("_")[1]) for index in indices)
        val = [frame for frames in others for frame in frames]
        frames = [*train, *val]
        masked = any(frame.static_mask is not None for frame in train)
        images = [[index.image(entry) for entry in index.frames] for index in indices]
        is_white = any(map(_is_transparent, images[0]))
        sizes = [(frame.lens.width, frame.lens.height) for frame in frames]
        listed = f"not listed in {' or '.join(index.path.name for index in indices)}"
        world = World(
            np.zeros((0, 3)),
            units=SceneUnits(np.zeros(3), 1.0 / HALF_SIZE),
            assumption="masks" if masked else "dynamic",
            time_source=_time_source(indices, frames),
            own_times=True,
            conventions=Conventions(depth="depth"),
            background="white" if is_white else "black",
            notes=[
                *chain(*(index.notes for index in indices)),
                *turning_notes([*chain(*images)], sizes),
                *skipped_images(root, chain(*images), listed, others=[*chain(*(index.found for index in indices))]),
            ],
        )
        return posed_capture(root, frames, {frame.name for frame in val}, world, options)


def _time_source(indices: Sequence[Transforms], frames: Sequence[PosedFrame]) -> TimeSource:
    """Where the times come from.

    Raises:
        ValueError: If only some of the files have times.
    """
    with_times = [index.times(index.frames, "time") is not None for index in indices]
    if len({*with_times}) > 1:
        without, given = (indices[with_times.index(has)].path for has in (False, True))
        raise ValueError(f"{without}: frames have no time, but those of {given.name} have: give every frame one")
    if not with_times[0]:
        return TimeSource(f"no frame has a time in {TRAIN}")
    return TimeSource(with_steps("times from the field time of the frames", [frame.time for frame in frames]))


def _is_transparent(image: Path) -> bool:
    status = image.stat()
    return _was_transparent(image, status.st_mtime_ns, status.st_size)


@lru_cache(MAX_REMEMBERED)
def _was_transparent(image: Path, modified: int, num_bytes: int) -> bool:
    """Whether an image is transparent, remembered until the file changes: opaque ones must be decoded completely."""
    return is_transparent(image)


def _frames(transforms: Transforms, split: str) -> list[PosedFrame]:
    """The frames of a file; their names begin with the split, because all splits have an r_000."""
    size: tuple[int, int] | None = None
    frames = []
    _, times = transforms.times(transforms.frames, "time") or ("", [0.0] * len(transforms.frames))
    images = [transforms.image(entry) for entry in transforms.frames]
    names = [image.stem for image in images]
    if len(set(names)) < len(names):
        names = plain_names([transforms.image_name(entry) for entry in transforms.frames])
    cameras = transforms.cameras(transforms.frames) or [0] * len(names)
    for entry, image, name, time, camera in zip(transforms.frames, images, names, times, cameras, strict=True):
        if size is None:  # the images of these datasets have one size
            first = transforms.lens(entry, image)
            size = first.width, first.height
        mask, depth = transforms.file(entry, "mask_path"), transforms.file(entry, "depth_file_path")
        if not 0.0 <= time <= 1.0:
            raise ValueError(f"{transforms.path}: time must be in [0, 1], got {time}")
        frames.append(
            PosedFrame(
                f"{split}_{name}",
                transforms.lens({"w": size[0], "h": size[1], **entry}, image),
                transforms.pose(entry),
                float(time),
                partial(read_resized_over_white, image),
                None if mask is None else partial(read_resized_mask, mask, image=image),
                None if depth is None else partial(read_metric_depth, depth, unit=1.0, image=image),
                camera,
            )
        )
    return frames
