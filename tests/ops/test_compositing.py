"""Alpha compositing of 2D splats: values, gradients, cut-offs."""

import pytest
import torch
from torch.nn.functional import pad

from tests.ops.alone import composite, pack
from tests.reference.compositing import absolute_gradients
from tests.reference.compositing import composite as reference
from tests.reference.projection import Projection
from tests.reference.rows import splat_gradients
from tests.scenes import assert_same_gradients, error, generator, random_like, relative_error, weighted_sum
from warpgs.kernels.rows import NUM_ABSOLUTE_SUMS, NUM_MOMENTS
from warpgs.ops import compositing
from warpgs.ops.compositing import composite_bwd, composite_fwd
from warpgs.ops.tiles import bin_splats
from warpgs.runtime import launch
from warpgs.runtime.launch import command_for


@pytest.fixture(autouse=True, params=["rows", "pixels"])
def loop(request, monkeypatch):
    """Each test composites whole rows of a tile at once, as on CPU, and pixel by pixel, as on CUDA."""
    if request.param == "pixels":
        monkeypatch.setattr(compositing, "CPU_PIXELS", compositing.CUDA_PIXELS)


SIZE = (50, 37)
INPUTS = ("means2d", "conics", "opacities", "features", "background")


def make_inputs(num=40, size=SIZE, channels=3, opacity=0.9, spread=0.25, seed=3) -> list[torch.Tensor]:
    """means2d, conics, opacities, features, background, depths of splats all over an image."""
    g = generator(seed)
    means2d = torch.rand(num, 2, generator=g) * torch.tensor(size)
    root = torch.randn(num, 2, 2, generator=g) * spread
    precision = root @ root.mT + 0.01 * torch.eye(2)
    conics = torch.stack([precision[:, 0, 0], precision[:, 0, 1], precision[:, 1, 1]], -1)
    opacities = torch.rand(num, generator=g) * opacity + 0.05
    features = torch.rand(num, channels, generator=g)
    return [means2d, conics, opacities, features, torch.rand(channels, generator=g), torch.rand(num, generator=g) + 1]


def ours(inputs, size=SIZE, **options):
    means2d, conics, opacities, features, background, depths = inputs
    radii = torch.full(means2d.shape, 1000, dtype=torch.int32)
    splats = Projection(means2d, conics, depths, opacities, radii)
    return composite(splats, features, size, background=background, **options)


def make_walled_inputs(num=40, size=SIZE):
    """Inputs whose first twelve splats are an opaque wall in front of all others."""
    inputs = make_inputs(num, size)
    inputs[1][:12] = torch.tensor([1e-4, 0.0, 1e-4])
    inputs[2][:12] = 0.8
    inputs[5][:12] -= 1
    return inputs


def theirs(inputs, size=SIZE, selected=None, **options):
    means2d, conics, opacities, features, background, depths = inputs
    selected = torch.ones(means2d.shape[0], dtype=torch.bool) if selected is None else selected
    return reference((means2d, conics, depths, opacities), features, selected, size, background, **options)


def leaves(inputs, dtype=torch.float32):
    return [t.detach().clone().to(dtype).requires_grad_() for t in inputs]


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), SIZE])
def test_image_and_alpha_equal_the_reference(size):
    inputs = make_inputs(size=size)
    image, alpha, _ = theirs([t.double() for t in inputs], size)
    result = ours(inputs, size)
    assert error(result.images[0], image) < 2e-6
    assert error(result.alphas[0], alpha) < 2e-6


@pytest.mark.parametrize("num", [0, 1, 40])
def test_gradients_equal_the_reference(num):
    inputs = make_inputs(num)
    single, double = leaves(inputs), leaves(inputs, torch.float64)
    result = ours(single)
    outputs = [result.images[0], result.alphas[0]]
    v_outputs = random_like(outputs)
    weighted_sum(outputs, v_outputs).backward()
    weighted_sum(theirs(double)[:2], v_outputs).backward()
    for name, actual, expected in zip(INPUTS, single, double, strict=False):
        wanted = torch.zeros_like(expected) if expected.grad is None else expected.grad
        assert (actual.grad - wanted).norm() <= 1e-5 * wanted.norm(), name


def test_gradients_of_three_images_equal_the_reference():
    inputs = make_inputs()
    branch = torch.rand(40) > 0.5
    single, double = leaves(inputs), leaves(inputs, torch.float64)
    result = ours(single, is_dynamic=branch, statistics=True)
    expected = [theirs(double, selected=selected) for selected in (None, ~branch, branch)]
    expected = [e[k] for k in (0, 1) for e in expected]
    assert_same_gradients([*result.images, *result.alphas], expected, single[:5], double[:5])


