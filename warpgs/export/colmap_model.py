"""Cameras as a COLMAP model."""

import tempfile
from pathlib import Path

import numpy as np

from warpgs.data.colmap import parameters_of_lens
from warpgs.data.lens import Lens
from warpgs.files import write_bytes

from .camera_set import CameraSet, held_lens


def write_colmap(folder: Path, cameras: CameraSet) -> None:
    """A COLMAP model with points in sparse/0; images are called <id>.png, and ids follow time."""
    import cv2  # noqa: F401  before pycolmap, which breaks OpenCV's PNG files otherwise
    import pycolmap  # takes 0.2 s

    model = pycolmap.Reconstruction()
    numbers: dict[Lens, int] = {}
    for k, (name, camera) in enumerate(cameras.cameras.items(), 1):
        lens = held_lens(name, camera, 8)
        if lens not in numbers:
            numbers[lens] = len(numbers) + 1
            kind, parameters = parameters_of_lens(lens)
            size = {"width": lens.width, "height": lens.height}
            given = pycolmap.Camera(camera_id=numbers[lens], model=kind, params=parameters, **size)
            model.add_camera_with_trivial_rig(given)
        image = pycolmap.Image(name=f"{name}.png", camera_id=numbers[lens], image_id=k)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.viewmat[:3].double().numpy()))
    colors = np.full((len(cameras.points), 3), 128, np.uint8) if cameras.colors is None else cameras.colors
    for point, color in zip(cameras.points, colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    with tempfile.TemporaryDirectory() as temporary:
        model.write_binary(temporary)  # names in its text files end at a space
        for path in sorted(Path(temporary).iterdir()):
            write_bytes(folder / "sparse" / "0" / path.name, [path.read_bytes()])
