"""The PLY file of 3DGS, as its viewer, SuperSplat and the plug-ins of game engines read it.

One row of floats per Gaussian: x y z, nx ny nz (zero), f_dc_0..2, f_rest_* (all of red, then green, then blue),
opacity (logit), scale_0..2 (logarithms), rot_0..3 (w, x, y, z). There are as many f_rest_* as the degree of the cloud
has: 0, 9, 24 or 45. The comment ``SplatRenderMode: mip`` (of Brush; SuperSplat reads it, too) asks renderers to
compensate opacities for their low-pass filter, as training did.
"""

from pathlib import Path

import numpy as np

from warpgs.data.ply import read_ply
from warpgs.ops.sh import MAX_DEGREE, num_bases

from .cloud import Cloud, unit_quats
from .ply import column, write_ply

REST_COUNTS = tuple(num_bases(degree) - 1 for degree in range(MAX_DEGREE + 1))
"""Number of coefficients per channel of degree 1 and higher, by degree."""


def columns(num_rest: int) -> list[str]:
    """Names of the properties of a file with ``num_rest`` coefficients per channel of degree 1 and higher."""
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{k}" for k in range(3 * num_rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def render_mode(cloud: Cloud) -> list[str]:
    """The comments of a PLY file that say how to render a cloud."""
    return ["SplatRenderMode: mip"] if cloud.antialias else []


def write_standard(path: Path, cloud: Cloud) -> int:
    """Writes the Gaussians of a cloud as 3DGS does; returns the size of the file [bytes].

    Raises:
        OSError: If it cannot be written; the message names the file.
    """
    N, rest = len(cloud), cloud.sh.shape[1] - 1
    values = [
        cloud.means,
        np.zeros((N, 3), np.float32),
        cloud.sh[:, 0],
        cloud.sh[:, 1:].transpose(0, 2, 1).reshape(N, 3 * rest),
        cloud.logit_opacities[:, None],
        cloud.log_scales,
        cloud.quats,
    ]
    rows = np.ascontiguousarray(np.concatenate(values, 1, dtype="<f4"))
    table = rows.view([(name, "<f4") for name in columns(rest)]).reshape(N)
    return write_ply(path, {"vertex": table}, render_mode(cloud))


def read_standard(path: Path) -> Cloud:
    """Reads the Gaussians of a PLY file of 3DGS, of any degree, also those with values that are not finite.

    Raises:
        ValueError: If it is another file or damaged; the message names it.
    """
    tables = read_ply(path)
    if "vertex" not in tables:
        raise ValueError(f"{path} has no element vertex")
    vertex = tables["vertex"]
    return Cloud(
        means=_block(path, vertex, ["x", "y", "z"]),
        quats=unit_quats(_block(path, vertex, [f"rot_{k}" for k in range(4)])),
        log_scales=_block(path, vertex, [f"scale_{k}" for k in range(3)]),
        logit_opacities=_block(path, vertex, ["opacity"])[:, 0],
        sh=_coefficients(path, vertex),
        is_dynamic=np.zeros(len(vertex), bool),
    )


def num_rest(path: Path, table: np.ndarray) -> int:
    """Number of coefficients per channel of degree 1 and higher: 0, 3, 8 or 15.

    Raises:
        ValueError: If the file has any other number; the message names it.
    """
    names = table.dtype.names or ()
    count = sum(name.startswith("f_rest_") for name in names)
    if count not in [3 * rest for rest in REST_COUNTS]:
        expected = ", ".join(str(3 * rest) for rest in REST_COUNTS)
        raise ValueError(f"{path} has {count} properties f_rest_*, expected one of {expected}")
    return count // 3


def _coefficients(path: Path, vertex: np.ndarray) -> np.ndarray:
    constant = _block(path, vertex, [f"f_dc_{k}" for k in range(3)])[:, None]
    rest = num_rest(path, vertex)
    others = np.zeros((len(vertex), 0), np.float32)
    if rest:
        others = _block(path, vertex, [f"f_rest_{k}" for k in range(3 * rest)])
    return np.concatenate([constant, others.reshape(len(vertex), 3, rest).transpose(0, 2, 1)], 1)


def _block(path: Path, vertex: np.ndarray, names: list[str]) -> np.ndarray:
    with np.errstate(over="ignore"):  # doubles that are too large become infinite, and are refused by the caller
        return np.stack([column(path, vertex, name).astype(np.float32) for name in names], 1)
