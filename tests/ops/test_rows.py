"""Splat rows: packing and its backward pass, as parts of the projection."""

import pytest
import torch

from tests.ops.alone import project
from tests.reference import rows as reference
from tests.reference.projection import project as reference_projection
from tests.scenes import GEOMETRY, HEIGHT, WIDTH, error, generator, make_camera, make_splats, relative_error
from warpgs.kernels.constants import CULLED_DEPTH, CULLED_LOG2_OPACITY
from warpgs.kernels.rows import NUM_MOMENTS, gradient_stride
from warpgs.ops.projection import Geometry, View, project_bwd, project_fwd

NUM = 150
SIZE = (WIDTH, HEIGHT)
CHANNELS = 5


def geometry_and_view(num=NUM) -> tuple[Geometry, View]:
    splats, camera = make_splats(num), make_camera()
    return Geometry(*(getattr(splats, name) for name in GEOMETRY)), View(camera.viewmat, camera.K, *SIZE)


def random_features(num=NUM, channels=CHANNELS) -> torch.Tensor:
    return torch.rand(num, channels, generator=generator())


def pack(features, with_depth=False):
    geometry, view = geometry_and_view(len(features))
    return project_fwd(geometry, features, view, 0.01, False, with_depth)


@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4, 5])
def test_rows_of_visible_splats_equal_the_reference(channels, with_depth):
    geometry, view = geometry_and_view()
    features = random_features(channels=channels)
    doubles = Geometry(*(t.double() for t in geometry)), View(view.viewmat.double(), view.K.double(), *SIZE)
    means2d, conics, depths, opacities, visible = reference_projection(*doubles)
    assert 10 < visible.sum() < NUM
    rows, radii, _ = pack(features, with_depth)
    assert torch.equal(radii.gt(0).all(1), visible)
    channels = torch.cat([features, depths[:, None]], 1) if with_depth else features
    expected = reference.pack(means2d, conics, opacities, channels)[visible]
    packed = rows.packed[visible].flatten(1)
    for columns in (slice(2), slice(2, 5), slice(5, 6), slice(8, None)):
        assert relative_error(packed[:, columns], expected[:, columns]) < 1e-6
    assert not packed[:, 6:8].any()


def test_culled_splats_are_marked_and_sorted_last():
    splats = project(*geometry_and_view())
    visible = splats.radii[:, 0] > 0
    rows, _, order = pack(random_features())
    assert torch.equal(rows.packed[:, 1, 1] == CULLED_LOG2_OPACITY, ~visible)
    assert (order.keys[:NUM][~visible] == CULLED_DEPTH).all()
    depths = torch.where(visible, splats.depths, torch.inf)
    assert torch.equal(order.keys[:NUM].argsort(stable=True), depths.argsort(stable=True))
    assert torch.equal(order.gaussian_from_rank[:NUM], torch.arange(NUM, dtype=torch.int32))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_splat_with_a_feature_that_is_not_finite_is_culled(value):
    features = random_features()
    radii_before = pack(features)[1]
    features[::3, 2] = value
    rows, radii, order = pack(features)
    culled = rows.packed[:, 1, 1] == CULLED_LOG2_OPACITY
    assert culled[::3].all()
    assert (order.keys[:NUM][::3] == CULLED_DEPTH).all()
    assert torch.equal(culled[1::3], radii_before[1::3, 0] == 0)
    assert torch.equal(culled, radii[:, 0] == 0)
    assert torch.equal(culled, radii[:, 1] == 0)


@pytest.mark.parametrize(("length", "is_culled"), [(10.0, False), (100.0, False), (3000.0, True)])
def test_a_splat_whose_conic_is_singular_in_single_precision_is_culled(length, is_culled):
    diagonal = torch.tensor([[1.0, 0.0, 0.0, 0.4142]])  # turned by 45° around z
    needle = torch.tensor([[length, 1e-3, 1e-3]])
    geometry = Geometry(torch.tensor([[0.0, 0.0, 3.0]]), diagonal, needle, torch.tensor([0.9]))
    view = View(torch.eye(4), geometry_and_view()[1].K, *SIZE)
    rows, radii, order = project_fwd(geometry, torch.rand(1, 3), view, 0.01, False, False)
    assert (rows.packed[0, 1, 1] == CULLED_LOG2_OPACITY) == is_culled
    assert radii.eq(0).all() == is_culled
    assert (order.keys[0] == CULLED_DEPTH) == is_culled
    if not is_culled:  # the determinant keeps its digits
        doubles = Geometry(*(t.double() for t in geometry)), View(torch.eye(4).double(), view.K.double(), *SIZE)
        assert relative_error(reference.unpack(rows.packed)[1], reference_projection(*doubles)[1]) < 1e-3


