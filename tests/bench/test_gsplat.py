"""Cross-check against the torch reference of gsplat, which runs on CPU."""

import warnings

import pytest

from tests.ops.alone import pack, project, spherical_harmonics
from tests.reference.covariance import covariance
from tests.scenes import error, make_camera, make_splats, relative_error
from warpgs.ops import tiles
from warpgs.ops.projection import Geometry, View

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of gsplat itself, on import
    theirs = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed (extra 'gsplat')")

CAMERA = make_camera(80, 60)
VIEW = View(CAMERA.viewmat, CAMERA.K, *CAMERA.size)


def geometry(splats):
    return Geometry(splats.means, splats.quats, splats.scales, splats.opacities)


def splats_and_theirs():
    splats = make_splats(200)
    ours = project(geometry(splats), VIEW)
    expected = theirs._fully_fused_projection(
        splats.means.double(),
        covariance(splats.quats.double(), splats.scales.double()),
        CAMERA.viewmat.double()[None],
        CAMERA.K.double()[None],
        *CAMERA.size,
        calc_compensations=True,
    )
    return splats, ours, [value[0] for value in expected]


def test_projection_agrees():
    splats, ours, (radii, means2d, depths, conics, compensations) = splats_and_theirs()
    seen = (ours.radii > 0).all(-1)
    assert 50 < seen.sum() < 200
    assert (radii[seen] > 0).all()  # gsplat uses larger boxes, so at least these are visible
    assert relative_error(ours.means2d[seen], means2d[seen]) < 1e-6
    assert relative_error(ours.depths[seen], depths[seen]) < 1e-6
    assert relative_error(ours.conics[seen], conics[seen]) < 1e-6
    antialiased = project(geometry(splats), VIEW, antialias=True)
    kept = (antialiased.radii > 0).all(-1)
    assert relative_error(antialiased.opacities[kept], (splats.opacities * compensations)[kept]) < 1e-6


@pytest.mark.parametrize("degree", range(4))
def test_spherical_harmonics_agree(degree):
    splats = make_splats()
    viewmat = CAMERA.viewmat.double()
    directions = splats.means.double() + viewmat[:3, :3].T @ viewmat[:3, 3]
    expected = (theirs._spherical_harmonics(degree, directions, splats.sh.double()) + 0.5).clamp(min=0)
    assert error(spherical_harmonics(splats.means, splats.sh, CAMERA.viewmat, degree=degree), expected) < 2e-6


def test_tiles_are_those_of_the_box_that_the_ellipse_intersects():
    splats, ours, _ = splats_and_theirs()
    result = tiles.bin_splats(*pack(ours, splats.means, with_depth=False), CAMERA.size)
    columns, rows = tiles.num_tiles(*CAMERA.size)
    _, isect_ids, gaussians = theirs._isect_tiles(
        ours.means2d[None], ours.radii[None], ours.depths[None], 16, columns, rows
    )
    boxes = [gaussians[(isect_ids >> 32) == tile].tolist() for tile in range(columns * rows)]
    isects = result.gaussian_from_isect.tolist()
    listed = [isects[begin:end] for begin, end in result.ranges.tolist()]
    for exact, box in zip(listed, boxes, strict=True):
        assert exact == [g for g in box if g in set(exact)]
    assert 0.4 * sum(map(len, boxes)) < sum(map(len, listed)) < sum(map(len, boxes))
