"""Launches: checks of arguments, shards, profiles."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from tests.scenes import as_leaves, generator, gradients, make_camera, make_splats
from warpgs.kernels.adam import MAX_PARAMETERS, adam_begin
from warpgs.kernels.mlp import make_layer_bwd
from warpgs.kernels.projection import make_project_fwd
from warpgs.ops.rows import new_order, new_rows
from warpgs.rendering import render
from warpgs.runtime import launch as launching
from warpgs.runtime.profiling import profile


def project(means, quats, scales, opacities, near, offsets) -> torch.Tensor:
    """[N, 4] means on screen and radii."""
    camera, features, radii = make_camera(), torch.zeros(len(means), 3), torch.zeros(len(means), 2, dtype=torch.int32)
    view = (camera.viewmat, camera.K, *camera.size, None, 0.0, None)
    inputs = (means, quats, scales, opacities, *view, near, 0, offsets, features)
    rows = new_rows(features, with_depth=False)
    kernel = make_project_fwd(rows.num_features, rows.with_depth)
    launching.launch(kernel, len(means), *inputs, radii, rows.packed, *new_order(radii))
    return torch.cat([rows.packed[:, 0, :2], radii], 1)


def launch(quats, scales):
    project(torch.zeros(7, 3), quats, scales, torch.ones(7), 0.01, None)


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


def test_a_tensor_in_the_place_of_a_number_is_refused():
    with pytest.raises(TypeError, match="near is a number, got a tensor"):
        projected_radii(7, torch.tensor(0.5), None)


def test_a_wrong_number_of_arguments_is_refused():
    matrices = torch.zeros(4, 8, 8).half()
    launching.launch(make_layer_bwd(False), 1, *matrices, torch.zeros(1, 8))
    with pytest.raises(ValueError, match="shorter"):
        launching.launch(make_layer_bwd(False), 1, *matrices)


def test_an_argument_may_be_a_vector():
    """Here of addresses, whose second launch differs from the first one in them alone."""
    for expected in (torch.tensor([3.0]), torch.tensor([7.0])):
        step, none = expected - 1.0, (0,) * (MAX_PARAMETERS - 1)
        table = torch.zeros(1, 4, dtype=torch.int64), torch.zeros(1, 2, dtype=torch.int32), torch.zeros(1, 3)
        addresses = [(tensor.data_ptr(), *none) for tensor in (*[torch.zeros(5)] * 4, expected, step)]
        launching.launch(adam_begin, 1, *table, *addresses, (5, *none), (256, *none), -0.1, -0.1)
        assert step == expected
        assert table[0].tolist() == [[address[0] for address in addresses[:4]]]
        assert table[1].tolist() == [[5, 256]]
        assert table[2][0, 2] == expected


def test_leading_axes_of_a_kernel_argument_are_flattened():
    v_outputs, weight, features, v_inputs = torch.randn(4, 8, 8, generator=generator()).half()
    expected, sums = torch.zeros(2, 1, 8)
    launching.launch(make_layer_bwd(False), 1, v_outputs, weight, features, v_inputs, expected)
    assert expected.any()
    odd = features.view(4, 1, 2, 8).transpose(1, 2)  # contiguous, whatever the stride of an axis of size one is
    assert odd.is_contiguous()
    launching.launch(make_layer_bwd(False), 1, v_outputs.view(1, 8, 8), weight, odd, v_inputs, sums)
    assert torch.equal(sums, expected)


def projected_radii(num: int, near: float, offsets: torch.Tensor | None) -> torch.Tensor:
    splats = make_splats(num)
    return project(splats.means, splats.quats, splats.scales, splats.opacities, near, offsets)


def test_numbers_shapes_and_missing_arrays_may_change_from_launch_to_launch():
    expected = projected_radii(7, 0.01, None)
    assert expected[:, 2:].any()
    assert not projected_radii(7, 1000.0, None).any()
    shifted = projected_radii(7, 0.01, torch.full((7, 2), 0.1))
    assert not torch.equal(shifted, expected)
    assert projected_radii(9, 0.01, torch.full((9, 2), 0.1)).shape == (9, 4)
    assert torch.equal(projected_radii(7, 0.01, torch.full((7, 2), 0.1)), shifted)
    assert torch.equal(projected_radii(7, 0.01, None), expected)


def test_a_camera_without_gradients_may_follow_one_with_gradients():
    splats, camera = as_leaves(make_splats()), make_camera()
    found = []
    for with_gradient in (False, True, False):
        camera.viewmat.requires_grad_(with_gradient)
        found.append(torch.autograd.grad(render(splats, camera).joint.image.sum(), splats.means)[0])
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def image_and_gradients(seed: int) -> list[torch.Tensor]:
    splats = as_leaves(make_splats(80, seed=seed))
    image = render(splats, make_camera(40 + seed, 37)).joint.image
    image.square().sum().backward()
    return [image.detach(), *gradients(splats).values()]


@pytest.fixture
def all_cores(monkeypatch):
    """Small launches use all cores, too."""
    monkeypatch.setattr(launching, "MIN_SHARD", 1)


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
    forward = "sh_fwd project_fwd sort_pairs count_tiles emit_isects sort_pairs tile_ranges composite_fwd"
    assert [t.name for t in times] == f"{forward} composite_bwd project_bwd sh_bwd".split()
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


@pytest.mark.parametrize("failing", [0, 4])
def test_a_failure_on_one_core_is_raised_once_all_others_have_ended(monkeypatch, failing):
    monkeypatch.setattr(launching, "_num_cores", lambda: 3)
    ended = []

    def work(index):
        if index == failing:
            raise ValueError(f"index {index}")
        time.sleep(0.02)
        ended.append(index)

    with pytest.raises(ValueError, match=f"index {failing}"):
        launching.on_all_cores(work, 5)
    assert sorted(ended) == sorted({*range(5)} - {failing})


def test_the_calling_thread_works_too(monkeypatch):
    monkeypatch.setattr(launching, "_num_cores", lambda: 2)
    together, threads = threading.Barrier(2), set()

    def work(index):
        threads.add(threading.get_ident())
        together.wait(timeout=60)

    launching.on_all_cores(work, 2)
    assert len(threads) == 2
    assert threading.get_ident() in threads
