"""Multilayer perceptron with a hand-written backward pass and optional half precision (kernels/mlp.py).

Layer k computes h_{k+1} = max(0, W_k x_k + b_k) in one call, the last layer without max. Its input x_k is h_k or, for
the first layer and the skip connection, the encoding e or [h_k, e]; the tensor of e has free columns for h_k. The
backward pass is g_k = (g_{k+1} W_k) · [h_k > 0]; the gradients of W_k and b_k are g_{k+1}ᵀ x_k and the sum of g_{k+1}
over its rows.

All weights and biases are views of one tensor, and so are their gradients, so that an operation on all of them is one
launch. In half precision h_k and g_k of all layers are stacked, so that one batched product gives the gradients of all
weights of equal shape. Products for each layer are too small for a GPU below some ten thousand rows.
"""

import os
from collections.abc import Sequence
from itertools import chain, groupby
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float16, Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from warpgs.kernels import mlp as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.launch import launch

from .encoding import ALIGNMENT, ROW_ALIGNMENT, aligned

MAX_GRADIENT = 1024.0
"""In half precision, gradients are scaled so that the largest one at the output has this magnitude: far enough below
the largest number, 65504, and with 34 bits until a gradient underflows."""

MPS_LIMIT = "CUDA_MPS_ACTIVE_THREAD_PERCENTAGE"
"""Variable that limits the multiprocessors of a process; what it breaks is in docs/design/half-precision.md."""

MAX_CHUNKS = 16384
"""Maximum number of partial sums over rows of the outputs' gradients: enough threads to saturate memory, few enough to
be added up quickly."""

ROWS_PER_CHUNK = 4
"""Minimum number of rows of such a partial sum."""

ROWS_PER_PRODUCT = 1024
"""Rows of a product in a batch, a multiple of ``ROW_ALIGNMENT``. A layer's products are added up afterwards."""

MAX_STACKED_ROWS = 65_536
"""Above this number of rows, layers are multiplied one after the other: gradients of all at once would need memory."""


class Layer(NamedTuple):
    """Parameters of one layer, as views.

    Attributes:
        weight: [rows, columns].
        bias: [rows].
    """

    weight: Float[Tensor, "rows columns"]
    bias: Float[Tensor, " rows"]


def num_values(shapes: Sequence[tuple[int, int]]) -> int:
    """Number of weights and biases of layers whose weights have these shapes."""
    return sum(rows * columns + rows for rows, columns in shapes)


def split(values: Float[Tensor, " values"], shapes: Sequence[tuple[int, int]]) -> list[Layer]:
    """The layers as views of ``values``, which has the weights of all layers first, then all biases."""
    rows = [r for r, _ in shapes]
    *weights, biases = values.split([r * c for r, c in shapes] + [sum(rows)])
    pairs = zip(weights, biases.split(rows), shapes, strict=True)
    return [Layer(weight.view(shape), bias) for weight, bias, shape in pairs]


def perceptron(
    inputs: Float[Tensor, "rows columns"],
    values: Float[Tensor, " values"],
    shapes: Sequence[tuple[int, int]],
    skip: int,
    outputs: tuple[int, ...],
    num_rows: int | None = None,
) -> tuple[Float[Tensor, "N _"], ...]:
    """Evaluates the layers; differentiable in ``values`` only.

    Args:
        inputs: [rows, R + E] whose last E columns are the encoding, the input of the first layer; the first R columns
            are overwritten by the input features of layer ``skip``; R = 0 without ``skip``. If it is half precision,
            all matrix factors are, too, and rows must be a multiple of ``ROW_ALIGNMENT``; sums, gradients of ``values``
            and the result are single precision.
        values: Weights and biases in the layout of ``split``.
        shapes: Of the weights: [width, E], [width, width] …; that of layer ``skip`` is [width, R + E], and the last
            one has at least as many rows as there are outputs. In half precision all sizes must be multiples of 8, and
            all hidden layers must have the same width.
        skip: Index of the layer that reads the encoding again, after its features; 0 for none.
        outputs: Numbers of outputs to return in each tensor, from the first row of the last layer on; the other rows
            are padding.
        num_rows: N, the number of inputs to return the outputs of; the others are padding. All by default.

    Returns:
        [N, number] for each number of outputs: contiguous tensors, whose gradients autograd need not join.

    Raises:
        ValueError: In half precision, if the sizes do not fit, or MPS limits the multiprocessors of this process.
    """
    if inputs.dtype == torch.float16:
        _check_sizes(len(inputs), num_rows, [inputs.shape[1], *chain(*shapes)])
        check_half_precision()
    values = values if torch.is_grad_enabled() else values.detach()
    return _Perceptron.apply(inputs, values, tuple(shapes), skip, outputs, num_rows)


