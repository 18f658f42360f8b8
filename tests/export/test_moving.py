"""OpenUSD and .4dgs: the scene at any time as their own libraries read it; static Gaussians are stored once."""

import sys

import numpy as np
import pytest
import torch

from tests.export import scenes
from warpgs.editing.object_scene import ObjectScene
from warpgs.export import fourdgs, usd
from warpgs.export.clouds import Clouds
from warpgs.export.job import Job
from warpgs.export.options import Export
from warpgs.formats.cloud import Cloud, logit, sigmoid
from warpgs.formats.rotation import rotated
from warpgs.model.gaussians import SH_C0
from warpgs.runs.run import Run
from warpgs.video.orientation import AXES, upright

KEYS, SECONDS = 5, 2.0


def job(clouds, finished_run, folder, **options):
    options = {"keys": KEYS, "seconds": SECONDS, "up": "-y", **options}
    job = Job(Run.open(finished_run, "cpu"), Export(finished_run, out=folder, quiet=True, **options))
    job.clouds = clouds
    return job


def expected(clouds, time):
    return rotated(clouds.at(time), upright(AXES["-y"], y_up=True))


def psnr(cloud, truth):
    """PSNR of images after half a turn around x, for which the cameras of the tests are made."""
    images = [scenes.image(rotated(c, upright(AXES["-y"], y_up=True))) for c in (cloud, truth)]
    assert images[1].std() > 0.05
    return scenes.psnr(*images)


def cloud_of(means, quats, scales, opacities, sh):
    """Quaternions as (x, y, z, w)."""
    arrays = (means, np.roll(quats, 1, 1), np.log(scales), logit(np.asarray(opacities, np.float64)), sh)
    arrays = [np.asarray(values, np.float32) for values in arrays]
    return Cloud(*arrays, is_dynamic=np.zeros(len(means), bool))


@pytest.fixture(scope="module")
def stage(clouds, finished_run, tmp_path_factory):
    pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed (extra 'export')")
    from pxr import Usd

    folder = tmp_path_factory.mktemp("usd")
    summary = usd.write_usd(job(clouds, finished_run, folder))
    assert "40 static and 20 dynamic Gaussians at 5 key times" in summary
    assert [path.name for path in folder.iterdir()] == ["scene.usdc"]
    return Usd.Stage.Open(str(folder / "scene.usdc"))


def usd_cloud(stage, code):
    from pxr import UsdVol

    parts = []
    for name in ("static", "dynamic"):
        prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(f"/Scene/{name}"))
        coefficients = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(code))
        means = np.array(prim.GetPositionsAttr().Get(code))
        others = (prim.GetOrientationsAttr(), prim.GetScalesAttr(), prim.GetOpacitiesAttr())
        arrays = [np.array(attribute.Get(code)) for attribute in others]
        degree = prim.GetRadianceSphericalHarmonicsDegreeAttr().Get()
        parts.append([means, *arrays, coefficients.reshape(len(means), (degree + 1) ** 2, 3)])
    return cloud_of(*(np.concatenate(part) for part in zip(*parts, strict=True)))


@pytest.mark.parametrize("key", range(KEYS))
def test_usd_is_exact_at_key_times(stage, clouds, key):
    assert psnr(usd_cloud(stage, float(key)), expected(clouds, key / (KEYS - 1))) > 80


def test_usd_interpolates_between_key_times(stage, clouds):
    first, second = (expected(clouds, time).means for time in (0.25, 0.5))
    assert usd_cloud(stage, 1.5).means == pytest.approx((first + second) / 2, abs=1e-5)


def test_usd_stores_what_is_static_once(stage):
    samples = {
        (prim.GetName(), attribute.GetName()): attribute.GetNumTimeSamples()
        for prim in stage.GetPrimAtPath("/Scene").GetChildren()
        for attribute in prim.GetAttributes()
        if attribute.HasAuthoredValue()
    }
    coefficients = "radiance:sphericalHarmonicsCoefficients"
    assert {name for name, count in samples.items() if count} == {
        ("static", coefficients),  # the appearance network
        ("dynamic", "extent"),
        ("dynamic", "positions"),
        ("dynamic", "orientations"),
        ("dynamic", "scales"),
    }
    assert set(samples.values()) == {0, KEYS}


def test_usd_is_valid_upright_and_as_long_as_asked(stage):
    from pxr import UsdGeom, UsdValidation

    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == SECONDS
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert UsdValidation.ValidationContext(validators).Validate(stage) == []


def test_a_value_that_changes_late_is_constant_before(tmp_path):
    pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed (extra 'export')")
    from pxr import Usd, UsdVol

    stage = Usd.Stage.CreateInMemory()
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/a")
    field, cloud = usd._Field(prim), scenes.cloud(3)
    for time, shift in enumerate((0, 0, 0, 1, 1, 1, 2)):
        field.add(cloud.replaced(means=cloud.means + np.float32(shift)), float(time))
    found = [
        np.array(prim.GetPositionsAttr().Get(time))[0, 0] - cloud.means[0, 0] for time in (0, 1.5, 2, 2.5, 3, 4.9, 6)
    ]
    assert found == pytest.approx([0, 0, 0, 0.5, 1, 1, 2], abs=1e-5)


@pytest.fixture
def numbered(clouds):
    """The clouds with objects, whose numbers are those of the Gaussians modulo 3."""
    ids = torch.arange(60) % 3
    return Clouds(ObjectScene(clouds.scene, ids)), ids.tolist()


