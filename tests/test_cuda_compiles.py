"""Every kernel compiles for CUDA, even on a machine without a GPU."""

import importlib
import re
from pathlib import Path

import pytest
import warp as wp

from warpgs.kernels import ssim
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

CARDS = {"RTX 20": 75, "RTX 30": 86, "RTX 40": 89, "RTX 50": 120}
"""Compute capabilities, times ten, of series of cards; docs/start.md has the same."""


def assert_compiles(module, folder, archs=ARCHS):
    for arch in archs:
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


SHUTTERS = [(lens, (is_rolling,)) for lens in LENSES for is_rolling in (False, True)]
SHUTTERS += [("pinhole", (True, True))]  # read by columns: of every lens, only the axis of the image is another


@pytest.mark.parametrize("make", [make_project_fwd, make_project_bwd])
@pytest.mark.parametrize(("lens", "shutter"), SHUTTERS)
def test_the_projection_compiles(make, lens, shutter, tmp_path):
    assert_compiles(make(3, True, lens, *shutter).module, tmp_path, ARCHS[:1])  # its code is the same for all


@pytest.mark.parametrize("make", [make_project_fwd, make_project_bwd])
def test_the_projection_without_depth_compiles(make, tmp_path):
    assert_compiles(make(3, False).module, tmp_path)


@pytest.mark.parametrize("make", [make_ssim_fwd, make_ssim_bwd])
@pytest.mark.parametrize("with_mask", [False, True])
def test_ssim_compiles(make, with_mask, tmp_path):
    assert_compiles(make(with_mask).module, tmp_path)


@pytest.mark.parametrize("make", [make_ssim_fwd, make_ssim_bwd])
def test_threads_of_ssim_leave_registers_for_more_blocks(make, tmp_path):
    wp.compile_aot_module(make(True).module, arch=90, module_dir=tmp_path, use_ptx=True)
    (ptx,) = tmp_path.glob("*.ptx")
    limits = re.findall(r"\.(maxntid|minnctapersm) (\d+)", ptx.read_text())
    assert dict(limits) == {"maxntid": str(ssim.BLOCK_DIM), "minnctapersm": str(ssim.MIN_BLOCKS)}


@pytest.mark.parametrize("make", [make_composite_fwd, make_composite_bwd])
@pytest.mark.parametrize("variant", [False, True])
@pytest.mark.parametrize("images", [1, 3])
@pytest.mark.parametrize("pixels", [CUDA_PIXELS, SMALL_IMAGE_CUDA_PIXELS])
def test_compositing_compiles(make, variant, images, pixels, tmp_path):
    archs = ARCHS if images == 3 and pixels == CUDA_PIXELS else ARCHS[:1]  # newer instructions are the same in all
    assert_compiles(make(3, variant, images, pixels, variant).module, tmp_path, archs)


@pytest.mark.parametrize("make", [make_composite_fwd, make_composite_bwd])
@pytest.mark.parametrize("channels", [1, 9])
def test_compositing_compiles_for_other_channels(make, channels, tmp_path):
    assert_compiles(make(channels, False, 1, CUDA_PIXELS, False).module, tmp_path)


@pytest.mark.parametrize("pixels", [CUDA_PIXELS, SMALL_IMAGE_CUDA_PIXELS])
def test_median_depth_compiles(pixels, tmp_path):
    assert_compiles(make_composite_fwd(3, True, 1, pixels, False, True).module, tmp_path)


@pytest.mark.parametrize("card", CARDS)
def test_compositing_and_products_in_half_precision_compile_for_cards(card, tmp_path):
    modules = make_composite_bwd(3, True, 3, CUDA_PIXELS, True).module, make_layer_bwd(True).module
    for k, module in enumerate(modules):
        assert_compiles(module, tmp_path / str(k), [CARDS[card]])


@pytest.mark.parametrize("card", CARDS)
def test_the_documentation_has_the_capabilities_of_cards(card):
    page = (Path(__file__).parents[1] / "docs/start.md").read_text()
    assert f"| {card}" in page
    assert f"| {CARDS[card] / 10} |" in page
