"""Rows of pixels, which the CPU reads and writes at once.

A loop over the elements of an array is not one vector instruction, because only the launch knows the array's strides.
These functions read ``count`` values of an array, whose axes are contiguous, from index ``begin`` on, and write them.
"""

import functools

import warp as wp

_OF_IMAGE = "const float* data = image == 0 ? joint.data : image == 1 ? static_values.data : dynamic_values.data;"
"""C++ code for the gradients of an image, which has its own array, or none if they are zero."""


@wp.func_native(f"{_OF_IMAGE} return data ? data[(size_t)pixel * channels + channel] : 0.0f;")
def read_gradient(
    image: int,
    joint: wp.array[float],
    static_values: wp.array[float],
    dynamic_values: wp.array[float],
    pixel: int,
    channels: int,
    channel: int,
) -> float:
    """A channel of the gradient at a pixel of an image; zero if the array of that image is missing."""
    ...


@functools.cache
def make_read_row(length: int, dtype: type = float) -> tuple[type, wp.Function]:
    """A vector type of ``length`` values, and a function that reads it; the values after ``count`` are zero."""
    vector = wp.types.vector(length=length, dtype=dtype)

    @wp.func_native(_read(length, dtype, "values.data + begin"))
    def read_row(values: wp.array(dtype=dtype), begin: int, count: int) -> vector: ...

    return vector, read_row


@functools.cache
def make_read_gradient_row(length: int) -> tuple[type, wp.Function]:
    """As ``make_read_row``, of the array of an image; the values are zero if that array is missing."""
    vector = wp.types.vector(length=length, dtype=float)

    @wp.func_native(f"{_OF_IMAGE} if (!data) count = 0;" + _read(length, float, "data + begin"))
    def read_gradient_row(
        image: int,
        joint: wp.array[float],
        static_values: wp.array[float],
        dynamic_values: wp.array[float],
        begin: int,
        count: int,
    ) -> vector: ...

    return vector, read_gradient_row


@functools.cache
def make_write_row(length: int, dtype: type = float, ndim: int = 1) -> tuple[type, wp.Function]:
    """A vector type of ``length`` values, and a function that writes the first ``count`` of them."""
    vector = wp.types.vector(length=length, dtype=dtype)

    @wp.func_native(
        f"""
        {dtype.__name__}* target = values.data + begin;
        if (count == {length}) __builtin_memcpy(target, &row, sizeof(row));
        else for (int i = 0; i < count; ++i) target[i] = row[i];
        """
    )
    def write_row(values: wp.array(dtype=dtype, ndim=ndim), begin: int, count: int, row: vector): ...

    return vector, write_row


def _read(length: int, dtype: type, source: str) -> str:
    """C++ code that returns ``count`` values from an address on, and zeros after them."""
    return f"""
        wp::vec_t<{length}, {dtype.__name__}> row;
        if (count == {length}) {{
            __builtin_memcpy(&row, {source}, sizeof(row));
        }} else {{
            for (int i = 0; i < {length}; ++i) row[i] = 0;
            for (int i = 0; i < count; ++i) row[i] = ({source})[i];
        }}
        return row;
        """
