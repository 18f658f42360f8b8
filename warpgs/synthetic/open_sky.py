"""A sky behind ray-traced bodies: a gradient with clouds, infinitely far."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from warpgs.cameras import Camera

from .bodies import Body, as_tensors
from .raytrace import TracedImage, raytrace

LOW, HIGH, WHITE = np.array([0.80, 0.84, 0.88]), np.array([0.20, 0.40, 0.78]), np.array([0.97, 0.96, 0.94])
"""Colours of the sky, far down and far up, and of clouds."""

WAVES, OCTAVES, LOWEST, DECAY = 8, 5, 5.0, 1.35
"""Waves of each octave of the clouds, their number, the lowest frequency [rad per unit of length], and how much weaker
an octave is than the one below it."""


def sky_colors(directions: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 3"]:
    """Colours in [0, 1] in directions of the world of any length; z is up."""
    random, unit = np.random.default_rng(0), directions / np.linalg.norm(directions, axis=1, keepdims=True)
    density = np.zeros(len(unit))
    for octave in range(OCTAVES):
        waves = random.standard_normal((3, WAVES))
        waves *= LOWEST * 2.0**octave / np.linalg.norm(waves, axis=0)
        phases = random.uniform(0.0, 2.0 * np.pi, WAVES)
        density += np.sin(unit @ waves + phases).sum(1) / (np.sqrt(0.5 * WAVES) * DECAY**octave)
    cloud = np.clip(0.5 * density + 0.3, 0.0, 1.0)[:, None]
    height = np.clip(0.5 + unit[:, 2:], 0.0, 1.0)
    cover = cloud * cloud * (3.0 - 2.0 * cloud)
    return (1.0 - cover) * ((1.0 - height) * LOW + height * HIGH) + cover * WHITE


def trace_under_sky(bodies: Sequence[Body], lamp: Tensor, samples: Tensor, camera: Camera) -> TracedImage:
    """What a pinhole camera in world units sees of bodies in front of the sky, which they do not mirror.

    ``lamp`` and ``samples`` are as of ``raytrace``.
    """
    tensors, center = as_tensors(bodies, torch.device("cpu")), torch.full((2,), 0.5, dtype=torch.float32)
    sky = torch.from_numpy(sky_colors(camera.directions().double().numpy())).float()
    sky = sky.view(camera.height, camera.width, 3)
    total = torch.zeros_like(sky)
    for sample in samples:  # one by one: only the centres of pixels tell whether they show a body
        K, at_center = camera.K.clone(), torch.cat([center, sample[2:]])[None]
        K[:2, 2] += center - sample[:2]
        traced = raytrace(tensors, lamp, at_center, camera.viewmat, K, camera.size)
        total += torch.where((traced.bodies < 0)[..., None], sky, traced.image)
    traced = raytrace(tensors, lamp, samples[:1], camera.viewmat, camera.K, camera.size)
    return traced._replace(image=total / len(samples))