def random_gradient_rows(pixels: torch.Tensor, v_alpha: torch.Tensor, channels: int) -> torch.Tensor:
    """[1, N, stride] random gradients of channels, and the moments of s = alpha v_alpha."""
    splats = project(*geometry_and_view())
    means2d, conics, opacities = (t.double() for t in (splats.means2d, splats.conics, splats.opacities))
    s = reference.log_alpha(means2d, conics, opacities, pixels).exp() * v_alpha
    rows = torch.randn(1, len(means2d), gradient_stride(channels), generator=generator(5))
    rows[0, :, channels : channels + NUM_MOMENTS] = reference.moments(means2d, pixels, s)
    return rows


@pytest.mark.parametrize("with_depth", [False, True])
def test_gradients_equal_the_reference(with_depth):
    geometry, view = geometry_and_view()
    pixels = torch.rand(40, 2, generator=generator(1)).double() * torch.tensor(SIZE)
    v_alpha = torch.randn(NUM, 40, generator=generator(2)).double()
    rows, radii, _ = pack(random_features(), with_depth)
    v_rows = random_gradient_rows(pixels, v_alpha, rows.num_channels)
    v = project_bwd(geometry, view, False, rows, v_rows, with_offsets=True)

    leaves = [t.double().requires_grad_() for t in geometry]
    doubles = View(view.viewmat.double(), view.K.double(), *SIZE)
    means2d, conics, depths, opacities, visible = reference_projection(Geometry(*leaves), doubles)
    assert torch.equal(visible, radii[:, 0] > 0)
    means2d.retain_grad()
    inner = reference.log_alpha(*(t[visible] for t in (means2d, conics, opacities)), pixels).exp() * v_alpha[visible]
    depth_term = (depths * v_rows[0, :, CHANNELS])[visible].sum() if with_depth else 0.0
    (inner.sum() + depth_term).backward()
    for gradient, leaf in zip(v.geometry, leaves, strict=True):
        assert relative_error(gradient[visible], leaf.grad[visible]) < 1e-5
        assert not gradient[~visible].any()
    assert error(v.features, v_rows[0, :, :CHANNELS]) == 0
    assert relative_error(v.screen_offsets[visible], means2d.grad[visible] * torch.tensor(SIZE) / 2) < 1e-5
    assert not v.screen_offsets[~visible].any()
    assert v.viewmat is v.K is None


def test_offsets_on_screen_get_the_sums_of_absolute_values_on_request():
    geometry, view = geometry_and_view()
    rows, radii, _ = pack(random_features())
    v_rows = torch.randn(1, NUM, gradient_stride(CHANNELS), generator=generator())
    v = project_bwd(geometry, view, False, rows, v_rows, with_offsets=True, absgrad=True)
    expected = v_rows[0, :, CHANNELS + NUM_MOMENTS :][:, :2] * torch.tensor(SIZE) / 2
    assert relative_error(v.screen_offsets, torch.where(radii > 0, expected, 0.0)) < 1e-6


def test_gradients_are_summed_over_shards():
    geometry, view = geometry_and_view()
    rows, *_ = pack(random_features())
    shards = torch.rand(3, NUM, gradient_stride(CHANNELS), generator=generator())
    v, v_sum = (project_bwd(geometry, view, False, rows, t) for t in (shards, shards.sum(0, keepdim=True)))
    for value, expected in zip((*v.geometry, v.features), (*v_sum.geometry, v_sum.features), strict=True):
        assert relative_error(value, expected) < 1e-6
    assert v.screen_offsets is None


@pytest.mark.parametrize("num", [0, 1])
def test_few_gaussians_are_enough(num):
    rows, radii, _ = pack(random_features(num))
    v = project_bwd(*geometry_and_view(num), False, rows, torch.zeros(1, num, gradient_stride(CHANNELS)))
    assert rows.packed.shape == (num, 4, 4)
    assert radii.shape == (num, 2)
    assert v.features.shape == (num, CHANNELS)
