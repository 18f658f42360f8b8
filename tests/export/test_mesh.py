"""Meshes: what is written, and when each frame is shown."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from tests import plain, tiny
from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.data.ply import read_ply
from warpgs.export import export_run, mesh
from warpgs.export.job import Job
from warpgs.export.mesh import write_mesh
from warpgs.export.options import Export
from warpgs.formats.mesh import Mesh, write_mesh_ply
from warpgs.formats.mesh_gltf import write_mesh_glb
from warpgs.meshing import depth_views
from warpgs.model.gaussians import Gaussians
from warpgs.model.scene import SplitScene
from warpgs.runs.checkpoint import Metadata
from warpgs.runs.run import Run
from warpgs.runs.trained import TrainedScene

pytestmark = pytest.mark.usefixtures("quickly")


def tetrahedron(shift=0.0, color=(255, 128, 0)):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32) + np.float32(shift)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return Mesh(vertices, faces, np.full((4, 3), color, np.uint8))


NOTHING = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))


def document_of(path):
    content = path.read_bytes()
    return json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])


def shown(path, seconds):
    """Names of the nodes with meshes whose scale is not 0 at a time of the animation."""
    document = document_of(path)
    accessors = document["accessors"]
    content = path.read_bytes()
    start = 28 + int.from_bytes(content[12:16], "little")

    def values(index):
        accessor = accessors[index]
        first = start + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        return np.frombuffer(content, "<f4", accessor["count"] * width, first).reshape(-1, width)

    scales = {k: node.get("scale", [1, 1, 1])[0] for k, node in enumerate(document["nodes"]) if "mesh" in node}
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            assert sampler["interpolation"] == "STEP"
            times = values(sampler["input"])[:, 0]
            assert (np.diff(times) > 0).all()
            scales[channel["target"]["node"]] = values(sampler["output"])[np.flatnonzero(times <= seconds)[-1], 0]
    return [document["nodes"][k]["name"] for k, scale in scales.items() if scale]


@pytest.mark.parametrize(("seconds", "frame"), [(0.0, 0), (0.9, 0), (1.0, 1), (1.99, 1), (2.0, 2), (2.5, 2), (3.0, 2)])
def test_one_frame_is_shown_at_a_time(path, seconds, frame):
    write_mesh_glb(path, tetrahedron(), [tetrahedron(k) for k in range(3)], 3.0)
    assert shown(path, seconds) == ["static", f"dynamic_{frame:05d}"]


def test_programs_that_play_no_animation_show_the_first_frame(path):
    write_mesh_glb(path, tetrahedron(), [tetrahedron(k) for k in range(3)], 3.0)
    nodes = document_of(path)["nodes"]
    assert [node.get("scale") for node in nodes] == [None, None, [0, 0, 0], [0, 0, 0], None]
    assert nodes[4] == {"name": "dynamic", "children": [1, 2, 3]}


def test_a_frame_without_triangles_shows_nothing(path):
    write_mesh_glb(path, None, [tetrahedron(), NOTHING], 2.0)
    assert shown(path, 0.5) == ["dynamic_00000"]
    assert shown(path, 1.5) == []


@pytest.mark.parametrize("frames", [[], [tetrahedron()]])
def test_a_mesh_of_one_time_has_no_animation(path, frames):
    write_mesh_glb(path, tetrahedron(), frames, 2.0)
    assert "animations" not in document_of(path)


def test_no_triangles_are_refused(path):
    with pytest.raises(ValueError, match="the meshes have no triangles: use a smaller --voxel"):
        write_mesh_glb(path, NOTHING, [NOTHING], 1.0)
    assert not path.exists()


def test_a_ply_file_has_the_vertices_and_their_colors(path):
    written = tetrahedron()
    assert write_mesh_ply(path, written) == path.stat().st_size
    vertices = read_ply(path, first_only=True)["vertex"]
    assert (np.stack([vertices[name] for name in "xyz"], 1) == written.vertices).all()
    assert (np.stack([vertices[name] for name in ("red", "green", "blue")], 1) == written.colors).all()


def blob(center, color, num=400):
    """Opaque Gaussians on a ball of radius 0.3."""
    points = torch.nn.functional.normalize(torch.randn(num, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    points = 0.3 * points + torch.tensor(center)
    return Gaussians.from_points(points, torch.tensor(color).expand(num, 3).clone(), torch.full((num,), 0.03), 0.99, 1)


@pytest.fixture(scope="module")
def scene():
    """A static ball on the left; one on the right that does not move."""
    scene = SplitScene.empty(400, 400, tiny.MODEL)
    scene.static.load_state_dict(blob((-0.5, 0, 0), (0.9, 0.1, 0.1)).state_dict())
    scene.dynamic.load_state_dict(blob((0.5, 0, 0), (0.1, 0.1, 0.9)).state_dict())
    metadata = Metadata(iteration=1, use_deformation=False, use_appearance=False, sh_degree=0)
    return TrainedScene(scene.requires_grad_(False), plain.plan(plain.config(model=tiny.MODEL)), metadata)


@pytest.fixture(scope="module")
def capture():
    up, cameras = torch.tensor([0.0, -1.0, 0.0]), {}
    for k in range(8):
        angle = torch.tensor(2 * torch.pi * k / 8)
        position = 2.5 * torch.stack([angle.sin(), torch.tensor(0.1), -angle.cos()])
        cameras[f"{k}"] = Camera.looking_at(position, torch.zeros(3), up, 80.0, (96, 64), k / 7)
    return Capture("balls", cameras, [*cameras], [], torch.zeros(0, 3), None, lambda name: None)


@pytest.fixture
def job(scene, capture, finished_run, tmp_path):
    def make(**options):
        job = Job(
            Run.open(finished_run, "cpu"), Export(finished_run, format="mesh", out=tmp_path, quiet=True, **options)
        )
        job.clouds = type("Clouds", (), {"scene": scene})()
        job._capture = capture, ""
        return job

    return make


def test_a_mesh_has_the_static_part_once_and_what_moves_at_each_time(job, tmp_path):
    summary = write_mesh(job(keys=3, seconds=2.0, up="-y", voxel=0.03))
    assert "dynamic ones at 3 times" in summary
    assert "voxels have 0.03 scene units (static) and 0.03 scene units (dynamic)" in summary
    document = document_of(tmp_path / "mesh.glb")
    assert [node["name"] for node in document["nodes"]] == [
        "static",
        *(f"dynamic_0000{k}" for k in range(3)),
        "dynamic",
    ]
    positions = [document["accessors"][of["primitives"][0]["attributes"]["POSITION"]] for of in document["meshes"]]
    for accessor, center in zip(positions, (-0.5, 0.5, 0.5, 0.5), strict=True):
        low, high = np.array(accessor["min"]), np.array(accessor["max"])
        assert (low + high) / 2 == pytest.approx([center, 0, 0], abs=0.06)
        assert high - low == pytest.approx([0.65] * 3, abs=0.12)


def test_frames_are_ply_files_and_replace_what_was_exported_before(job, tmp_path):
    assert "removed" not in write_mesh(job(frames=3, voxel=0.05))
    removed = "\nremoved, as of an earlier export: "
    summary = write_mesh(job(keys=2, voxel=0.05))
    assert summary.endswith(f"{removed}static_mesh.ply, dynamic_mesh_00000.ply to dynamic_mesh_00002.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.glb"]
    summary = write_mesh(job(frames=2, voxel=0.05))
    assert summary.startswith(f"static_mesh.ply and dynamic_mesh_00000.ply to dynamic_mesh_00001.ply in {tmp_path}: ")
    assert summary.endswith(f"{removed}mesh.glb")
    names = ["dynamic_mesh_00000.ply", "dynamic_mesh_00001.ply", "static_mesh.ply"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    vertices = [read_ply(tmp_path / name, first_only=True)["vertex"] for name in names[1:]]
    assert [float(np.sign(v["x"].mean())) for v in vertices] == [1.0, -1.0]
    assert [int(v["blue"].mean() > v["red"].mean()) for v in vertices] == [1, 0]


def test_a_file_leaves_what_is_next_to_it(job, tmp_path):
    write_mesh(job(frames=1, layers="static", voxel=0.05))
    made = job(layers="static", voxel=0.05)
    made.options = dataclasses.replace(made.options, out=tmp_path / "other.glb")
    assert write_mesh(made).startswith(f"{tmp_path / 'other.glb'}: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.glb", "static_mesh.ply"]


def test_times_at_which_nothing_is_seen_do_not_decide_about_voxels(job, monkeypatch):
    """Voxels of a scene in small units, at whose first time nothing moves."""
    seen = depth_views.depth_view

    def small(splats, is_dynamic, camera, settings):
        view = seen(splats, is_dynamic, camera, settings)
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] *= 0.1
        scale = 0.0 if camera.time == 0 else 0.1
        return view._replace(depth=scale * view.depth, camera=dataclasses.replace(camera, viewmat=viewmat))

    monkeypatch.setattr(mesh, "depth_view", small)
    monkeypatch.setattr(mesh, "NUM_NEAR", 1)
    monkeypatch.setattr(mesh, "NUM_OTHER", 0)
    maker = mesh._Maker(job())
    meshes = maker.dynamic([0.0, 3 / 7, 1.0])
    assert [len(made.faces) > 0 for made in meshes] == [False, True, True]
    assert maker.note.endswith("voxels have 0.0033 scene units (dynamic)")


@pytest.mark.parametrize(
    ("layers", "names"), [("static", ["static"]), ("dynamic", ["dynamic_00000", "dynamic"])], ids=["static", "dynamic"]
)
def test_one_branch_at_one_time_is_a_file_without_the_other(job, tmp_path, layers, names):
    summary = write_mesh(job(layers=layers, time=0.5, voxel=0.05))
    assert ("dynamic ones at 1 time," in summary) == (layers == "dynamic")
    assert [node["name"] for node in document_of(tmp_path / "mesh.glb")["nodes"]] == names


def test_voxels_in_which_what_moves_is_lost_are_refused_by_the_default_size(job, tmp_path, monkeypatch):
    default = write_mesh(job(time=0.5)).partition("(static) and ")[2].partition(" scene units (dynamic)")[0]
    (tmp_path / "mesh.glb").unlink()
    monkeypatch.setattr(mesh._Maker, "dynamic", lambda self, times: [])
    with pytest.raises(ValueError, match=f"whose voxels have {default} scene units by default: use a smaller one"):
        write_mesh(job(time=0.5, voxel=0.05))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layers": "apart"}, "the parts of a mesh are separate in any case"),
        ({"time": 0.5, "keys": 3}, "--keys is for a mesh that moves in one file: omit it, or --time"),
        ({"frames": 3, "seconds": 2.0}, "--seconds is for a mesh that moves in one file: omit it, or --frames"),
        ({"voxel": -1.0}, "--voxel must be positive"),
        ({"voxel": 0.005}, "--voxel 0.005 needs .* more than the maximum of 100,000: use .* or larger"),
        ({"voxel": 1e-9}, "--voxel 1e-09 is finer than the images"),
        ({"voxel": 100.0}, "none is as large as the voxels of --voxel 100"),
        ({"precision": 2.0}, "--precision is for --format html, not for mesh"),
    ],
)
def test_options_that_cannot_be_used_are_refused(job, tmp_path, monkeypatch, options, message):
    monkeypatch.setattr(mesh, "MAX_VOXELS", 100_000)
    made = job(**options)
    monkeypatch.setattr(export_run, "Job", lambda *_: made)
    with pytest.raises(ValueError, match=message):
        export_run.export_run(made.options)
    assert list(tmp_path.iterdir()) == []


def test_a_scene_that_is_too_transparent_is_refused(job, tmp_path, monkeypatch):
    monkeypatch.setattr(depth_views, "MIN_ALPHA", {False: 1.0, True: 1.0})
    with pytest.raises(ValueError, match="no surface is opaque enough for a mesh"):
        write_mesh(job(time=0.5))
    assert list(tmp_path.iterdir()) == []
