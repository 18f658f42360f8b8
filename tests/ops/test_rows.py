"""Splat rows: packing and its backward pass."""

import pytest
import torch

from tests.ops.alone import project
from tests.reference import rows as reference
from tests.scenes import GEOMETRY, HEIGHT, WIDTH, error, generator, make_camera, make_splats, relative_error
from warpgs.kernels.constants import CULLED_DEPTH, CULLED_LOG2_OPACITY
from warpgs.kernels.rows import NUM_MOMENTS, gradient_stride
from warpgs.ops.projection import Geometry, Projection, View, project_bwd, project_fwd
from warpgs.ops.rows import pack, project_and_pack, unpack, unpack_and_unproject

NUM = 150
SIZE = (WIDTH, HEIGHT)


def geometry_and_view(num=NUM) -> tuple[Geometry, View]:
    splats, camera = make_splats(num), make_camera()
    return Geometry(*(getattr(splats, name) for name in GEOMETRY)), View(camera.viewmat, camera.K, *SIZE)


def projected(num=NUM) -> Projection:
    return project(*geometry_and_view(num))


def random_features(num=NUM, channels=5) -> torch.Tensor:
    return torch.rand(num, channels, generator=generator())


@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4, 5])
def test_rows_of_visible_splats_equal_the_reference(channels, with_depth):
    splats, features = projected(), random_features(channels=channels)
    visible = splats.radii[:, 0] > 0
    assert 10 < visible.sum() < NUM
    rows, _ = pack(splats, features, with_depth)
    packed = torch.cat([features, splats.depths[:, None]], 1) if with_depth else features
    doubles = [t[visible].double() for t in (splats.means2d, splats.conics, splats.opacities, packed)]
    assert relative_error(rows.packed[visible].flatten(1), reference.pack(*doubles)) < 1e-6


def test_culled_splats_are_marked_and_sorted_last():
    splats = projected()
    visible = splats.radii[:, 0] > 0
    rows, order = pack(splats, random_features(), False)
    assert torch.equal(rows.packed[:, 1, 1] == CULLED_LOG2_OPACITY, ~visible)
    assert (order.keys[:NUM][~visible] == CULLED_DEPTH).all()
    depths = torch.where(visible, splats.depths, torch.inf)
    assert torch.equal(order.keys[:NUM].argsort(stable=True), depths.argsort(stable=True))
    assert torch.equal(order.gaussian_from_rank[:NUM], torch.arange(NUM, dtype=torch.int32))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_splat_with_a_feature_that_is_not_finite_is_marked_as_culled(value):
    splats, features = projected(), random_features()
    features[::3, 2] = value
    rows, order = pack(splats, features, False)
    culled = rows.packed[:, 1, 1] == CULLED_LOG2_OPACITY
    assert culled[::3].all()
    assert (order.keys[:NUM][::3] == CULLED_DEPTH).all()
    assert torch.equal(culled[1::3], projected().radii[1::3, 0] == 0)
    assert torch.equal(culled, splats.radii[:, 0] == 0)
    assert torch.equal(culled, splats.radii[:, 1] == 0)


def test_radii_of_splats_with_a_singular_conic_become_zero():
    splats = projected()
    splats.conics[::3] = 1.0
    rows, _ = pack(splats, random_features(), False)
    culled = rows.packed[:, 1, 1] == CULLED_LOG2_OPACITY
    assert culled[::3].all()
    assert torch.equal(culled, splats.radii[:, 0] == 0)


@pytest.mark.parametrize("with_depth", [False, True])
def test_projecting_and_packing_at_once_gives_the_same_bits(with_depth):
    geometry, view = geometry_and_view()
    features, offsets = random_features(), 0.1 * random_features(channels=2)
    features[::7, 1] = torch.nan
    projection = project_fwd(geometry, view, 0.01, True, offsets)
    rows, order = pack(projection, features, with_depth)
    splats, own_order = project_and_pack(geometry, features, view, 0.01, True, with_depth, offsets)
    expected = (projection.radii, rows.packed, *order[:2])
    for result, tensor in zip((splats.radii, splats.rows.packed, *own_order[:2]), expected, strict=True):
        assert torch.equal(result.view(torch.int32)[:NUM], tensor.view(torch.int32)[:NUM])


