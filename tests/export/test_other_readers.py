"""Exported files as other programs read them; skipped where these are not installed.

``npm install --global @playcanvas/splat-transform @mkkellogg/gaussian-splats-3d gsplat three`` and
``pip install fourdgs gsplat trimesh pygltflib``; Spark is in ``test_spark.py``. Version 2 of splat-transform reads SPZ
with Niantic's decoder, with y up as specified; version 3 leaves the axes as they are in the file, as if y were down.
"""

import json
import shutil
import subprocess

import numpy as np
import pytest
import torch

from tests.export import node, scenes
from tests.export.test_mesh import tetrahedron
from warpgs.data.ply import read_ply
from warpgs.formats.cloud import Cloud, logit, sigmoid
from warpgs.formats.compressed import write_compressed
from warpgs.formats.gltf import write_glb
from warpgs.formats.mesh import write_mesh_ply
from warpgs.formats.mesh_gltf import write_mesh_glb
from warpgs.formats.rotation import rotated
from warpgs.formats.sog import write_sog
from warpgs.formats.spz import write_spz, write_spz_gzip
from warpgs.formats.standard import read_standard, write_standard
from warpgs.model.gaussians import SH_C0
from warpgs.video import orientation
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
    write(tmp_path / name, rotated(cloud, orientation.upright(UP, y_up)))
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


