"""What arrives at the layers of a composite."""

import itertools

import pytest
import torch

from tests.reference.layers import SMALLEST_ALPHA
from tests.reference.layers import layers as reference
from tests.scenes import generator, random_like, relative_error
from warpgs.ops.layers import Layers, gather_adjoints
from warpgs.ops.tape import differentiable


def taken_apart(composite, alpha, with_depth):
    """Layers of composites that are given, with the way back that compositing takes."""

    def op(run, composite, alpha):
        parts = reference(composite, alpha, with_depth)
        parts = [parts[k : k + len(alpha)] for k in range(0, len(parts), len(alpha))]
        layers = Layers(*(tuple(kind) for kind in (*parts, *[()] * (3 - len(parts)))))
        depth = torch.stack(layers.depths) if with_depth else None

        def backward(run):
            *gradients, arrived = gather_adjoints(run, layers, alpha, depth)
            for k, tensors in enumerate(zip(*(kind for kind in layers if kind), strict=True)):
                assert arrived >> k & 1 == any(run.adjoint(t) is not None for t in tensors)
            for tensor, gradient in zip((composite, alpha), gradients, strict=True):
                if gradient is not None:
                    run.add_adjoint(tensor, gradient.view(tensor.shape))

        run.on_backward(backward)
        return tuple(itertools.chain(*layers))

    return differentiable(op, composite, alpha)


def make_inputs(num, size=(9, 7), channels=4):
    """Also with pixels where nothing or next to nothing was drawn."""
    g = generator()
    alpha = torch.rand(num, *size, generator=g)
    alpha[torch.rand(alpha.shape, generator=g) > 0.8] = 0.0
    alpha[torch.rand(alpha.shape, generator=g) > 0.8] = 0.5 * SMALLEST_ALPHA
    return torch.rand(num, *size, channels, generator=g), alpha


def both_gradients(num, with_depth, arrives, size=(9, 7)):
    """Ours and, in double precision, the reference's, if something arrives at outputs of which ``arrives`` says so."""
    single = [t.requires_grad_() for t in make_inputs(num, size)]
    double = [t.detach().double().requires_grad_() for t in single]
    outputs = [taken_apart(*single, with_depth), reference(*double, with_depth)]
    chosen = [k for k in range(len(outputs[0])) if arrives(k)]
    cotangents = random_like(outputs[0])
    for values in outputs:
        torch.autograd.backward([values[k] for k in chosen], [cotangents[k].to(values[k].dtype) for k in chosen])
    return single, double


@pytest.mark.parametrize("num", [1, 3])
@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("arrives", [lambda k: True, lambda k: k % 2 == 0, lambda k: k % 2 == 1, lambda k: k == 0])
def test_gradients_are_those_of_the_reference_wherever_something_arrives(num, with_depth, arrives):
    for single, double in zip(*both_gradients(num, with_depth, arrives), strict=True):
        if double.grad is None or not double.grad.any():
            assert single.grad is None or not single.grad.any()
        else:
            assert relative_error(single.grad, double.grad) < 1e-6


@pytest.mark.parametrize("size", [(0, 5), (1, 1)])
def test_layers_of_no_or_one_pixel_have_gradients(size):
    for single, double in zip(*both_gradients(3, True, lambda k: True, size), strict=True):
        assert single.grad.shape == double.grad.shape
        assert torch.allclose(single.grad.double(), double.grad, rtol=1e-6)


def test_where_nothing_was_drawn_gradients_stay_finite():
    single, _ = both_gradients(3, True, lambda k: True)
    assert all(t.grad.isfinite().all() for t in single)
