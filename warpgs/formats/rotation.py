"""Clouds in rotated coordinates."""

import numpy as np
import torch
from jaxtyping import Float64

from warpgs.ops.sh import degree_of, num_bases, sh_fwd

from .cloud import Cloud

Y_DOWN_TO_Y_UP = np.diag([1.0, -1.0, -1.0])

NUM_DIRECTIONS = 64
"""Number of directions in which spherical harmonics are compared to rotate them; degree 3 needs 16."""


def rotated(cloud: Cloud, rotation: Float64[np.ndarray, "3 3"]) -> Cloud:
    """A cloud in rotated coordinates: means, quaternions and spherical harmonics."""
    if np.array_equal(rotation, np.eye(3)):
        return cloud
    sh = cloud.sh.astype(np.float64)
    for degree in range(1, degree_of(sh.shape[1]) + 1):
        band = slice(num_bases(degree - 1), num_bases(degree))
        sh[:, band] = np.einsum("kl,nlc->nkc", _band_rotation(rotation, degree), sh[:, band])
    return cloud.replaced(
        means=(cloud.means @ rotation.T).astype(np.float32),
        quats=_product(_quaternion(rotation), cloud.quats.astype(np.float64)).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def _band_rotation(rotation: np.ndarray, degree: int) -> Float64[np.ndarray, "K K"]:
    """D with Y(d) (D c) = Y(Rᵀd) c for all directions d and coefficients c of one degree."""
    k = np.arange(NUM_DIRECTIONS) + 0.5  # a Fibonacci lattice
    z, angle = 1 - 2 * k / NUM_DIRECTIONS, np.pi * (1 + 5**0.5) * k
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)
    D = np.linalg.pinv(_bases(directions, degree)) @ _bases(directions @ rotation, degree)
    left, _, right = np.linalg.svd(D)
    return left @ right  # exactly orthogonal, although the bases are in single precision


def _bases(directions: np.ndarray, degree: int) -> Float64[np.ndarray, "D K"]:
    """The basis functions of one degree, as the colours ½ + Y_k(d) / 4 that the renderer gives to coefficients of ¼."""
    first, end = num_bases(degree - 1), num_bases(degree)
    sh = torch.zeros(end - first, len(directions), end, 3, dtype=torch.float32)
    sh[torch.arange(end - first), :, torch.arange(first, end)] = 0.25
    means = torch.from_numpy(directions).float().expand(end - first, -1, -1).reshape(-1, 3)
    colors = sh_fwd(means.contiguous(), sh.reshape(-1, end, 3), torch.eye(4, dtype=torch.float32), degree)[:, 0]
    return ((colors.double() - 0.5) * 4).reshape(end - first, -1).T.numpy()


def _quaternion(rotation: np.ndarray) -> Float64[np.ndarray, "4"]:
    """(w, x, y, z) of a rotation matrix: the eigenvector of the largest eigenvalue (Bar-Itzhack 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    K = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    return np.linalg.eigh(K)[1][:, -1]


def _product(a: np.ndarray, b: np.ndarray) -> Float64[np.ndarray, "N 4"]:
    """The quaternion product a b of [4] and [N, 4]: first b's rotation, then a's."""
    w, vector = a[0] * b[:, :1] - b[:, 1:] @ a[1:, None], a[0] * b[:, 1:] + b[:, :1] * a[1:] + np.cross(a[1:], b[:, 1:])
    return np.concatenate([w, vector], 1)