@pytest.mark.parametrize("k", [0, 1], ids=["image", "alpha"])
def test_a_gradient_of_a_single_output_is_propagated(k):
    inputs = make_inputs()
    single, double = leaves(inputs), leaves(inputs, torch.float64)
    assert_same_gradients(ours(single)[k], [theirs(double)[k]], single[:3], double[:3])


def test_a_stack_of_opaque_splats_stops_where_the_reference_stops():
    inputs = make_inputs(60, opacity=0.0, spread=0.0)
    inputs[1] = torch.tensor([[2e-4, 0.0, 3e-4]]).repeat(60, 1)
    inputs[2] = torch.full((60,), 0.83)
    single, double = leaves(inputs), leaves(inputs, torch.float64)
    result, (image, _, weights) = ours(single, statistics=True), theirs(double)
    hidden = weights.sum((1, 2)) == 0
    assert hidden.any()
    assert torch.equal(result.statistics[0], ~hidden)
    assert error(result.images[0], image) < 2e-6
    assert_same_gradients(result.images, [image], single[2:3], double[2:3])
    assert not single[2].grad[hidden].any()


@pytest.mark.parametrize("max_alpha", [0.999, 0.99])
def test_a_fully_opaque_splat_gets_no_gradient_where_it_is_clamped(max_alpha):
    inputs = make_inputs(1)
    inputs[0] = torch.tensor([[25.5, 18.5]])
    inputs[2] = torch.ones(1)
    single, double = leaves(inputs), leaves(inputs, torch.float64)
    result, alpha = ours(single, max_alpha=max_alpha), theirs(double, max_alpha=max_alpha)[1]
    assert result.alphas[0].max().item() == pytest.approx(max_alpha, abs=1e-6)
    assert_same_gradients(result.alphas, [alpha], single[2:3], double[2:3])


@pytest.mark.parametrize("is_dynamic", [None, torch.arange(40) % 3 == 0])
def test_median_depth_is_that_of_the_splat_at_which_half_of_the_light_is_left(is_dynamic):
    means2d, conics, opacities, features, background, depths = inputs = make_walled_inputs()
    splats = Projection(means2d, conics, depths, opacities, torch.full(means2d.shape, 1000, dtype=torch.int32))
    rows, order = pack(splats, features, with_depth=True)
    tiles = bin_splats(rows, order, SIZE, None if is_dynamic is None else is_dynamic.view(torch.uint8))
    result, _ = composite_fwd(rows, tiles, SIZE, background, False, 0.999, median=True)
    selections = [None] if is_dynamic is None else [None, ~is_dynamic, is_dynamic]
    by_depth = depths.argsort()
    for depth, image, selected in zip(result.depths, result.images, selections, strict=True):
        expected_image, alpha, weights = theirs([t.double() for t in inputs], selected=selected)
        sorted_weights = weights[by_depth]
        before = 1.0 - sorted_weights.cumsum(0) + sorted_weights
        reached = ((sorted_weights > 0) & (before > 0.5)) * depths[by_depth, None, None]
        assert (alpha > 0.9).any()
        assert (reached.amax(0) != depth).float().mean() < 0.001  # of single and double precision
        assert error(image, expected_image) < 2e-6


def make_clamped_inputs():
    """Wide splats, the first of which has a larger alpha than 0.99 in a third of the pixels, in front of the others."""
    inputs = make_inputs(3)
    inputs[0] = torch.tensor([[25.0, 18.5], [10.0, 30.0], [40.0, 5.0]])
    inputs[1] = torch.tensor([[1e-4, 2e-5, 8e-5], [2e-3, 0.0, 1e-3], [1e-3, 0.0, 2e-3]])
    inputs[2], inputs[5] = torch.tensor([0.998, 0.7, 0.9]), torch.tensor([1.0, 2.0, 3.0])
    return inputs


def test_gradients_with_clamped_alphas_equal_the_reference():
    single, double = leaves(make_clamped_inputs()), leaves(make_clamped_inputs(), torch.float64)
    result, expected = ours(single, max_alpha=0.99), theirs(double, max_alpha=0.99)[:2]
    assert error(result.images[0], expected[0]) < 2e-6
    assert_same_gradients([*result.images, *result.alphas], expected, single[:5], double[:5])


@pytest.mark.parametrize("name", INPUTS)
def test_gradients_with_clamped_alphas_predict_the_effect_of_a_small_step(name):
    """Central differences along the gradient of the first splat, which is clamped."""
    inputs, k = make_clamped_inputs(), INPUTS.index(name)
    weights = torch.rand(SIZE[1], SIZE[0], 3, generator=generator()).double()

    def loss(values):
        return (ours([*inputs[:k], values, *inputs[k + 1 :]], max_alpha=0.99).images[0].double() * weights).sum()

    values = inputs[k].clone().requires_grad_()
    loss(values).backward()
    direction = values.grad.clone()
    if name != "background":
        direction[1:] = 0
    direction /= direction.norm()
    step = {"means2d": 0.3, "conics": 2e-6, "opacities": 5e-4}.get(name, 1e-2)
    sides = [loss(values.detach() + sign * step * direction) for sign in (1, -1)]
    slope = ((sides[0] - sides[1]) / (2 * step)).item()
    assert slope == pytest.approx((values.grad * direction).sum().item(), rel=3e-3)


