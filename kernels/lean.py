"""How the kernels of this package are compiled."""

import functools

import warp as wp

lean_kernel = functools.partial(wp.kernel, enable_backward=False, grid_stride=False)
"""``wp.kernel`` for kernels whose adjoint is written by hand or not needed. A thread does one index: the loop over more
that Warp would put around it costs a kernel up to half of its registers (docs/performance.md)."""
