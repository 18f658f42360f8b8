"""Adam (Kingma and Ba 2015, algorithm 1) of many parameters at once.

m ← β₁ m + (1 − β₁) g,   v ← β₂ v + (1 − β₂) g²,   p ← p − rate · m / (1 − β₁ᵗ) / (√(v / (1 − β₂ᵗ)) + ε)

1 − β and log β are computed on the host in double precision: for a β near 1, single precision would keep few of their
digits.

Where the parameters are is known when a launch is captured in a CUDA graph, and may not be copied from the host then:
the arguments of ``adam_begin`` are all addresses, and it writes them where any thread of ``adam_step`` can read them.
"""

import warp as wp

from .lanes import native

MAX_PARAMETERS = 32
"""Maximum number of parameters of a launch, whose arguments may have 4 KiB."""

BLOCK, PER_THREAD = 256, 4
"""A parameter has a multiple of ``BLOCK`` threads, so that those of a warp read the same table entry, and each has this
many numbers, whose loads are in flight at once."""

Addresses = wp.types.vector(length=MAX_PARAMETERS, dtype=wp.int64)
Counts = wp.types.vector(length=MAX_PARAMETERS, dtype=int)


@wp.func_native(native("return ((const float*)address)[i];", "return ((const float*)address)[i];"))
def load(address: wp.int64, i: int) -> float: ...


@wp.func_native(native("((float*)address)[i] = value;", "((float*)address)[i] = value;"))
def store(address: wp.int64, i: int, value: float): ...


@wp.func
def one_minus_power(log_base: float, exponent: float) -> float:
    """1 − base ** exponent, by a series where the power is so close to 1 that the difference would lose its digits."""
    x = log_base * exponent
    if x > -0.03:
        return -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x / 24.0)))
    return 1.0 - wp.exp(x)


@wp.kernel(enable_backward=False)
def adam_begin(
    first: int,
    addresses: wp.array2d[wp.int64],
    counts: wp.array2d[int],
    factors: wp.array2d[float],
    parameters: Addresses,
    gradients: Addresses,
    means: Addresses,
    squares: Addresses,
    rates: Addresses,
    steps: Addresses,
    sizes: Counts,
    ends: Counts,
    log_beta1: float,
    log_beta2: float,
):
    """Thread k: counts the step of parameter k, and writes row k of the three tables.

    They are the addresses of parameters, gradients and moments; ``sizes``, and ``ends`` of the parameters' threads; and
    1 − β₁ᵗ, 1 − β₂ᵗ and the learning rate.
    """
    k = first + wp.tid()
    step = load(steps[k], 0) + 1.0
    store(steps[k], 0, step)
    addresses[k, 0] = parameters[k]
    addresses[k, 1] = gradients[k]
    addresses[k, 2] = means[k]
    addresses[k, 3] = squares[k]
    counts[k, 0] = sizes[k]
    counts[k, 1] = ends[k]
    factors[k, 0] = one_minus_power(log_beta1, step)
    factors[k, 1] = one_minus_power(log_beta2, step)
    factors[k, 2] = load(rates[k], 0)


@wp.kernel(enable_backward=False)
def adam_step(
    first: int,
    addresses: wp.array2d[wp.int64],
    counts: wp.array2d[int],
    factors: wp.array2d[float],
    beta1: float,
    one_minus_beta1: float,
    beta2: float,
    one_minus_beta2: float,
    epsilon: float,
):
    """Parameter k has the threads from ``counts[k - 1, 1]`` (0 for k = 0) to ``counts[k, 1]``."""
    thread = first + wp.tid()
    k = int(0)
    begin = int(0)
    while thread >= counts[k, 1]:
        begin = counts[k, 1]
        k += 1
    start = (thread - begin) / BLOCK * (BLOCK * PER_THREAD) + thread % BLOCK
    size = counts[k, 0]
    # Read once: the compiler must assume that stores change the tables.
    parameters = addresses[k, 0]
    gradients = addresses[k, 1]
    means = addresses[k, 2]
    squares = addresses[k, 3]
    mean_factor = factors[k, 0]
    square_factor = factors[k, 1]
    rate = factors[k, 2]
    gradient = wp.vec4(0.0)
    parameter = wp.vec4(0.0)
    mean = wp.vec4(0.0)
    square = wp.vec4(0.0)
    for j in range(PER_THREAD):
        if start + j * BLOCK < size:
            gradient[j] = load(gradients, start + j * BLOCK)
            parameter[j] = load(parameters, start + j * BLOCK)
            mean[j] = load(means, start + j * BLOCK)
            square[j] = load(squares, start + j * BLOCK)
    for j in range(PER_THREAD):
        if start + j * BLOCK < size:
            g = gradient[j]
            m = beta1 * mean[j] + one_minus_beta1 * g
            v = beta2 * square[j] + one_minus_beta2 * g * g
            root = wp.sqrt(v / square_factor)
            store(means, start + j * BLOCK, m)
            store(squares, start + j * BLOCK, v)
            store(parameters, start + j * BLOCK, parameter[j] - rate * (m / mean_factor) / (root + epsilon))
