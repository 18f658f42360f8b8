"""Cameras as OpenUSD: one prim moves along the training frames, one along the evaluation frames, of each camera.

A prim UsdGeomCamera looks along -z with y up. Its ``focalLength`` and apertures are tenths of a scene unit, which
other programs show as millimetres: only their ratios matter. Apertures are the image at the focal length, their offsets
the principal point. Time code k is k / (N - 1) of the duration, for N times of a camera; programs interpolate between.
"""

from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from warpgs.cameras import Camera
from warpgs.formats.packages import required
from warpgs.video.usd_cameras import OPENCV_FROM_OPENGL, ROTATION, SIZE

from .camera_set import CameraSet
from .usd import save_stage

FOCAL_LENGTH = 50.0
"""Focal length of all cameras [tenths of a scene unit]."""

TRAINING = "training"
"""Prim of the training camera; of several, with the id of each after it."""

NEAR, FAR = 0.01, 1e4
"""Clipping range [scene units]."""


def write_usd_cameras(folder: Path, cameras: CameraSet) -> None:
    """Writes cameras.usdc; raises OSError if it cannot be written or usd-core is not installed."""
    path = folder / "cameras.usdc"
    Usd, UsdGeom, Gf = (required(path, f"pxr.{name}", "usd-core") for name in ("Usd", "UsdGeom", "Gf"))
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().customLayerData = {ROTATION: Gf.Matrix3d(*cameras.rotation.ravel().tolist())}
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Cameras").GetPrim())
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prims = _by_prim(cameras)
    last = max(1, max(len(by_time) for prim, by_time in prims.items() if prim.startswith(TRAINING)) - 1)
    stage.SetTimeCodesPerSecond(last / cameras.seconds)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(last)
    for prim, by_time in prims.items():
        camera = UsdGeom.Camera.Define(stage, f"/Cameras/{prim}")
        camera.CreateClippingRangeAttr(Gf.Vec2f(NEAR, FAR))
        camera.CreateFocalLengthAttr(FOCAL_LENGTH)
        camera.GetPrim().SetCustomDataByKey(SIZE, Gf.Vec2i(*next(iter(by_time.values())).size))
        _animate(camera, {last * time: by_time[time] for time in sorted(by_time)}, path)
    save_stage(stage, path)


def _by_prim(cameras: CameraSet) -> dict[str, dict[float, Camera]]:
    """The cameras of each prim by their times: training and evaluation, with the id if several cameras do it."""
    found: dict[str, dict[float, Camera]] = {}
    for prim, names in ((TRAINING, cameras.train), ("evaluation", cameras.cameras.keys() - {*cameras.train})):
        ids = sorted({cameras.cameras[name].id for name in names})
        for i in ids:
            of_id = (name for name in sorted(names, reverse=True) if cameras.cameras[name].id == i)
            by_time = {cameras.cameras[name].time: cameras.cameras[name] for name in of_id}
            found[prim if len(ids) == 1 else f"{prim}_{i}"] = by_time
    return found


def _animate(prim: Any, cameras: dict[float, Camera], path: Path) -> None:
    """Sets the pose and the apertures of a prim at time codes."""
    Gf, UsdGeom = required(path, "pxr.Gf", "usd-core"), required(path, "pxr.UsdGeom", "usd-core")
    move = prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    turn = prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    apertures = (
        *(prim.CreateHorizontalApertureAttr(), prim.CreateVerticalApertureAttr()),
        *(prim.CreateHorizontalApertureOffsetAttr(), prim.CreateVerticalApertureOffsetAttr()),
    )
    for code, camera in cameras.items():
        to_world = camera.viewmat[:3, :3].double().numpy().T @ OPENCV_FROM_OPENGL
        x, y, z, w = Rotation.from_matrix(to_world).as_quat().tolist()
        move.Set(Gf.Vec3d(*camera.position.double().tolist()), code)
        turn.Set(Gf.Quatd(w, x, y, z), code)
        for attribute, value in zip(apertures, _apertures(camera), strict=True):
            attribute.Set(value, code)


def _apertures(camera: Camera) -> tuple[float, float, float, float]:
    """Width and height of the image at the focal length, and how far right and up of the axis its middle is."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    x, y = FOCAL_LENGTH / fx, FOCAL_LENGTH / fy
    return x * camera.width, y * camera.height, x * (0.5 * camera.width - cx), y * (cy - 0.5 * camera.height)
