"""The cameras of views as tensors on the device, from which CUDA graphs read the one that is selected there."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from warpgs.cameras import Camera
from warpgs.distortion import Distortion


class StackedCameras:
    """Cameras whose lenses may differ.

    Attributes:
        lenses: The lens of each camera; None for a pinhole. They have one limit if no image shows anything beyond it:
            COLMAP may find a lens for every image.
        shown: ``Camera.shown`` of each camera, on the device; cameras of one lens have one mask.
    """

    lenses: list[Distortion | None]
    shown: list[Bool[Tensor, "H W"] | None]

    def __init__(self, cameras: Sequence[Camera], device: torch.device) -> None:
        self._viewmats = torch.stack([camera.viewmat for camera in cameras]).to(device)
        self._Ks = torch.stack([camera.K for camera in cameras]).to(device)
        self.lenses = _with_one_limit(cameras)
        self.shown = _shown(cameras, device)
        none, still = torch.zeros(0, dtype=torch.float32), torch.zeros(2, 3, dtype=torch.float32)
        coefficients = [none if lens is None else lens.coefficients for lens in self.lenses]
        self._coefficients = pad_sequence(coefficients, batch_first=True).to(device)
        motions = [still if camera.motion is None else camera.motion for camera in cameras]
        have_motion = any(camera.motion is not None for camera in cameras)
        self._motions = torch.stack(motions).to(device) if have_motion else None
        self._readouts = [(camera.duration, camera.by_columns) for camera in cameras]

    @property
    def have_one_lens(self) -> bool:
        """Whether all lenses are of one kind and limit, show the same pixels and are read in one way.

        These are constants of a CUDA graph.
        """
        kinds = {None if lens is None else (lens.lens, lens.limit) for lens in self.lenses}
        return len(kinds) == len({id(mask) for mask in self.shown}) == len({*self._readouts}) == 1

    def at(self, index: Int64[Tensor, "1"], number: int, size: tuple[int, int]) -> Camera:
        """The camera of an index on the device, at time 0.

        Args:
            index: The index.
            number: The index on the host, of a camera of the same lens: only its coefficients come from the device.
            size: (width, height) of its image [px].
        """
        lens, of_cameras = self.lenses[number], (self._viewmats, self._Ks, self._coefficients)
        viewmat, K, k = (values.index_select(0, index)[0] for values in of_cameras)
        distortion = None if lens is None else replace(lens, coefficients=k[: len(lens.coefficients)])
        motion = None if self._motions is None else self._motions.index_select(0, index)[0]
        duration, by_columns = self._readouts[number]
        shutter: dict[str, Any] = {"motion": motion, "duration": duration, "by_columns": by_columns}
        return Camera(viewmat, K, *size, distortion=distortion, **shutter)


class LensRays:
    """``Camera.rays`` of the pixels of cameras with distorted lenses: finding them takes longer than a training step.

    Args:
        cameras: Of one size.
        device: Device of the rays.
    """

    def __init__(self, cameras: Sequence[Camera], device: torch.device) -> None:
        lenses = {_lens(camera): camera.to(device) for camera in cameras}
        numbers = {lens: number for number, lens in enumerate(lenses)}
        self._rays = torch.stack([camera.rays(camera.pixel_centers) for camera in lenses.values()])
        self._of_cameras = torch.tensor([numbers[_lens(camera)] for camera in cameras], device=device)

    @staticmethod
    def nbytes(cameras: Sequence[Camera]) -> int:
        """Memory that they take on the device [bytes]."""
        return 3 * 4 * cameras[0].width * cameras[0].height * len({_lens(camera) for camera in cameras})

    def at(self, index: Int64[Tensor, "1"]) -> Float[Tensor, "P 3"]:
        """[H W, 3] those of the camera of an index on the device."""
        return self._rays.index_select(0, self._of_cameras.index_select(0, index))[0]


def _lens(camera: Camera) -> tuple[object, ...]:
    """What ``Camera.rays`` depends on."""
    kind = None if camera.distortion is None else (camera.distortion.lens, camera.distortion.limit)
    return kind, *camera.K.flatten().tolist(), *_intrinsics(camera)


def _shown(cameras: Sequence[Camera], device: torch.device) -> list[Bool[Tensor, "H W"] | None]:
    masks: dict[tuple[object, ...], Tensor | None] = {}
    for camera in cameras:
        if (key := _intrinsics(camera)) not in masks:
            mask = camera.shown
            masks[key] = None if mask is None else mask.to(device)
    return [masks[_intrinsics(camera)] for camera in cameras]


def _intrinsics(camera: Camera) -> tuple[object, ...]:
    """What ``Camera.shown`` depends on."""
    if (lens := camera.distortion) is None:
        return ()
    return lens.circle, *camera.size, *camera.K.flatten().tolist(), *lens.coefficients.tolist()


def _with_one_limit(cameras: Sequence[Camera]) -> list[Distortion | None]:
    """The lenses of cameras, if of one kind with the smallest limit unless that is inside one of the images."""
    lenses = [camera.distortion for camera in cameras]
    known = [lens for lens in lenses if lens is not None]
    limits = {lens.limit for lens in known}
    is_mixed = len({lens.lens for lens in known}) > 1
    if len(limits) < 2 or is_mixed or any(_reach(camera) > min(limits) for camera in cameras):
        return lenses
    return [None if lens is None else replace(lens, limit=min(limits)) for lens in lenses]


def _reach(camera: Camera) -> float:
    """How far from the axis the corners of an image are, as a ``Distortion.limit``; 0 for a pinhole."""
    if camera.distortion is None:
        return 0.0
    x, y = (torch.tensor([0.0, side], dtype=torch.float32) for side in camera.size)
    rays = camera.to("cpu").rays(torch.cartesian_prod(x, y))
    slopes = rays[:, :2].norm(dim=1)
    reach = slopes / rays[:, 2] if camera.distortion.lens == "radial" else torch.atan2(slopes, rays[:, 2])
    return float(reach.nan_to_num(camera.distortion.circle).max())
