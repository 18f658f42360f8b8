"""The options ``--model.*``."""

from dataclasses import dataclass
from typing import Annotated, Literal

from .bounds import Bounds

MAX_DEPTH, MAX_WIDTH = 64, 4096
"""Maximum numbers of hidden layers of a network, and of units in each of them."""


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the two networks and of the initial Gaussians."""

    position_bands: Annotated[int, Bounds(max=64)] = 6
    """Number of frequencies L in the encoding of positions (paper Eq. 6)."""
    time_bands: Annotated[int, Bounds(max=64)] = 6
    """Number of frequencies L in the encoding of time: 10 for real captures, 6 for synthetic ones (paper Eq. 6)."""
    raw_input: bool = True
    """Whether the networks get position and time beside their encodings, as in Deformable-3DGS; not in paper Eq. 6."""
    min_period: float = 4.0
    """Minimum period of the frequencies in the encoding of time [training frames]; higher frequencies overfit and are
    dropped. 0: all are kept (paper)."""
    depth: Annotated[int, Bounds(min=1, max=MAX_DEPTH)] = 8
    """Number of hidden layers of each network."""
    width: Annotated[int, Bounds(min=1, max=MAX_WIDTH)] = 256
    """Number of units per hidden layer."""
    appearance_size: tuple[int, int] | None = (4, 128)
    """Numbers of hidden layers and of units in each of them of the appearance network; as of the deformation if None
    (paper)."""
    skip: int = 4
    """Hidden layer after which the encoding is concatenated again (5 in Deformable-3DGS), unless it is the last one."""
    deformation: str = "mlp"
    """Deformation model, a key of FIELDS in warpgs/model/fields.py; "splines" takes the place of "mlp" on tracks."""
    segments: Annotated[int | None, Bounds(min=1, max=256)] = None
    """Number of segments of time, each with dynamic Gaussians and a deformation network of its own; neighbours overlap
    by a twentieth. One for every 600 times of training frames if omitted, so that a network has seconds to learn, not
    minutes. The numbers of Gaussians and of steps to fit the deformation are those of each segment."""
    sh_degree: int = 3
    """Maximum degree of spherical harmonics."""
    appearance: Literal["color", "all"] = "color"
    """What the appearance network changes of static Gaussians: their colours from all directions alike (color), or all
    coefficients of spherical harmonics and opacities (all; paper Eq. 8). With one camera at a time that fits shadows by
    fading Gaussians at wrong depths in and out."""
    half: bool = True
    """On CUDA, multiply the networks' matrices in half precision and sum in single; only if 8 divides ``width``. The
    fit of the deformation to points is always in single precision."""
    max_static_points: int = 100_000
    """Maximum number of initial static Gaussians."""
    dynamic_points: int = 20_000
    """Number of initial dynamic Gaussians."""
    dropout: Annotated[float, Bounds(max=0.9)] = 0.1
    """Fraction of the Gaussians that each iteration of stages I and II omits at random, while the opacities of the
    others are divided by one minus it, so that none relies on a few others (DropGaussian). 0: none (paper)."""
    reflections: bool = False
    """Whether a network adds colours to dynamic Gaussians by their normals and by the directions that they reflect, in
    world axes: highlights stay where the light is while objects turn. Exports omit them."""
    tracks: bool = True
    """Whether small objects that move far between frames start on tracks (docs/design/tracks.md)."""