def test_statistics_are_the_sums_of_the_blend_weights():
    inputs = make_inputs()
    weights = theirs([t.double() for t in inputs])[2].sum((1, 2))
    result = ours(inputs, statistics=True)
    assert relative_error(result.statistics[1], weights) < 2e-6
    assert torch.equal(result.statistics[0], weights > 0)


@pytest.mark.parametrize("fraction", [0.0, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("k", [0, 1, 2])
def test_each_image_alone_propagates_its_gradient(fraction, k):
    inputs = make_inputs()
    dynamic = inputs[0][:, 0] < fraction * SIZE[0]  # so that there are tiles of one branch, too
    single, double = leaves(inputs), leaves(inputs, torch.float64)
    image = ours(single, is_dynamic=dynamic).images[k]
    expected = theirs(double, selected=(torch.ones(40, dtype=torch.bool), ~dynamic, dynamic)[k])[0]
    assert error(image, expected) < 2e-6
    (v_output,) = random_like([image])
    weighted_sum([image], [v_output]).backward()
    weighted_sum([expected], [v_output]).backward()
    for name, a, e in zip(INPUTS, single, double, strict=False):
        wanted = torch.zeros_like(e) if e.grad is None else e.grad
        assert error(a.grad, wanted) < 1e-5 * (1 + wanted.abs().max()), name


@pytest.mark.parametrize("wall_is_dynamic", [False, True])
def test_behind_a_wall_of_one_branch_the_other_has_its_own_image(wall_is_dynamic):
    inputs = make_walled_inputs()
    dynamic = (torch.arange(40) < 12) == wall_is_dynamic
    dynamic[20:25] = wall_is_dynamic
    single, double = leaves(inputs), leaves(inputs, torch.float64)
    result = ours(single, is_dynamic=dynamic)
    outputs = [*result.images, *result.alphas]
    for k in (0, 3):
        assert torch.equal(outputs[k], outputs[k + 1 + wall_is_dynamic])
    expected = [theirs(double, selected=selected) for selected in (None, ~dynamic, dynamic)]
    expected = [e[k] for k in (0, 1) for e in expected]
    for actual, wanted in zip(outputs, expected, strict=True):
        assert error(actual, wanted) < 2e-6
    assert_same_gradients(outputs, expected, single[:5], double[:5])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("make", [make_inputs, make_walled_inputs])
def test_every_image_equals_that_of_its_splats_rendered_alone(make, seed, monkeypatch):
    size = (112, 80)  # with splats that reach into more tiles than one thread writes
    inputs = make(60, size)
    inputs[1][::4] = torch.tensor([1e-4, 0.0, 1e-4])
    inputs[2] *= torch.rand(60, generator=generator(seed))
    dynamic = torch.rand(60, generator=generator(seed)) < (0.1, 0.5, 0.9, 0.5)[seed]
    alone = [ours([t if t.shape[0] != 60 else t[selected] for t in inputs], size) for selected in (~dynamic, dynamic)]
    launch_on_cpu = launch.launch_on_cpu
    for backwards in (False, True):  # as on a GPU, where a branch's image may begin before the joint one ends

        def run_kernel(kernel, dim, arguments, per_shard, work, backwards=backwards):
            if not backwards or kernel.func.__name__ != "composite_fwd":
                return launch_on_cpu(kernel, dim, arguments, per_shard, work)
            for thread in reversed(range(dim)):
                command_for(kernel, launch.CPU, 1).run_chunks(
                    range(thread, thread + 1), 1, thread + 1, (*arguments, *per_shard)
                )

        monkeypatch.setattr(launch, "launch_on_cpu", run_kernel)
        result = ours(inputs, size, is_dynamic=dynamic)
        for k, expected in enumerate([ours(inputs, size), *alone]):
            assert torch.equal(result.images[k], expected.images[0])
            assert torch.equal(result.alphas[k], expected.alphas[0])


def test_a_splat_that_completes_a_pixel_of_the_joint_image_only_makes_it_differ():
    conics, means2d = torch.tensor([[0.01, 0.0, 0.01]]).repeat(4, 1), torch.full((4, 2), 0.5)
    opacities, depths = torch.tensor([0.99, 0.98, 0.9, 0.4]), torch.arange(1.0, 5.0)
    inputs = [means2d, conics, opacities, torch.eye(4), torch.zeros(4), depths]
    dynamic = torch.arange(4) == 2
    static = ours([t if t is inputs[4] else t[~dynamic] for t in inputs], (1, 1))
    images = ours(inputs, (1, 1), is_dynamic=dynamic).images
    assert torch.equal(images[1], static.images[0])
    assert not torch.equal(images[1], images[0])


FEW = make_inputs(8, size=(20, 17))


@pytest.mark.parametrize(
    ("inputs", "dynamic"),
    [
        (FEW, None),
        (FEW, torch.arange(8) < 0),
        (FEW, torch.arange(8) < 3),
        (FEW, torch.arange(8) < 8),
        (make_walled_inputs(16, (20, 17)), torch.arange(16) < 12),
        (make_walled_inputs(16, (20, 17)), torch.arange(16) >= 12),
    ],
)
def test_absolute_gradients_on_screen_sum_absolute_values_over_the_pixels_of_all_images(inputs, dynamic):
    size = (20, 17)
    means2d, conics, opacities, features, background, depths = leaves(inputs, torch.float64)
    with_depth = torch.cat([features, depths[:, None]], 1), torch.cat([background, torch.zeros(1, dtype=torch.float64)])
    layers = []
    for selected in [depths > 0] if dynamic is None else [depths > 0, ~dynamic, dynamic]:
        image, alpha, _ = reference((means2d, conics, depths, opacities), with_depth[0], selected, size, with_depth[1])
        depth = torch.where(alpha > 0, image[..., -1] / torch.where(alpha > 0, alpha, 1.0), 0.0)
        layers.append((image[..., :-1], alpha, depth))
    v_layers = [random_like(image, seed) for seed, image in enumerate(layers)]
    for (_, alpha, _), v in zip(layers, v_layers, strict=True):
        v[2] *= alpha.detach().float()  # depth is not smooth where alpha is near 0
    pairs = list(zip(layers, v_layers, strict=True))
    absolute = sum(absolute_gradients(*pair, means2d) for pair in pairs)
    (plain,) = torch.autograd.grad(sum(weighted_sum(*pair) for pair in pairs), means2d)
    for absgrad in (False, True):
        sums = gradient_sums(inputs, dynamic, v_layers, absgrad, size)
        assert relative_error(splat_gradients(*inputs[1:3], sums)[0], plain) < 1e-5
    assert relative_error(sums[:, NUM_MOMENTS:][:, :NUM_ABSOLUTE_SUMS], absolute) < 1e-5


def gradient_sums(inputs, dynamic, v_layers, absgrad, size):
    """The sums of each splat that follow its channels; ``v_layers`` are those of image, alpha and depth by image."""
    means2d, conics, opacities, features, background, depths = inputs
    radii = torch.full(means2d.shape, 1000, dtype=torch.int32)
    rows, order = pack(Projection(means2d, conics, depths, opacities, radii), features, with_depth=True)
    tiles = bin_splats(rows, order, size, None if dynamic is None else dynamic.view(torch.uint8))
    _, traversal = composite_fwd(rows, tiles, size, background, statistics=False, max_alpha=0.999)
    v_layers = [v for kind in zip(*v_layers, strict=True) for v in kind]
    return composite_bwd(rows, background, traversal, v_layers, absgrad)[..., rows.num_channels :].sum(0)


@pytest.mark.parametrize("num", [0, 1, 8])
def test_absolute_gradients_do_not_depend_on_the_tiles_that_the_splats_lie_in(num):
    """Shifts change which splats share a tile, and so which blocks of the three images are equal."""
    inputs, dynamic, size = make_inputs(num, size=(20, 17)), torch.arange(num) % 2 == 0, (60, 60)
    inputs[0][dynamic, 0] *= 0.3
    found = []
    for x, y in ((10, 10), (21, 17)):
        border = (x, size[0] - 20 - x, y, size[1] - 17 - y)
        v_layers = [[pad(v, border) for v in random_like(torch.zeros(5, 17, 20).split([3, 1, 1]), k)] for k in range(3)]
        v_layers = [[image.permute(1, 2, 0).contiguous(), alpha[0], depth[0]] for image, alpha, depth in v_layers]
        shifted = [inputs[0] + torch.tensor([x, y]), *inputs[1:]]
        sums = gradient_sums(shifted, dynamic, v_layers, True, size)
        found.append(sums[:, NUM_MOMENTS:][:, :NUM_ABSOLUTE_SUMS])
    assert torch.allclose(*found, rtol=1e-4)
    assert (found[0] > 0).all()


def test_the_default_background_is_black():
    inputs = make_inputs()
    plain = [*inputs[:4], None, inputs[5]]
    black = [*inputs[:4], torch.zeros(3), inputs[5]]
    assert torch.equal(ours(plain).images[0], ours(black).images[0])