def test_usd_has_the_object_of_each_gaussian(numbered, finished_run, tmp_path):
    pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed (extra 'export')")
    from pxr import Usd, UsdGeom

    clouds, ids = numbered
    usd.write_usd(job(clouds, finished_run, tmp_path))
    stage, found = Usd.Stage.Open(str(tmp_path / "scene.usdc")), []
    for name in ("static", "dynamic"):
        primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(f"/Scene/{name}")).GetPrimvar("objectId")
        assert primvar.GetInterpolation() == UsdGeom.Tokens.vertex
        found += list(primvar.Get())
    assert found == ids


def test_a_container_has_the_object_of_each_gaussian_at_all_times(numbered, finished_run, tmp_path):
    pytest.importorskip("fourdgs", reason="fourdgs is not installed (extra 'export')")
    from fourdgs import keyframe_delta_file as file
    from fourdgs import opcode
    from fourdgs.validate import validate

    clouds, ids = numbered
    fourdgs.write_fourdgs(job(clouds, finished_run, tmp_path, keys=10))  # two keyframes
    content = (tmp_path / "scene.4dgs").read_bytes()
    assert validate(content).ok
    for decoded in (file.decode_streamed(content), file.decode_indexed(content)[0]):
        assert len(decoded.chunks) == 10
        for chunk in decoded.chunks:
            assert chunk.state.bins[opcode.A_OBJECT_ID][:, 0].tolist() == [ids[k] for k in chunk.state.ids]


def test_objects_change_nothing_else_of_a_container(numbered, clouds, finished_run, tmp_path):
    pytest.importorskip("fourdgs", reason="fourdgs is not installed (extra 'export')")
    from fourdgs import keyframe_delta_file as file

    states = []
    for name, written in (("with", numbered[0]), ("without", clouds)):
        fourdgs.write_fourdgs(job(written, finished_run, tmp_path / name, keys=10))
        content = (tmp_path / name / "scene.4dgs").read_bytes()
        states.append(file.render_at(file.decode_indexed(content)[0], 0.95 * SECONDS))
    for name in ("centers", "rotations", "scales", "opacity", "rgb"):
        assert np.array_equal(states[0][name], states[1][name])


@pytest.fixture(scope="module")
def container(clouds, finished_run, tmp_path_factory):
    pytest.importorskip("fourdgs", reason="fourdgs is not installed (extra 'export')")
    folder = tmp_path_factory.mktemp("4dgs")
    assert "40 static and 20 dynamic" in fourdgs.write_fourdgs(job(clouds, finished_run, folder))
    return (folder / "scene.4dgs").read_bytes()


def test_a_container_is_valid(container):
    from fourdgs.validate import validate

    report = validate(container)
    assert report.ok, report


@pytest.mark.parametrize("key", [0, 1, 4])
def test_a_container_shows_the_scene_at_its_key_times(container, clouds, key):
    from fourdgs import keyframe_delta_file as file

    state = file.render_at(file.decode_streamed(container), key * SECONDS / KEYS)
    truth = expected(clouds, key / KEYS)
    truth = truth.replaced(sh=truth.sh[:, :1])
    sh = ((state["rgb"] - 0.5) / SH_C0)[:, None]
    back = cloud_of(state["centers"], state["rotations"], state["scales"], state["opacity"], sh)
    assert psnr(back, truth) > 38


@pytest.mark.parametrize("key", [1, 3])
def test_a_container_shows_the_dynamic_gaussians_of_each_segment_in_its_time(finished_run, tmp_path, key):
    pytest.importorskip("fourdgs", reason="fourdgs is not installed (extra 'export')")
    from fourdgs import keyframe_delta_file as file

    clouds = scenes.segmented()
    fourdgs.write_fourdgs(job(clouds, finished_run, tmp_path))
    time = key * (SECONDS / KEYS)  # as written: a rounding error earlier, the sample before it is shown
    state = file.render_at(file.decode_streamed((tmp_path / "scene.4dgs").read_bytes()), time)
    truth = expected(clouds, key / KEYS)
    opacities = sigmoid(truth.logit_opacities)
    assert np.abs(np.asarray(state["opacity"]).ravel() - opacities).max() < 0.01
    assert ((opacities[40:] > 0.5) == (np.arange(20) % 2 == key // 3)).all()
    assert np.abs(state["centers"] - truth.means).max() < 0.03 * float(np.median(np.exp(truth.log_scales)))


def test_gaussians_move_in_straight_lines_between_samples(container, clouds):
    from fourdgs import keyframe_delta_file as file

    state = file.render_at(file.decode_streamed(container), 1.5 * SECONDS / KEYS)
    first, second = (expected(clouds, time).means for time in (1 / KEYS, 2 / KEYS))
    tolerance = 0.03 * float(np.median(np.exp(clouds.at(0.0).log_scales)))
    assert np.abs(state["centers"] - (first + second) / 2).max() < tolerance


PACKAGES = [(usd.write_usd, "pxr.Usd", "usd-core"), (fourdgs.write_fourdgs, "fourdgs", "fourdgs")]


@pytest.mark.parametrize(("write", "module", "package"), PACKAGES)
def test_a_missing_package_is_named(clouds, finished_run, tmp_path, monkeypatch, write, module, package):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(OSError, match=rf"needs {package}: pip install .*\[export\]"):
        write(job(clouds, finished_run, tmp_path))
    assert list(tmp_path.iterdir()) == []
