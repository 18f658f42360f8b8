"""Exports of scenes under a sky: pages and OpenUSD have it, a line says that other files lack it."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch

from tests.export import scenes
from tests.export.browser import Browser, executable
from tests.export.test_moving import job
from tests.export.test_page import start
from tests.model.test_dome import smooth, smooth_dome
from warpgs.cameras import Camera
from warpgs.export import usd
from warpgs.export.baking import bake
from warpgs.export.clouds import Clouds
from warpgs.export.export_run import export_run
from warpgs.export.job import Job
from warpgs.export.options import Export
from warpgs.export.page import write_page
from warpgs.rendering import render
from warpgs.runs.trained import TrainedScene
from warpgs.video.camera_paths import evenly_spaced
from warpgs.video.orientation import AXES, upright
from warpgs.visualize.images import to_bytes

SIZE = (320, 240)


@pytest.fixture(scope="module")
def under_sky():
    plain = scenes.trained_scene()
    plain.scene.dome = smooth_dome().requires_grad_(False)
    return Clouds(TrainedScene(plain.scene, dataclasses.replace(plain.config, background="sky"), plain.metadata))


@pytest.mark.skipif(executable() is None, reason="the test needs Chromium")
def test_a_page_shows_the_sky_of_the_renderer_in_every_direction(under_sky, tmp_path):
    baked, dome = bake(under_sky.at, evenly_spaced(3)), under_sky.scene.scene.dome
    write_page(tmp_path / "scene.html", baked, start(), sky=dome.image())
    splats = dataclasses.replace(baked.at(0.0).splats(), background=dome)
    with Browser(tmp_path / "profile", *SIZE) as browser:
        for target in ((0.0, 0.0, 0.0), (-3.0, 1.0, -3.2), (0.5, 2.0, -4.0)):
            view = ",".join(map(str, (0.0, 0.0, -3.0, *target)))
            browser.open(f"file://{tmp_path}/scene.html#play=0&controls=0&time=0&camera={view}")
            browser.until("['settled', 'failed'].includes(document.body?.dataset.state)")
            camera = Camera.looking_at((0.0, 0.0, -3.0), target, (0.0, -1.0, 0.0), 300.0, SIZE)
            expected = to_bytes(render(splats, camera).joint.image)
            assert cv2.PSNR(browser.screenshot(), expected) > 40
            assert expected.std() > 15
        assert browser.errors() == []


@pytest.mark.parametrize("up", ["-y", "z"])
def test_usd_has_the_sky_as_a_dome_light_in_the_axes_of_its_files(under_sky, finished_run, tmp_path, up):
    pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed (extra 'export')")
    from pxr import Gf, Usd, UsdGeom, UsdLux

    assert "with its sky in scene-sky.png" in usd.write_usd(job(under_sky, finished_run, tmp_path, up=up))
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    light = UsdLux.DomeLight(stage.GetPrimAtPath("/Scene/sky"))
    assert light.GetTextureFormatAttr().Get() == "latlong"
    image = cv2.imread(str(tmp_path / light.GetTextureFileAttr().Get().path))[..., ::-1] / 255.0
    rows, columns, _ = image.shape
    to_scene = upright(AXES[up], y_up=True).T
    turn = UsdGeom.Xformable(light).GetLocalTransformation()
    for row, column in ((20, 30), (64, 100), (100, 200)):
        # OpenEXR: longitude π at the left border, 0 along z, π / 2 along x; latitude π / 2 at the top, along y.
        longitude = math.pi * (1.0 - 2.0 * (column + 0.5) / columns)
        latitude = math.pi * (0.5 - (row + 0.5) / rows)
        x, z = math.cos(latitude) * math.sin(longitude), math.cos(latitude) * math.cos(longitude)
        in_file = turn.TransformDir(Gf.Vec3d(x, math.sin(latitude), z))
        expected = smooth(torch.tensor(to_scene @ np.array(in_file)))
        assert image[row, column] == pytest.approx(expected.numpy(), abs=0.01)


def test_the_summary_says_which_formats_hold_the_sky(under_sky, finished_run, tmp_path, monkeypatch):
    monkeypatch.setattr(Job, "clouds", under_sky)
    for name in ("ply", "glb", "usd", "html"):
        if name == "usd":
            pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed (extra 'export')")
        summary = export_run(Export(finished_run, format=name, out=tmp_path / name, quiet=True))
        note = f"--format {name} holds no sky, which was behind the Gaussians in training: only usd and html do"
        assert (note in summary) == (name not in ("usd", "html"))
        assert ("with its sky" in summary) == (name in ("usd", "html"))
        assert "behind the Gaussians was #" not in summary
