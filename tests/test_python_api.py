"""What notebooks pass to the Python API: numbers of NumPy, whole numbers, times."""

import numpy as np
import pytest
import torch

import warpgs
from tests import plain
from warpgs.cameras import Camera
from warpgs.config import TrainConfig
from warpgs.runs.config_file import read_config, write_config

pytestmark = pytest.mark.usefixtures("contracts_off")

POSITION, TARGET, UP = (0.0, 0.0, -4.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0)

FORMS = {
    "list": list,
    "tuple": tuple,
    "whole numbers": lambda point: [int(x) for x in point],
    "array": np.array,
    "array of whole numbers": lambda point: np.array(point).astype(np.int64),
    "half": lambda point: np.array(point, np.float16),
    "tensor": torch.tensor,
    "double tensor": lambda point: torch.tensor(point, dtype=torch.float64),
    "tensor of whole numbers": lambda point: torch.tensor(point).long(),
    "numbers of numpy": lambda point: [np.float64(x) for x in point],
}


def equal(a: Camera, b: Camera) -> bool:
    return torch.equal(a.viewmat, b.viewmat) and torch.equal(a.K, b.K) and (a.size, a.time) == (b.size, b.time)


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_a_camera_looks_from_and_at_points_of_any_type_of_numbers(form):
    usual = Camera.looking_at(*map(torch.tensor, (POSITION, TARGET, UP)), 80.0, (96, 64))
    assert usual.viewmat[2, 3] == 4.0
    assert equal(Camera.looking_at(form(POSITION), form(TARGET), form(UP), 80.0, (96, 64)), usual)


@pytest.mark.parametrize(
    "focal", [80, np.float64(80), np.float32(80), np.int64(80), torch.tensor(80.0), np.array(80.0)]
)
@pytest.mark.parametrize("size", [(96, 64), np.array([96, 64]), tuple(np.array([96, 64], np.uint16)), [96, 64]])
def test_focal_length_and_size_may_be_numbers_of_numpy(focal, size):
    camera = Camera.looking_at(POSITION, TARGET, UP, focal, size)
    assert camera.K.tolist() == [[80.0, 0.0, 48.0], [0.0, 80.0, 32.0], [0.0, 0.0, 1.0]]
    assert camera.K.dtype == torch.float32
    assert camera.size == (96, 64)
    assert {type(side) for side in camera.size} == {int}


