"""OpenUSD: two prims ParticleField3DGaussianSplat (OpenUSD 26.03 and newer), one per branch, with time samples.

https://openusd.org/release/user_guides/schemas/usdVol/ParticleField3DGaussianSplat.html: positions, orientations,
linear scales, opacities in [0, 1], and per Gaussian the coefficients of all degrees and its object (primvar
``objectId``). What does not change over time is stored once; programs interpolate linearly between time samples. Axes
are x right, y up, z towards the viewer. A sky is a dome light, with a PNG file beside the scene.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64
from scipy.spatial.transform import Rotation

from warpgs.files import atomic_path, write_png
from warpgs.formats.cloud import Cloud, sigmoid
from warpgs.formats.packages import required
from warpgs.ops.sh import degree_of

from .job import Job, Writer
from .moving import KEYS, OPTIONS, SECONDS, clouds_over_time

BRANCHES = ("static", "dynamic")
PARTS = ("extent", "positions", "orientations", "scales", "opacities", "coefficients")


def write_usd(job: Job) -> str:
    """Writes one file; returns a summary.

    Raises:
        OSError: If it cannot be written, or usd-core is not installed; the message says which.
    """
    options, path = job.options, job.file("scene.usdc")
    keys, seconds = options.keys or KEYS, options.seconds or SECONDS
    Usd, UsdGeom, UsdVol = (required(path, f"pxr.{name}", "usd-core") for name in ("Usd", "UsdGeom", "UsdVol"))
    stage = Usd.Stage.CreateInMemory()
    root = UsdGeom.Xform.Define(stage, "/Scene").GetPrim()
    stage.SetDefaultPrim(root)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(max(1, keys - 1) / seconds)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(keys - 1)
    fields = [_Field(UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/Scene/{name}")) for name in BRANCHES]
    for k, cloud in enumerate(clouds_over_time(job, keys)):
        for field, is_dynamic in zip(fields, (False, True), strict=True):
            field.add(cloud.select(cloud.is_dynamic == is_dynamic), float(k))
    sky = _add_sky(stage, job, path)
    save_stage(stage, path)
    count = f"{fields[0].count:,} static and {fields[1].count:,} dynamic Gaussians at {keys} key times"
    return f"{path}: {count}, {path.stat().st_size / 1e6:.1f} MB{sky}\n{job.up_note}"


SCENE_FROM_DOME = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From the axes of a dome light, whose texture begins at longitude π of OpenEXR's latitude-longitude maps, y up, to
those of the sky, whose columns go around z the other way."""


def _add_sky(stage: Any, job: Job, path: Path) -> str:
    """Adds the sky of a scene that has one, and writes its image; returns the end of a line about it."""
    dome = job.clouds.scene.scene.dome
    if dome is None:
        return ""
    UsdLux, Gf = required(path, "pxr.UsdLux", "usd-core"), required(path, "pxr.Gf", "usd-core")
    image = path.with_name(f"{path.stem}-sky.png")
    write_png(image, np.ascontiguousarray(dome.image()[:, ::-1]))
    light = UsdLux.DomeLight.Define(stage, "/Scene/sky")
    light.CreateTextureFileAttr(f"./{image.name}")
    light.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    x, y, z, w = Rotation.from_matrix(job.rotation(True) @ SCENE_FROM_DOME).as_quat().tolist()
    light.AddOrientOp().Set(Gf.Quatf(w, x, y, z))
    return f", with its sky in {image.name}"


def save_stage(stage: Any, path: Path) -> None:
    """Writes a stage as binary OpenUSD; raises OSError if it cannot be written."""
    with atomic_path(path) as partial:
        file = partial.with_suffix(".usdc")  # USD chooses the format by the suffix
        try:
            if not stage.GetRootLayer().Export(str(file)):
                raise OSError("OpenUSD reports an error")
            file.replace(partial)
        finally:
            file.unlink(missing_ok=True)


class _Field:
    """A prim whose attributes get a time sample when they change."""

    def __init__(self, prim: Any) -> None:
        self._attributes = {
            "extent": prim.CreateExtentAttr(),
            "positions": prim.CreatePositionsAttr(),
            "orientations": prim.CreateOrientationsAttr(),
            "scales": prim.CreateScalesAttr(),
            "opacities": prim.CreateOpacitiesAttr(),
            "coefficients": prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(),
        }
        self._prim = prim
        self._last: dict[str, tuple[np.ndarray, float]] = {}
        self.count = 0

    def add(self, cloud: Cloud, time: float) -> None:
        """Adds the cloud at a time code; all clouds have the same Gaussians."""
        if not self._last:
            self._prim.CreateRadianceSphericalHarmonicsDegreeAttr(degree_of(cloud.sh.shape[1]))
            self._prim.CreateSortingModeHintAttr("zDepth")
            if cloud.objects is not None:
                _add_objects(self._prim, cloud.objects)
            self.count = len(cloud)
        for name, values in _values(cloud).items():
            self._set(name, values, time)

    def _set(self, name: str, values: np.ndarray, time: float) -> None:
        attribute = self._attributes[name]
        if name not in self._last:
            attribute.Set(_to_usd(name, values))  # of all times, unless samples follow
            self._last[name] = values, time
            return
        before, since = self._last[name]
        if name == "orientations":  # q and -q are the same rotation: interpolate towards the closer one
            values = np.where((values * before).sum(1, keepdims=True) < 0, -values, values)
        if np.array_equal(before, values):
            return
        if since < time - 1 or attribute.GetNumTimeSamples() == 0:
            attribute.Set(_to_usd(name, before), time - 1)  # it was constant until then
        attribute.Set(_to_usd(name, values), time)
        self._last[name] = values, time


def _add_objects(prim: Any, objects: Int64[np.ndarray, " N"]) -> None:
    """Adds the primvar ``objectId``: the number of each Gaussian's object, 0 for none."""
    from pxr import Sdf, UsdGeom, Vt  # after ``required``

    types, each = Sdf.ValueTypeNames, UsdGeom.Tokens.vertex
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("objectId", types.IntArray, each)
    primvar.Set(Vt.IntArray.FromNumpy(objects.astype(np.int32)))


def _values(cloud: Cloud) -> dict[str, np.ndarray]:
    """The values of the attributes; quaternions as (x, y, z, w)."""
    scales = np.exp(cloud.log_scales)
    reach = 3 * scales.max(1, keepdims=True, initial=0.0)
    extent = np.zeros((2, 3), np.float32)
    if len(cloud):
        extent = np.stack([(cloud.means - reach).min(0), (cloud.means + reach).max(0)])
    quats = np.roll(cloud.quats, -1, axis=1)
    opacities = sigmoid(cloud.logit_opacities.astype(np.float64)).astype(np.float32)
    return dict(zip(PARTS, (extent, cloud.means, quats, scales, opacities, cloud.sh.reshape(-1, 3)), strict=True))


def _to_usd(name: str, values: np.ndarray) -> Any:
    from pxr import Vt  # after ``required``

    types = {"orientations": Vt.QuatfArray, "opacities": Vt.FloatArray}
    return types.get(name, Vt.Vec3fArray).FromNumpy(np.ascontiguousarray(values, np.float32))


USD = Writer(write_usd, OPTIONS, ".usdc", has_sky=True, has_objects=True, y_up=True)
