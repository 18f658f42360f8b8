"""The numbers that the rasterizer's definition rests on, each with its source."""

import math

import warp as wp

TILE_SIZE = wp.constant(16)
"""Width and height of a tile [px]; 3DGS (Kerbl et al. 2023, section 6) and every rasterizer since."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian fainter than this in a pixel is not drawn there; 3DGS, section 6."""

ALPHA_MAX = wp.constant(0.999)
"""Opacity of one Gaussian in one pixel never exceeds this, so that 1 - alpha can be divided by; as in gsplat 1.5."""

TRANSMITTANCE_MIN = wp.constant(1.0e-4)
"""A pixel is done before its transmittance would fall to this; 3DGS, section 6."""

LOG2_ALPHA_MIN = wp.constant(math.log2(ALPHA_MIN))
"""Opacities are kept as base-2 logarithms in the compositing rows, so the cut-off is too."""

LOG2_E = wp.constant(math.log2(math.e))
LN_2 = wp.constant(math.log(2.0))

LOW_PASS = wp.constant(0.3)
"""Variance added to every projected covariance [px²], a pixel's own footprint; EWA splatting as 3DGS uses it."""

FIELD_OF_VIEW_MARGIN = wp.constant(0.3)
"""The projection's Jacobian is taken at most this fraction of half the field of view outside the image; 3DGS uses
1.3 times the half field of view, gsplat the same with a real principal point."""

NEVER_DRAWN = wp.constant(-1.0e30)
"""Base-2 log-opacity of a culled Gaussian: finite, so that no product with it is NaN."""

CULLED_DEPTH = wp.constant(0x7F7FFFFF)
"""Sort key of a Gaussian that is not drawn: the bits of the largest float."""

MIN_ALPHA = wp.constant(1.0e-6)
"""Opacity that depth is at least divided by: keeps it finite where nothing was drawn."""

MIN_INVERSE_DEPTH = wp.constant(1.0e-3)
"""Aligned monocular depth is unknown from here on to infinity [1 / scene units]: next to zero, an error of its inverse
would be a vast one of depth."""