def test_gradients_pass_through_the_position_of_a_camera():
    position = torch.tensor(POSITION, requires_grad=True)
    Camera.looking_at(position, TARGET, UP, 80.0, (96, 64)).viewmat.square().sum().backward()
    assert position.grad[2] == pytest.approx(-8.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": [0.0, 1.0]}, r"position must be three finite numbers, got \[0\.0, 1\.0\]"),
        ({"target": [0.0, np.nan, 1.0]}, "target must be three finite numbers"),
        ({"up": "up"}, "up must be three numbers, got 'up'"),
        ({"up": [[0.0], [1.0, 2.0]]}, "up must be three numbers"),
        ({"focal": 0}, "focal must be positive and finite, got 0"),
        ({"focal": np.nan}, "focal must be positive and finite, got nan"),
        ({"focal": (80, 81)}, r"focal must be a number, got \(80, 81\)"),
        ({"focal": "80"}, "focal must be a number, got '80'"),
        ({"focal": True}, "focal must be a number, got True"),
        ({"focal": None}, "focal must be a number, got None"),
        ({"focal": torch.full((9, 9), 80.0)}, r"focal must be a number, got tensor\(\["),
        ({"focal": 10**400}, "focal must be a number, got 1000"),
        ({"size": "96x64"}, r"size must be \(width, height\) \[px\], got '96x64'"),
        ({"size": "96"}, r"size must be \(width, height\) \[px\], got '96'"),
        ({"size": 96}, r"size must be \(width, height\) \[px\], got 96"),
        ({"size": (96, 64, 3)}, r"size must be \(width, height\) \[px\], got \(96, 64, 3\)"),
        ({"size": ("96", "64")}, "width must be an int, got '96'"),
        ({"time": "0.5"}, "time must be a number, got '0.5'"),
        ({"size": (96.5, 64)}, "width must be an int, got 96.5"),
        ({"size": (96, -1)}, "height must be between 0 and 32768 pixels, got -1"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_in_one_line(change, message):
    values = {"position": POSITION, "target": TARGET, "up": UP, "focal": 80.0, "size": (96, 64), **change}
    with pytest.raises(ValueError, match=f"^{message}") as raised:
        Camera.looking_at(**values)
    assert "\n" not in str(raised.value)


def test_a_config_may_hold_numbers_of_numpy(tmp_path):
    numbers = {"seed": np.int64(5), "max_alpha": np.float64(0.5), "depth": np.bool_(False), "factor": np.int32(2)}
    write_config(tmp_path, plain.plan(TrainConfig(**numbers)))
    config = read_config(tmp_path)
    assert (config.seed, config.max_alpha, config.depth, config.factor) == (5, 0.5, False, 2)


@pytest.fixture(scope="module")
def scene(finished_run):
    return warpgs.open_run(finished_run, "cpu")


@pytest.mark.parametrize("time", [float("nan"), float("inf"), -1.0, -0.001, 1.001, 2, np.float64(2.0), np.nan])
def test_a_time_at_which_nothing_was_trained_is_refused(scene, time):
    camera = Camera.looking_at(POSITION, TARGET, UP, 20.0, (24, 16), time)
    message = rf"^time must be in \[0, 1\], from the first frame to the last, got {float(time)}$"
    calls = (lambda: scene.render(camera), lambda: scene.render(camera, time=time), lambda: scene.splats(time))
    for call in (*calls, lambda: scene.play(camera)):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize("time", ["0.5", True, (0.5,), np.array([0.5, 0.6]), torch.zeros(0), 1j])
def test_a_time_that_is_not_a_number_is_refused_in_one_line(scene, time):
    camera = Camera.looking_at(POSITION, TARGET, UP, 20.0, (24, 16))
    for call in (lambda: scene.render(camera, time=time), lambda: scene.splats(time)):
        with pytest.raises(ValueError, match=r"^time must be a number, got ") as raised:
            call()
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("time", [np.array([0.25]), torch.tensor([[0.25]]), torch.tensor(0.25, dtype=torch.float64)])
def test_a_time_may_be_an_array_or_tensor_of_one_element(scene, time, recwarn):
    camera = Camera.looking_at(POSITION, TARGET, UP, 20.0, (24, 16))
    at = scene.render(camera, time=0.25).joint.image
    assert torch.equal(scene.render(camera, time=time).joint.image, at)
    assert torch.equal(scene.render(Camera.looking_at(POSITION, TARGET, UP, 20.0, (24, 16), time)).joint.image, at)
    assert not recwarn.list


def test_a_scene_is_rendered_through_one_camera(scene):
    camera = Camera.looking_at(POSITION, TARGET, UP, 20.0, (24, 16))
    for call in (scene.render, scene.play):
        with pytest.raises(TypeError, match=r"^camera must be one Camera, got list"):
            call([camera])


@pytest.mark.parametrize("path", [3, None, 0.5, ["runs"]])
def test_a_run_and_a_capture_are_opened_by_paths(path):
    for opened in (warpgs.open_run, warpgs.load_capture):
        with pytest.raises(ValueError, match=r"^a (run|capture) is opened by the path of its folder, got "):
            opened(path)


def test_a_background_of_plain_numbers_is_told_the_tensor_that_is_expected(scene):
    camera = Camera.looking_at(POSITION, TARGET, UP, 20.0, (24, 16))
    with pytest.raises(ValueError, match=r"^background must be a torch tensor of shape \[3\], got tuple$"):
        warpgs.render(scene.splats(0.5), camera, background=(1, 1, 1))


@pytest.mark.parametrize("time", [0, 1, np.float32(0.1) * 10, 1.0 + 1e-9, -1e-9, torch.tensor(1.0), np.int64(1)])
def test_the_first_and_the_last_time_may_be_rounded_and_of_any_type(scene, time):
    camera = Camera.looking_at(POSITION, TARGET, UP, 20.0, (24, 16))
    at = scene.render(camera, time=round(float(time))).joint.image
    assert torch.allclose(scene.render(camera, time=time).joint.image, at, atol=1e-4)
