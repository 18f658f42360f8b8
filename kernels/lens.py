"""What the files of the lenses share.

A lens is a function from a point in camera space to its point in the image [px] and the Jacobian J, 2×3. Its backward
pass, with J's own derivatives, is what Warp derives from it (``wp.grad``).
"""

import warp as wp

mat23 = wp.types.matrix(shape=(2, 3), dtype=float)

Distortion = wp.types.vector(length=12, dtype=float)
"""Coefficients of any lens, in its order; the rest are 0."""