@pytest.mark.parametrize("imagegrad", [False, True])
@pytest.mark.parametrize("with_depth", [False, True])
def test_unpacking_and_unprojecting_at_once_gives_the_same_bits(with_depth, imagegrad):
    geometry, view = geometry_and_view()
    view.viewmat.requires_grad_()
    packed, _ = project_and_pack(geometry, random_features(), view, 0.01, True, with_depth)
    v_rows = torch.randn(2, NUM, gradient_stride(packed.rows.num_channels), generator=generator())
    v_splats = unpack(packed.rows, v_rows, SIZE, True, imagegrad)
    v_geometry, *v_camera = project_bwd(geometry, view, True, packed.radii, v_splats[:4])
    result = unpack_and_unproject(geometry, view, True, packed, v_rows, True, imagegrad)
    expected = (*v_geometry, *v_camera, v_splats.features, v_splats.screen_offsets)
    for value, tensor in zip((*result[0], *result[1], *result[2:]), expected, strict=True):
        assert torch.equal(value, tensor)


def random_gradient_rows(splats: Projection, pixels: torch.Tensor, v_alpha: torch.Tensor, channels: int):
    """[1, N, stride] random gradients of features, and the moments of s = alpha v_alpha."""
    means2d, conics, opacities = (t.double() for t in (splats.means2d, splats.conics, splats.opacities))
    s = reference.log_alpha(means2d, conics, opacities, pixels).exp() * v_alpha
    rows = torch.zeros(1, len(means2d), gradient_stride(channels))
    rows[0, :, :channels] = torch.randn(len(means2d), channels, generator=generator(5))
    rows[0, :, channels : channels + NUM_MOMENTS] = reference.moments(means2d, pixels, s)
    return rows


@pytest.mark.parametrize("with_depth", [False, True])
def test_gradients_equal_the_reference(with_depth):
    splats, features = projected(), random_features()
    visible = splats.radii[:, 0] > 0
    pixels = torch.rand(40, 2, generator=generator(1)).double() * torch.tensor(SIZE)
    v_alpha = torch.randn(NUM, 40, generator=generator(2)).double()
    rows, _ = pack(splats, features, with_depth)
    gradient_rows = random_gradient_rows(splats, pixels, v_alpha, rows.num_channels)
    v_splats = unpack(rows, gradient_rows, SIZE, with_offsets=True)

    leaves = [t[visible].double().requires_grad_() for t in (splats.means2d, splats.conics, splats.opacities)]
    (reference.log_alpha(*leaves, pixels).exp() * v_alpha[visible]).sum().backward()
    for gradient, leaf in zip((v_splats.means2d, v_splats.conics, v_splats.opacities), leaves, strict=True):
        assert relative_error(gradient[visible], leaf.grad) < 1e-5
        assert not gradient[~visible].any()
    assert error(v_splats.features, gradient_rows[0, :, : features.shape[1]]) == 0
    assert (v_splats.depths is not None) == with_depth
    if with_depth:
        assert error(v_splats.depths, gradient_rows[0, :, rows.num_channels - 1]) == 0
    assert relative_error(v_splats.screen_offsets[visible], leaves[0].grad * torch.tensor(SIZE) / 2) < 1e-5
    assert not v_splats.screen_offsets[~visible].any()


def test_gradients_are_summed_over_shards():
    splats, features = projected(), random_features()
    rows, _ = pack(splats, features, False)
    shards = torch.rand(3, NUM, gradient_stride(5), generator=generator())
    v_splats = unpack(rows, shards, SIZE)
    assert error(v_splats.features, shards[:, :, :5].sum(0)) < 1e-6
    assert v_splats.screen_offsets is None


@pytest.mark.parametrize("num", [0, 1])
def test_few_gaussians_are_enough(num):
    splats, features = projected(num), random_features(num)
    rows, _ = pack(splats, features, False)
    v_splats = unpack(rows, torch.zeros(1, num, gradient_stride(5)), SIZE)
    assert rows.packed.shape == (num, 4, 4)
    assert v_splats.features.shape == (num, 5)