def limit_of_multiprocessors() -> str:
    """``VARIABLE=value`` if MPS limits the multiprocessors of this process, which may break half precision, or ""."""
    percentage = os.environ.get(MPS_LIMIT, "").strip()
    return "" if percentage in ("", "100") else f"{MPS_LIMIT}={percentage}"


def check_half_precision() -> None:
    """Raises ValueError if products in half precision may be wrong, with one line that says what to do."""
    limit = limit_of_multiprocessors()
    if limit:
        raise ValueError(
            f"{limit}: with part of the multiprocessors, cuBLAS computes wrong products in half precision; unset it, "
            "or begin a new run with --model.no-half"
        )


def _check_sizes(rows: int, num_rows: int | None, columns: Sequence[int]) -> None:
    if any(size % ALIGNMENT for size in columns):
        raise ValueError(f"in half precision rows and columns must be multiples of {ALIGNMENT}, got {list(columns)}")
    if rows % ROW_ALIGNMENT or rows < (num_rows or 0):
        raise ValueError(
            f"in half precision there must be a multiple of {ROW_ALIGNMENT} inputs, at least num_rows, got {rows}"
        )


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        inputs: Tensor,
        values: Tensor,
        shapes: tuple[tuple[int, int], ...],
        skip: int,
        outputs: tuple[int, ...],
        num_rows: int | None,
    ) -> tuple[Tensor, ...]:
        copy = values.to(inputs.dtype)
        *hidden, head = split(copy, shapes)
        x = inputs[:, inputs.shape[1] - shapes[0][1] :]
        layer_inputs = []
        stack = _new_stack(inputs, shapes) if ctx.needs_input_grad[1] else None
        for k, layer in enumerate(hidden):
            if skip and k == skip:
                # Writing the product here directly would need two more passes, for the bias and for max.
                _copy_columns(x, inputs)
                x = inputs
            layer_inputs.append(x)
            out = None if stack is None else stack[k, : len(x)]
            x = torch._addmm_activation(layer.bias, x, layer.weight.t(), out=out)
        ctx.save_for_backward(*layer_inputs, x, copy, stack)
        ctx.shapes = shapes
        product, bias = _product(x, head.weight.t())[:num_rows], split(values, shapes)[-1].bias
        used = slice(sum(outputs))
        return tuple(p + b for p, b in zip(product[:, used].split(outputs, 1), bias[used].split(outputs), strict=True))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *layer_inputs, copy, stack = ctx.saved_tensors
        layers = split(copy, ctx.shapes)
        is_half = copy.dtype == torch.float16
        v_values = torch.empty_like(copy, dtype=torch.float32)
        v_layers = split(v_values, ctx.shapes)
        shape = len(layer_inputs[0]), len(layers[-1].bias)
        if is_half:
            gradient, unscale, head_sums = _scaled(gradients, shape)
            sums = v_values.new_empty(len(layers) - 1, num_tiles(len(gradient)), len(layers[0].bias))
        else:
            gradient = v_values.new_zeros(shape)
            torch.cat(gradients, 1, out=gradient[: len(gradients[0]), : sum(v.shape[1] for v in gradients)])
            torch.sum(gradient, 0, out=v_layers[-1].bias)
        runs, v_stack = ([], None) if stack is None else (_square_runs(ctx.shapes), _new_stack(gradient, ctx.shapes))
        for k in reversed(range(len(layers))):
            if k not in chain(*runs):
                _product(gradient.t(), layer_inputs[k], v_layers[k].weight)
            if k > 0 and is_half:
                out = None if v_stack is None else v_stack[k - 1, : len(gradient)]
                gradient = layer_bwd(gradient, layers[k].weight, layer_inputs[k], sums[k - 1], out)
            elif k > 0:
                gradient = torch.mm(gradient, layers[k].weight[:, : len(layers[k - 1].bias)])
                features = layer_inputs[k][:, : gradient.shape[1]]
                torch.ops.aten.threshold_backward(gradient, features, 0, grad_input=gradient)
                torch.sum(gradient, 0, out=v_layers[k - 1].bias)
        for run in runs:
            _multiply_stacks(v_stack, stack, run, ctx.shapes, v_values)
        if is_half:
            v_biases = v_values[-shape[1] - sums.shape[0] * sums.shape[2] : -shape[1]]
            torch.sum(sums, 1, out=v_biases.view(sums.shape[0], sums.shape[2]))
            v_values *= unscale
            torch.sum(head_sums, 1, out=v_layers[-1].bias)
        return None, v_values, None, None, None, None


