"""The bridge between torch and Warp."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from tests.scenes import as_leaves, float_tensors, gradients, make_camera, make_splats
from warpgs.kernels.covariance import covariance as kernel
from warpgs.rendering import render
from warpgs.runtime import tape
from warpgs.runtime.profiling import profile
from warpgs.runtime.tape import OpContext


def launch(quats, scales):
    OpContext(torch.device("cpu"), []).launch(kernel, 7, quats, scales, torch.zeros(7, 3, 3))


@pytest.mark.parametrize(
    "quats",
    [torch.ones(7, 4, dtype=torch.float64), torch.ones(7, 4, dtype=torch.int32), torch.ones(7, 3), torch.ones(7)],
)
def test_a_kernel_argument_of_a_wrong_type_is_refused(quats):
    with pytest.raises(TypeError, match="quats is a 1-d array of vec4"):
        launch(quats, torch.ones(7, 3))


def test_a_kernel_argument_that_is_not_contiguous_is_refused():
    with pytest.raises(TypeError, match="scales must be contiguous"):
        launch(torch.ones(7, 4), torch.ones(3, 7).T)


def image_and_gradients(seed: int) -> list[torch.Tensor]:
    splats = as_leaves(make_splats(80, seed=seed))
    image = render(splats, make_camera(40 + seed, 37)).joint.image
    image.square().sum().backward()
    return [image.detach(), *gradients(splats).values()]


@pytest.fixture
def all_cores(monkeypatch):
    """Small launches use all cores, too."""
    monkeypatch.setattr(tape, "MIN_SHARD", 1)


def test_concurrent_threads_render_the_same_as_alone(all_cores):
    seeds = list(range(4)) * 8
    alone = [image_and_gradients(seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(image_and_gradients, seeds))
    for seed, values in zip(seeds, together, strict=True):
        for value, expected in zip(values, alone[seed], strict=True):
            assert torch.equal(value, expected)


def test_one_core_renders_the_same_as_two(all_cores):
    cores = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        single = image_and_gradients(0)
        torch.set_num_threads(2)
        double = image_and_gradients(0)
    finally:
        torch.set_num_threads(cores)
    assert torch.equal(single[0], double[0])
    for value, expected in zip(single[1:], double[1:], strict=True):
        assert (value - expected).norm() < 1e-6 * expected.norm()


def test_a_profile_lists_the_kernels_of_forward_and_backward():
    with profile() as taken:
        image_and_gradients(0)
    times = taken.times()
    names = [t.name for t in times]
    forward = ["project_fwd", "pack", "sort_pairs", "count_tiles", "emit_isects", "sort_pairs", "tile_ranges"]
    assert names == [
        *forward,
        "sh_fwd",
        "pack_features",
        "composite_fwd",
        "composite_bwd",
        "unpack",
        "sh_bwd",
        "project_bwd",
    ]
    assert all(t.duration_ms > 0 for t in times)
    assert [t.start_ms for t in times] == sorted(t.start_ms for t in times)


def test_nothing_is_listed_after_the_end_of_a_profile():
    with profile() as taken:
        pass
    image_and_gradients(0)
    assert taken.times() == []


def test_two_profiles_at_once_are_refused():
    with profile(), pytest.raises(RuntimeError, match="another profile is active"), profile():
        pass


@pytest.mark.parametrize("name_with_gradient", ["means", "quats", "scales", "opacities", "sh"])
def test_gradients_flow_only_to_tensors_that_require_them(name_with_gradient):
    everything, one = as_leaves(make_splats()), as_leaves(make_splats())
    for name, tensor in float_tensors(one).items():
        tensor.requires_grad_(name == name_with_gradient)
    for splats in (everything, one):
        render(splats, make_camera()).joint.image.sum().backward()
    for name, gradient in gradients(one).items():
        if name == name_with_gradient:
            assert torch.equal(gradient, gradients(everything)[name])
        else:
            assert gradient is None


def test_without_inputs_that_require_gradients_nothing_is_recorded():
    assert not render(make_splats(), make_camera()).joint.image.requires_grad
