import pytest
import torch

from tests.reference.raytrace import raytrace as reference
from warpgs.synthetic import studio
from warpgs.synthetic.bodies import as_tensors, even_samples
from warpgs.synthetic.raytrace import raytrace
from warpgs.synthetic.room import BuiltinScene, _camera, _lamp, _moving_bodies, _static_bodies

CPU = torch.device("cpu")
SCENE = BuiltinScene(width=37, height=21, num_samples=3)


def inputs(time=0.3):
    camera = _camera(time, SCENE, 0.1)
    bodies = as_tensors([*_static_bodies(), *_moving_bodies(time)], CPU)
    return bodies, _lamp(CPU), even_samples(3, CPU), camera.viewmat, camera.K, camera.size


def studio_inputs(time=0.65):
    size = studio.StudioSize(width=37, height=21)
    camera = studio.camera_at(time, 0.1, size)
    bodies = as_tensors([*studio.static_bodies(), *studio.moving_bodies(time)], CPU)
    lamp = torch.tensor([[1.3, -1.0, 4.1], [0.45, 0.0, 0.0], [0.0, 0.45, 0.0]])
    return bodies, lamp, even_samples(3, CPU), camera.viewmat, camera.K, camera.size


@pytest.fixture(scope="module", params=[inputs, studio_inputs])
def pair(request):
    bodies, *rest, size = request.param()
    scene = [t.double() if t.is_floating_point() else t for t in bodies]
    return raytrace(bodies, *rest, size), reference(scene, *(t.double() for t in rest), size)


def test_depth_equals_the_reference(pair):
    ours, (_, depth, body) = pair
    same = ours.bodies == body
    assert same.float().mean() > 0.99  # rays that graze an edge may fall on either side
    assert torch.allclose(ours.depth[same].double(), depth[same], rtol=2e-3)
    assert (ours.depth[same].double() / depth[same] - 1).abs().median() < 1e-6


def test_colours_equal_the_reference(pair):
    ours, (image, _, _) = pair
    error = (ours.image.double() - image).abs().amax(-1)
    assert error.median() < 1e-5
    assert (error > 1e-2).float().mean() < 0.02  # samples that graze an edge or a shadow's border


def test_every_pixel_inside_a_closed_cube_hits_a_body(pair):
    assert bool((pair[0].bodies >= 0).all())


def test_a_lamp_behind_the_walls_leaves_only_ambient_light():
    bodies, lamp, *rest = inputs()
    lit, dark = (
        raytrace(bodies, lamp, *rest),
        raytrace(bodies, lamp + torch.tensor([[0.0, 0.0, 50.0]] + 2 * [[0.0] * 3]), *rest),
    )
    assert float(dark.image.max()) < 0.42 * 0.95
    assert float(lit.image.mean()) > 1.3 * float(dark.image.mean())


def test_wrong_shapes_are_refused_by_name(contracts_off):
    bodies, lamp, *rest = inputs()
    with pytest.raises(ValueError, match="lamp"):
        raytrace(bodies, lamp[:2], *rest)
    with pytest.raises(ValueError, match="materials"):
        raytrace(bodies._replace(materials=bodies.materials[:, :2].contiguous()), lamp, *rest)
    with pytest.raises(ValueError, match="frequencies"):
        raytrace(bodies._replace(frequencies=bodies.frequencies[:1]), lamp, *rest)


def test_only_mirrors_show_what_is_in_front_of_them():
    bodies, *rest = studio_inputs()
    plain = raytrace(bodies._replace(materials=bodies.materials * torch.tensor([1.0, 0.0, 1.0])), *rest)
    change = (raytrace(bodies, *rest).image - plain.image).abs().amax(-1)
    is_mirror = bodies.materials[plain.bodies.long(), 1] > 0
    assert float(change[is_mirror].median()) > 0.01
    near = torch.nn.functional.max_pool2d(is_mirror[None, None].float(), 3, 1, 1)[0, 0] > 0
    assert float(change[~near].max()) == 0.0
