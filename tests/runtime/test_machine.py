"""What is said of the device that kernels are compiled for."""

from types import SimpleNamespace

import pytest
import torch
import warp as wp

from tests.scenes import make_camera, make_splats
from warpgs.kernels.adam import adam_step
from warpgs.kernels.tiles import tile_ranges
from warpgs.rendering import render
from warpgs.runtime import kernel_cache, machine

GPU = SimpleNamespace(is_cpu=False, get_cuda_compile_arch=lambda: 86)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of kernels."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    return tmp_path


def test_a_gpu_is_named_with_its_compute_capability(monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA GeForce RTX 3060")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (8, 6))
    assert machine.described("cuda") == "cuda (NVIDIA GeForce RTX 3060, compute capability 8.6)"
    assert machine.described("cpu") == "cpu"


def test_kernels_are_compiled_at_the_first_start_and_then_kept(cache):
    assert machine.kernels_note("cpu") == "kernels for it are compiled at the first start, which takes about a minute"
    folder = cache / tile_ranges.module.get_module_identifier(1)
    folder.mkdir()
    (folder / "tiles.cpu12345678.o").touch()
    assert machine.kernels_note("cpu") == f"kernels for it are in {cache}"


def test_an_image_on_a_cpu_leaves_the_kernels_that_are_looked_for():
    render(make_splats(8).to("cpu"), make_camera().to("cpu"))
    assert machine.kernels_note("cpu") == f"kernels for it are in {wp.config.kernel_cache_dir}"


@pytest.mark.usefixtures("contracts_off")
@pytest.mark.parametrize(
    ("name", "is_compiled"), [("adam.sm86.cubin", True), ("adam.sm86a.ptx", True), ("adam.sm860.ptx", False)]
)
def test_kernels_of_another_compute_capability_are_not_those_of_this_gpu(cache, name, is_compiled):
    folder = cache / adam_step.module.get_module_identifier(256)
    folder.mkdir()
    (folder / "adam.sm75.cubin").touch()
    assert not kernel_cache.is_compiled(adam_step, GPU, 256)
    (folder / name).touch()
    assert kernel_cache.is_compiled(adam_step, GPU, 256) == is_compiled


def test_compilation_for_another_device_is_announced_although_the_folder_is_there(cache, monkeypatch):
    folder, said = cache / adam_step.module.get_module_identifier(1), []
    folder.mkdir()
    (folder / "adam.sm75.cubin").touch()
    monkeypatch.setattr(kernel_cache, "_loaded", set())
    monkeypatch.setattr(kernel_cache, "_announce_compilation", lambda: said.append(1))
    monkeypatch.setattr(wp, "load_module", lambda *_, **__: None)
    kernel_cache.load(adam_step, wp.get_device("cpu"), 256)
    assert said == [1]