def test_trimesh_reads_meshes(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    frames = [tetrahedron(shift, color) for shift, color in ((0.0, (255, 0, 0)), (3.0, (0, 128, 255)))]
    write_mesh_glb(tmp_path / "a.glb", tetrahedron(-3.0), frames, 2.0)
    read = trimesh.load(tmp_path / "a.glb", process=False)
    assert sorted(read.geometry) == ["dynamic_00000", "dynamic_00001", "static"]
    assert read.bounds == pytest.approx(np.array([[-3, -3, -3], [1, 1, 1]]))  # the second frame has no size yet
    for k, mesh in enumerate(frames):
        found = read.geometry[f"dynamic_{k:05d}"]
        assert found.is_watertight
        assert found.volume == pytest.approx(1 / 6)
        assert (found.vertices == mesh.vertices).all()
        write_mesh_ply(tmp_path / "a.ply", mesh)
        again = trimesh.load(tmp_path / "a.ply", process=False)
        assert again.volume == pytest.approx(1 / 6)
        assert (again.visual.vertex_colors[:, :3] == mesh.colors).all()


def test_pygltflib_reads_a_mesh_and_its_animation(tmp_path):
    pygltflib = pytest.importorskip("pygltflib", reason="pygltflib is not installed")
    write_mesh_glb(tmp_path / "a.glb", tetrahedron(), [tetrahedron(), tetrahedron()], 2.0)
    read = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    blob = read.binary_blob()

    def values(index, kind):
        accessor = read.accessors[index]
        start = read.bufferViews[accessor.bufferView].byteOffset
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        return np.frombuffer(blob, kind, accessor.count * width, start).reshape(-1, width)

    primitive = read.meshes[0].primitives[0]
    colors = values(primitive.attributes.COLOR_0, "<u2")[0] / 65535
    assert colors == pytest.approx([1.0, 0.216, 0.0, 1.0], abs=1e-3)  # 128 of 255 in sRGB, linear
    assert read.materials[primitive.material].extensions == {"KHR_materials_unlit": {}}
    (animation,) = read.animations
    samplers = [animation.samplers[channel.sampler] for channel in animation.channels]
    assert [sampler.interpolation for sampler in samplers] == ["STEP", "STEP"]
    assert [values(sampler.input, "<f4")[:, 0].tolist() for sampler in samplers] == [[0, 1, 2], [0, 1, 2]]
    assert [values(sampler.output, "<f4")[:, 0].tolist() for sampler in samplers] == [[1, 0, 0], [0, 1, 1]]
    assert [read.nodes[channel.target.node].name for channel in animation.channels] == [
        "dynamic_00000",
        "dynamic_00001",
    ]


GAUSSIAN_SPLATS_3D = """
import { readFileSync } from "node:fs";
import { Quaternion, Vector3, Vector4 } from "ROOT/three/build/three.module.js";
import * as GS3D from "ROOT/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js";

globalThis.window = globalThis;  // its loader waits by window.setTimeout
const [path, degree] = process.argv.slice(2);
const file = readFileSync(path);
const data = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
const read = await GS3D.PlyLoader.loadFromFileData(data, 0, 0, false, +degree);
const [N, width] = [read.getSplatCount(), 3 * ((+degree + 1) ** 2 - 1)];
const sh = new Float32Array(N * width);
if (width) read.fillSphericalHarmonicsArray(sh, +degree, null, 0, N - 1, 0, 0);
const [mean, scale, quat, color] = [new Vector3(), new Vector3(), new Quaternion(), new Vector4()];
const rows = [];
for (let k = 0; k < N; k++) {
  read.getSplatCenter(k, mean);
  read.getSplatScaleAndRotation(k, scale, quat);
  read.getSplatColor(k, color);
  rows.push([...mean, ...scale, quat.w, quat.x, quat.y, quat.z, ...color, ...sh.subarray(k * width, (k + 1) * width)]);
}
console.log(JSON.stringify(rows));
"""

GSPLAT_JS = """
import { readFileSync } from "node:fs";
import * as SPLAT from "ROOT/gsplat/dist/index.es.js";

const file = readFileSync(process.argv[2]);
const data = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
const read = SPLAT.PLYLoader.LoadFromArrayBuffer(data, new SPLAT.Scene()).data;
const rows = [];
for (let k = 0; k < read.vertexCount; k++) {
  const part = (array, width) => [...array.subarray(k * width, (k + 1) * width)];
  rows.push([part(read.positions, 3), part(read.scales, 3), part(read.rotations, 4), part(read.colors, 4)].flat());
}
console.log(JSON.stringify(rows));
"""

PROGRAMS = {"@mkkellogg/gaussian-splats-3d": (GAUSSIAN_SPLATS_3D, [0, 1, 2]), "gsplat": (GSPLAT_JS, [0])}
"""Programs that print mean, scale, quaternion, colour and the other coefficients of each Gaussian of a PLY file, by the
package of npm whose loader they use, and the degrees that it reads."""


@pytest.mark.parametrize(
    ("package", "degree"), [(package, degree) for package, (_, degrees) in PROGRAMS.items() for degree in degrees]
)
def test_readers_of_javascript_read_the_ply_file(tmp_path, package, degree):
    if not node.has(package, "three"):
        pytest.skip(f"{package} of npm is not installed")
    cloud = scenes.cloud(300, degree)
    write_standard(tmp_path / "a.ply", cloud)
    program = PROGRAMS[package][0].replace("ROOT", str(node.packages()))
    rows = np.array(json.loads(node.run(tmp_path, program, tmp_path / "a.ply", degree)), np.float64)
    means, scales, quats, colors, rest = np.split(rows, [3, 6, 10, 14], axis=1)
    constant = (colors[:, :3] / 255 - 0.5) / SH_C0
    arrays = (means, quats, np.log(scales), logit(colors[:, 3] / 255), np.c_[constant, rest].reshape(300, -1, 3))
    back = Cloud(*(values.astype(np.float32) for values in arrays), is_dynamic=cloud.is_dynamic)
    assert back.means == pytest.approx(cloud.means)
    assert scenes.psnr(scenes.image(back), scenes.image(cloud)) > 38


@pytest.mark.parametrize("degree", [0, 3])
def test_gsplat_writes_the_same_values(tmp_path, degree):
    """gsplat reads no PLY file, but writes them: in the same columns."""
    exporter = pytest.importorskip("gsplat.exporter", reason="gsplat is not installed")
    cloud = scenes.cloud(30, degree)
    write_standard(tmp_path / "ours.ply", cloud)
    names = ("means", "log_scales", "quats", "logit_opacities")
    parts = [torch.from_numpy(getattr(cloud, name)) for name in names]
    sh = torch.from_numpy(cloud.sh)
    exporter.export_splats(*parts, sh[:, :1], sh[:, 1:], format="ply", save_to=str(tmp_path / "theirs.ply"))
    ours, theirs = (read_ply(tmp_path / name)["vertex"] for name in ("ours.ply", "theirs.ply"))
    assert set(ours.dtype.names) == set(theirs.dtype.names) | {"nx", "ny", "nz"}
    for name in theirs.dtype.names:
        assert (ours[name] == theirs[name]).all(), name
