"""Every kernel compiles for CUDA, even on a machine without a GPU."""

import importlib

import pytest
import warp as wp

from warpgs.kernels.compositing_bwd import make_composite_bwd
from warpgs.kernels.compositing_fwd import make_composite_fwd
from warpgs.kernels.encoding import make_encode
from warpgs.kernels.lenses import LENSES
from warpgs.kernels.mlp import make_layer_bwd
from warpgs.kernels.projection import make_project_bwd, make_project_fwd
from warpgs.kernels.sort import make_sort_pairs
from warpgs.kernels.ssim import make_ssim_bwd, make_ssim_fwd
from warpgs.ops.compositing import CUDA_PIXELS, SMALL_IMAGE_CUDA_PIXELS

ARCHS = [75, 90]
"""Compute capabilities, times ten: the oldest that Warp supports, and one with all instructions that kernels use."""


def assert_compiles(module, folder):
    for arch in ARCHS:
        wp.compile_aot_module(module, arch=arch, module_dir=folder / str(arch), use_ptx=True)
        (ptx,) = (folder / str(arch)).glob("*.ptx")
        assert f".target sm_{arch}" in ptx.read_text()


MODULES = ["activation", "adam", "depth_error", "mlp", "raytrace", "sh", "tiles"]


@pytest.mark.parametrize("name", MODULES)
def test_a_module_of_kernels_compiles(name, tmp_path):
    assert_compiles(importlib.import_module(f"warpgs.kernels.{name}"), tmp_path)


@pytest.mark.parametrize("num_passes", [2, 4])
def test_the_sort_compiles(num_passes, tmp_path):
    assert_compiles(make_sort_pairs(num_passes).module, tmp_path)


def test_the_backward_pass_of_a_layer_compiles(tmp_path):
    assert_compiles(make_layer_bwd(True).module, tmp_path)


@pytest.mark.parametrize("half", [False, True])
def test_the_encoding_compiles(half, tmp_path):
    assert_compiles(make_encode(half).module, tmp_path)


@pytest.mark.parametrize("make", [make_project_fwd, make_project_bwd])
@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("shutter", [(False,), (True,), (True, True)])
def test_the_projection_compiles(make, with_depth, lens, shutter, tmp_path):
    assert_compiles(make(3, with_depth, lens, *shutter).module, tmp_path)


@pytest.mark.parametrize("make", [make_ssim_fwd, make_ssim_bwd])
@pytest.mark.parametrize("with_mask", [False, True])
def test_ssim_compiles(make, with_mask, tmp_path):
    assert_compiles(make(with_mask).module, tmp_path)


@pytest.mark.parametrize("make", [make_composite_fwd, make_composite_bwd])
@pytest.mark.parametrize("variant", [False, True])
@pytest.mark.parametrize("images", [1, 3])
@pytest.mark.parametrize("pixels", [CUDA_PIXELS, SMALL_IMAGE_CUDA_PIXELS])
def test_compositing_compiles(make, variant, images, pixels, tmp_path):
    assert_compiles(make(3, variant, images, pixels, variant).module, tmp_path)


@pytest.mark.parametrize("make", [make_composite_fwd, make_composite_bwd])
@pytest.mark.parametrize("channels", [1, 9])
def test_compositing_compiles_for_other_channels(make, channels, tmp_path):
    assert_compiles(make(channels, False, 1, CUDA_PIXELS, False).module, tmp_path)


@pytest.mark.parametrize("pixels", [CUDA_PIXELS, SMALL_IMAGE_CUDA_PIXELS])
def test_median_depth_compiles(pixels, tmp_path):
    assert_compiles(make_composite_fwd(3, True, 1, pixels, False, True).module, tmp_path)
