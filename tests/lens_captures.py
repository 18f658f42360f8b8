"""The built-in room, recorded through a lens: a capture in memory, and the same with its frames undistorted."""

import dataclasses
import math
from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
import torch

from tests.scenes import along_z
from warpgs.cameras import Camera
from warpgs.data.capture import Capture, Frame
from warpgs.data.units import SceneUnits
from warpgs.distortion import Distortion
from warpgs.synthetic import room
from warpgs.synthetic.bodies import as_tensors, even_samples
from warpgs.synthetic.raytrace import raytrace

SIZE, NUM_FRAMES, NUM_POINTS = (44, 32), 8, 300
DETAIL = 3  # pixels of a wide pinhole image per pixel of a frame


def _radial(focal: float) -> Camera:
    camera = along_z(focal, SIZE)
    K = camera.K.clone()
    K[0, 2] += 3.0
    return dataclasses.replace(camera, K=K, distortion=Distortion.radial([-0.2, 0.03, 0.005, -0.003], K, SIZE))


def _fisheye(degrees: float) -> Camera:
    """A lens that sees an angle from corner to corner, equidistant but for a small coefficient."""
    half = math.radians(degrees / 2)
    camera = along_z(math.hypot(*SIZE) / 2 / (half + 0.01 * half**3), SIZE)
    return dataclasses.replace(camera, distortion=Distortion.fisheye([0.01], camera.K, SIZE))


CAMERAS = {"radial": _radial(34.0), "fisheye": _fisheye(150.0)}


def recorded(lens: str, is_metric: bool = False) -> Capture:
    """The room through a lens, every fourth frame for evaluation; with depth of another scale in every frame."""
    names = [f"{k:03d}" for k in range(NUM_FRAMES)]
    frames = {name: _frame(name, CAMERAS[lens], k / (NUM_FRAMES - 1), is_metric) for k, name in enumerate(names)}
    val = names[2::4]
    return _capture(frames, [name for name in names if name not in val], val)


def changed(capture: Capture, change: Callable[[Frame], Frame]) -> Capture:
    """A capture with other frames, and their cameras."""
    frames = {name: change(capture.frame(name)) for name in (*capture.train, *capture.val)}
    return dataclasses.replace(capture, cameras={n: f.camera for n, f in frames.items()}, read=frames.__getitem__)


def undistorted(frame: Frame) -> Frame:
    """The frame as a pinhole camera of the same focal length sees it; nothing is known of what the lens does not."""
    camera = frame.camera.pinhole
    positions, _, _ = frame.camera.place(camera.rays(camera.pixel_centers))
    maps = (positions - 0.5).reshape(*camera.size[::-1], 2).numpy()

    def moved(values: torch.Tensor, interpolation: int) -> torch.Tensor:
        source = values.numpy().astype(np.uint8) if values.dtype == torch.bool else values.numpy()
        return torch.from_numpy(cv2.remap(source, maps, None, interpolation)).to(values.dtype)

    assert frame.static_mask is not None
    return Frame(
        frame.name,
        camera,
        moved(frame.image, cv2.INTER_LINEAR),
        moved(frame.static_mask, cv2.INTER_NEAREST),
        None if frame.inverse_depth is None else moved(frame.inverse_depth, cv2.INTER_NEAREST),
    )


def _capture(frames: dict[str, Frame], train: list[str], val: list[str]) -> Capture:
    points = torch.cat([_points(frames[name]) for name in train])
    return Capture("room", {n: f.camera for n, f in frames.items()}, train, val, points, None, frames.__getitem__)


def _points(frame: Frame) -> torch.Tensor:
    """Random static points that the frame shows."""
    assert frame.static_mask is not None
    row, column = frame.static_mask.nonzero(as_tuple=True)
    chosen = torch.randperm(len(row), generator=torch.Generator().manual_seed(0))[: NUM_POINTS // NUM_FRAMES]
    row, column = row[chosen], column[chosen]
    _, depth, _ = _traced(frame.camera, frame.camera.time)
    return frame.camera.unproject(row, column, depth[row, column])


def _frame(name: str, lens: Camera, time: float, is_metric: bool) -> Frame:
    world = room._camera(time, room.BuiltinScene(*SIZE), 0.0)
    rotation, units = world.viewmat[:3, :3], SceneUnits(np.array(room.CENTER), room.SCALE)
    center = units.from_world(world.position.double().numpy()[None])[0]
    posed = Camera.posed(rotation.double().numpy(), center, lens.K.double().numpy(), SIZE, time)
    camera = dataclasses.replace(posed, distortion=lens.distortion)
    image, depth, static = _traced(camera, time)
    return Frame(name, camera, image, static, 1.0 / depth if is_metric else (0.8 + 0.4 * time) / depth + 0.1)


@lru_cache(maxsize=64)
def _traced_wide(time: float, reach: float, focal: float) -> tuple:
    """The room in world units through a pinhole that sees up to a slope."""
    side = 2 * int(np.ceil(reach * focal * DETAIL))
    world = room._camera(time, room.BuiltinScene(*SIZE), 0.0)
    wide = along_z(focal * DETAIL, (side, side))
    bodies = as_tensors([*room._static_bodies(), *room._moving_bodies(time)], torch.device("cpu"))
    samples = even_samples(2, torch.device("cpu"))
    return wide, raytrace(bodies, room._lamp(torch.device("cpu")), samples, world.viewmat, wide.K, wide.size)


def _traced(camera: Camera, time: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Image, depth in scene units and static mask of a camera at its place in the room."""
    fine = camera.resized(DETAIL * camera.width, DETAIL * camera.height)
    rays = fine.rays(fine.pixel_centers)
    steepest = (rays[:, :2] / rays[:, 2:]).norm(dim=1).max()
    wide, traced = _traced_wide(time, 1.02 * float(steepest), float(camera.K[0, 0]))
    maps = (wide.place(rays)[0] - 0.5).reshape(*fine.size[::-1], 2).numpy()
    shown = cv2.remap((traced.image.clamp(0, 1) * 255).numpy(), maps, None, cv2.INTER_LINEAR)
    image = cv2.resize(shown, camera.size, interpolation=cv2.INTER_AREA).round().astype(np.uint8)
    middle = slice(DETAIL // 2, None, DETAIL)
    z, bodies = (
        torch.from_numpy(cv2.remap(values.float().numpy(), maps, None, cv2.INTER_NEAREST)[middle, middle])
        for values in (traced.depth, traced.bodies)
    )
    ray_z = camera.rays(camera.pixel_centers)[:, 2].reshape(z.shape)
    return torch.from_numpy(image), room.SCALE * z / ray_z, bodies < len(room._static_bodies())
