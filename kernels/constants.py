"""Constants that define the rasterizer, each with its source."""

import math

import warp as wp

TILE_SIZE = wp.constant(16)
"""Width and height of a tile [px]; as in 3DGS (Kerbl et al. 2023, section 6)."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian whose alpha in a pixel is below this is skipped there; 3DGS, section 6."""

TRANSMITTANCE_MIN = wp.constant(1.0e-4)
"""Compositing of a pixel stops before its transmittance would fall to this; 3DGS, section 6."""

LOG2_ALPHA_MIN = wp.constant(math.log2(ALPHA_MIN))
"""``ALPHA_MIN`` as a base-2 logarithm: compositing rows hold opacities as base-2 logarithms."""

LOG2_E = wp.constant(math.log2(math.e))
LN_2 = wp.constant(math.log(2.0))

LOW_PASS = wp.constant(0.3)
"""Variance added to every projected covariance [px²], the footprint of a pixel; EWA splatting as in 3DGS."""

FAR = wp.constant(1.0e10)
"""Gaussians at this distance from the camera or further are culled [scene units], so that products with positions stay
finite; the far plane of gsplat."""

FIELD_OF_VIEW_MARGIN = wp.constant(0.3)
"""The projection's Jacobian is evaluated at most this fraction of half the field of view outside the image. 3DGS uses
1.3 times the half field of view; gsplat does the same relative to the principal point."""

CULLED_LOG2_OPACITY = wp.constant(-1.0e30)
"""Base-2 log-opacity of a culled Gaussian: finite, so that no product with it is NaN."""

CULLED_DEPTH = wp.constant(0x7F7FFFFF)
"""Depth sort key of a culled Gaussian: the bits of the largest float."""

MIN_ALPHA = wp.constant(1.0e-6)
"""Lower bound of the opacity that depth is divided by: keeps it finite in empty pixels."""

MIN_INVERSE_DEPTH = wp.constant(1.0e-3)
"""Aligned inverse depth below this is treated as unknown [1 / scene units]: close to zero, a small error of inverse
depth would be a huge error of depth."""
