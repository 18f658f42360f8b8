"""Exported files as other programs read them; skipped where these are not installed.

``npm install -g @playcanvas/splat-transform`` and ``pip install fourdgs``. Version 2 of splat-transform reads SPZ with
Niantic's decoder, with y up as specified; version 3 leaves the axes as they are in the file, as if y were down.
"""

import shutil
import subprocess

import numpy as np
import pytest

from tests.export import scenes
from warpgs.export import orientation
from warpgs.export.cloud import sigmoid
from warpgs.export.compressed import write_compressed
from warpgs.export.gltf import write_glb
from warpgs.export.sog import write_sog
from warpgs.export.spz import write_spz, write_spz_gzip
from warpgs.export.standard import read_standard, write_standard
from warpgs.model.gaussians import SH_C0
from warpgs.video.camera_paths import UP

SPLAT_TRANSFORM = shutil.which("splat-transform")


FILES = {
    "a.ply": (write_standard, False),
    "a.compressed.ply": (write_compressed, False),
    "a.sog": (write_sog, False),
    "a.spz": (write_spz, True),
    "a.v3.spz": (write_spz_gzip, True),
}
"""Functions that write a file, and whether y is up in it."""


@pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="splat-transform is not installed")
@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_splat_transform_reads_the_scene(tmp_path, name, degree):
    pytest.importorskip("zstandard") if name == "a.spz" else None
    cloud, (write, y_up) = scenes.cloud(300, degree), FILES[name]
    version = subprocess.run([str(SPLAT_TRANSFORM), "--version"], capture_output=True, text=True, check=True)
    y_up = y_up and " v2." in version.stdout + version.stderr
    write(tmp_path / name, orientation.rotated(cloud, orientation.upright(UP, y_up)))
    command = [str(SPLAT_TRANSFORM), str(tmp_path / name), str(tmp_path / "back.ply")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    back = read_standard(tmp_path / "back.ply")
    assert back.sh.shape == cloud.sh.shape
    assert scenes.image(cloud).std() > 0.1
    assert scenes.psnr(scenes.image(back), scenes.image(cloud)) > 38


@pytest.mark.parametrize("degree", [0, 2])
def test_fourdgs_reads_gltf(tmp_path, degree):
    fourdgs = pytest.importorskip("fourdgs", reason="fourdgs is not installed (extra 'export')")
    cloud = scenes.cloud(40, degree)
    write_glb(tmp_path / "a.glb", cloud)
    read = fourdgs.from_gltf(str(tmp_path / "a.glb"))
    assert read.metadata["coordinate_system"] == "y-up-right-handed"
    assert read.metadata["color_space"] == "srgb-rec709-display"
    assert (read.gaussians.positions == cloud.means).all()
    assert read.gaussians.scales == pytest.approx(np.exp(cloud.log_scales), rel=1e-6)
    assert read.gaussians.rotations == pytest.approx(np.roll(cloud.quats, -1, 1), abs=1e-6)
    color = np.concatenate([0.5 + SH_C0 * cloud.sh[:, 0], sigmoid(cloud.logit_opacities)[:, None]], 1)
    assert read.gaussians.colors == pytest.approx(np.clip(color, 0, 1), abs=1e-5)
    assert read.gaussians.sh_degree == degree
