"""Adam (Kingma and Ba 2015, algorithm 1), one parameter per thread.

m ← β₁ m + (1 − β₁) g,   v ← β₂ v + (1 − β₂) g²,   p ← p − rate · m / (1 − β₁ᵗ) / (√(v / (1 − β₂ᵗ)) + ε)

1 − β and log β are computed on the host in double precision: for a β near 1, single precision would keep few of their
digits.
"""

import warp as wp


@wp.func
def one_minus_power(log_base: float, exponent: float) -> float:
    """1 − base ** exponent, by a series where the power is so close to 1 that the difference would lose its digits."""
    x = log_base * exponent
    if x > -0.03:
        return -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x / 24.0)))
    return 1.0 - wp.exp(x)


@wp.kernel(enable_backward=False)
def adam_step(
    first: int,
    gradients: wp.array[float],
    rate: wp.array[float],
    step: wp.array[float],
    beta1: float,
    one_minus_beta1: float,
    log_beta1: float,
    beta2: float,
    one_minus_beta2: float,
    log_beta2: float,
    epsilon: float,
    parameters: wp.array[float],
    means: wp.array[float],
    squares: wp.array[float],
):
    i = first + wp.tid()
    g = gradients[i]
    m = beta1 * means[i] + one_minus_beta1 * g
    v = beta2 * squares[i] + one_minus_beta2 * g * g
    means[i] = m
    squares[i] = v
    mean = m / one_minus_power(log_beta1, step[0])
    square = v / one_minus_power(log_beta2, step[0])
    parameters[i] = parameters[i] - rate[0] * mean / (wp.sqrt(square) + epsilon)