def _scaled(gradients: Sequence[Tensor], shape: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Scales the outputs' gradients to half precision.

    Returns:
        [rows, columns] gradients beside each other, scaled and padded with zeros; the inverse of the scale; and
        [columns, chunks] partial sums over the rows of the gradients before they are scaled.
    """
    norms = [torch.linalg.vector_norm(v, torch.inf) for v in gradients if len(v)] or [gradients[0].new_zeros(())]
    largest = torch.stack(norms).amax().clamp_min(torch.finfo(torch.float32).tiny * MAX_GRADIENT)
    scale, scaled = (MAX_GRADIENT / largest)[None], gradients[0].new_zeros(shape, dtype=torch.float16)
    chunks = min(MAX_CHUNKS, -(-len(gradients[0]) // ROWS_PER_CHUNK))
    sums = scaled.new_zeros(shape[1], chunks, dtype=torch.float32)
    begin = 0
    for v in gradients:
        launch(kernels.scale_gradients, chunks * v.shape[1], v.contiguous(), scale, begin, scaled, sums)
        begin += v.shape[1]
    return scaled, largest / MAX_GRADIENT, sums


def _square_runs(shapes: Sequence[tuple[int, int]]) -> list[range]:
    """The hidden layers whose inputs are all units of the one before, as ranges of consecutive ones."""
    width = shapes[0][0]
    runs = groupby(range(1, len(shapes) - 1), lambda k: shapes[k] == (width, width))
    return [range(layers[0], layers[-1] + 1) for is_square, (*layers,) in runs if is_square]


def _new_stack(inputs: Tensor, shapes: Sequence[tuple[int, int]]) -> Tensor | None:
    """[hidden layers, rows, width] memory for the outputs of all hidden layers, or for their gradients.

    Rows after those of ``inputs``, up to a multiple of ``ROWS_PER_PRODUCT``, are 0. None if layers are not stacked.
    """
    rows = len(inputs)
    if inputs.dtype != torch.float16 or not 0 < rows <= MAX_STACKED_ROWS or not _square_runs(shapes):
        return None
    stack = inputs.new_empty(len(shapes) - 1, aligned(rows, ROWS_PER_PRODUCT), shapes[0][0])
    stack[:, rows:] = 0.0
    return stack


def _multiply_stacks(
    v_stack: Any, stack: Tensor, run: range, shapes: Sequence[tuple[int, int]], v_values: Tensor
) -> None:
    """Writes the gradients of the weights of consecutive square layers, from stacks of gradients and of features."""
    width, num = stack.shape[2], len(run)
    chunks = (-1, ROWS_PER_PRODUCT, width)
    v_outputs, features = v_stack[run.start : run.stop].view(chunks), stack[run.start - 1 : run.stop - 1].view(chunks)
    products = _product(v_outputs.transpose(1, 2), features).view(num, -1, width, width)
    begin = sum(rows * columns for rows, columns in shapes[: run.start])
    torch.sum(products, 1, out=v_values[begin : begin + num * width**2].view(num, width, width))


def _copy_columns(source: Tensor, target: Tensor) -> None:
    """Copies ``source`` to the first columns of ``target``, in elements of 16 bytes if possible, which is faster."""
    if all(matrix.shape[1] * matrix.element_size() % 16 == 0 for matrix in (source, target)):
        source, target = source.view(torch.complex128), target.view(torch.complex128)
    target[:, : source.shape[1]] = source


def _product(a: Tensor, b: Tensor, out: Tensor | None = None) -> Tensor:
    """The matrix product in single precision, or those of a batch."""
    if a.ndim == 3:
        return torch.bmm(a, b, out_dtype=torch.float32)
    if a.dtype != torch.float16:
        return torch.mm(a, b, out=out)
    if out is None:
        return torch.mm(a, b, out_dtype=torch.float32)
    return torch.ops.aten.mm.dtype_out(a, b, torch.float32, out=out)


def num_tiles(size: int) -> int:
    """Number of tiles along an axis of the matrix that ``layer_bwd`` returns."""
    return -(-size // kernels.TILE)


def layer_bwd(
    v_outputs: Float16[Tensor, "N outputs"],
    weight: Float16[Tensor, "outputs weight_columns"],
    features: Float16[Tensor, "N feature_columns"],
    sums: Float32[Tensor, "tiles columns"],
    v_inputs: Float16[Tensor, "N columns"] | None = None,
) -> Float16[Tensor, "N columns"]:
    """Backward pass of a layer and of the ReLU before it. All numbers of columns are multiples of 8.

    Args:
        v_outputs: [N, outputs] gradient of the layer's outputs.
        weight: [outputs, ≥ columns] its weights.
        features: [N, ≥ columns] its inputs, the output of ReLU in the first columns.
        sums: [num_tiles(N), columns] output: partial sums of the result, whose sum over the first axis is the gradient
            of the bias before ReLU.
        v_inputs: Memory for the result; new memory if None.

    Returns:
        [N, columns] gradient of the inputs of ReLU: v_outputs · weight, summed in single precision, and zero where
        features are not positive.

    Raises:
        ValueError: On a wrong shape, dtype or device, a number of columns that is not a multiple of 8, weights or
            features with fewer columns than ``sums``, or a tensor that is not contiguous or, on CUDA, does not start at
            a multiple of 16 bytes.
    """
    _check_layer({"v_outputs": v_outputs, "weight": weight, "features": features}, sums)
    if v_inputs is None:
        v_inputs = v_outputs.new_empty(len(v_outputs), sums.shape[1])
    check_tensor("v_inputs", v_inputs, (len(v_outputs), sums.shape[1]), {}, (torch.float16,))
    kernel = kernels.make_layer_bwd(v_outputs.is_cuda)
    threads = num_tiles(len(v_inputs)) * num_tiles(sums.shape[1]) * (kernels.BLOCK_DIM if v_outputs.is_cuda else 1)
    arguments = (v_outputs, weight, features, v_inputs, sums)
    launch(kernel, threads, *arguments, block_dim=kernels.BLOCK_DIM, work=kernels.TILE**2)
    return v_inputs


def _check_layer(matrices: dict[str, Tensor], sums: Tensor) -> None:
    axes = {
        "v_outputs": ("N", "outputs"),
        "weight": ("outputs", "weight_columns"),
        "features": ("N", "feature_columns"),
    }
    sizes: dict[str, int] = {"tiles": num_tiles(len(matrices["v_outputs"]))}
    for name, matrix in matrices.items():
        check_tensor(name, matrix, axes[name], sizes, (torch.float16,))
    check_tensor("sums", sums, ("tiles", "columns"), sizes)
    check_same_device(matrices | {"sums": sums})
    for name, matrix in (*matrices.items(), ("sums", sums)):
        least, columns = 0 if name == "v_outputs" else sums.shape[1], matrix.shape[1]
        if columns % ALIGNMENT or columns < least:
            raise ValueError(f"{name} must have a multiple of {ALIGNMENT} columns, at least {least}, got {columns}")
        if matrix.is_cuda and matrix.data_ptr() % 16:
            raise ValueError(f"{name} must start at a multiple of 16 bytes; call .clone() on it")
