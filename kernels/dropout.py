"""Dropout of Gaussians while they are trained (Park et al., DropGaussian, CVPR 2025).

For each Gaussian, with a random number u in [0, 1) that depends on the seed and its index alone,

    factor = 0 if u < fraction, else 1 / (1 - fraction),

so that the expected value of factor times opacity is the opacity, as long as the product is not clamped to 1.
"""

import warp as wp


@wp.kernel(enable_backward=False)
def dropout_factors(first: int, seed: wp.array[float], fraction: float, factors: wp.array[float]):
    """One thread for each Gaussian. The seed is an integer below 2²⁴, which a float represents exactly."""
    i = first + wp.tid()
    u = wp.randf(wp.rand_init(int(seed[0]), i))
    factors[i] = wp.where(u < fraction, 0.0, 1.0 / (1.0 - fraction))
