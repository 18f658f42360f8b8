"""Files of Gaussians are read back as they were written; damaged ones are refused in one line."""

import dataclasses
import gzip
import json
import struct
import tracemalloc
import zipfile

import cv2
import numpy as np
import pytest

from tests.export import scenes
from tests.export.test_sog import decoded as decoded_sog
from warpgs.formats import sog
from warpgs.formats.cloud import ARRAYS
from warpgs.formats.compressed import write_compressed
from warpgs.formats.gltf import EXTENSION, write_glb
from warpgs.formats.readers import READERS, read_cloud
from warpgs.formats.rotation import Y_DOWN_TO_Y_UP, rotated
from warpgs.formats.sog import write_sog
from warpgs.formats.spz import write_spz, write_spz_gzip
from warpgs.formats.standard import write_standard
from warpgs.model.gaussians import SH_C0

FILES = {
    "a.ply": (write_standard, False, 60),
    "a.compressed.ply": (write_compressed, False, 38),
    "a.sog": (write_sog, False, 40),
    "a.spz": (write_spz, True, 42),
    "a.v3.spz": (write_spz_gzip, True, 42),
    "a.glb": (write_glb, True, 60),
}
"""Functions that write a file, whether y is up in it, and minimum PSNR of what is read back."""


def write(path, cloud):
    writer, y_up, _ = FILES[path.name]
    pytest.importorskip("zstandard") if writer is write_spz else None
    writer(path, rotated(cloud, Y_DOWN_TO_Y_UP) if y_up else cloud)
    return path


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(("degree", "num"), [(0, 200), (1, 200), (3, 200), (2, 1)])
def test_the_image_of_what_is_read_back_is_the_same(tmp_path, name, degree, num):
    cloud = scenes.cloud(num, degree)
    back = read_cloud(write(tmp_path / name, cloud))
    assert back.sh.shape == cloud.sh.shape
    assert back.antialias is False
    assert scenes.image(cloud).std() > 0.001
    assert scenes.psnr(scenes.image(back), scenes.image(cloud)) > FILES[name][2]


@pytest.mark.parametrize("name", FILES)
def test_positions_and_sizes_are_read_back_within_the_steps_of_the_format(tmp_path, name):
    cloud = scenes.cloud(100, 1)
    back = read_cloud(write(tmp_path / name, cloud))
    order = [np.lexsort(np.round(c.means, 2).T) for c in (cloud, back)]
    assert back.means[order[1]] == pytest.approx(cloud.means[order[0]], abs=2e-3)
    assert back.log_scales[order[1]] == pytest.approx(cloud.log_scales[order[0]], abs=0.04)


@pytest.mark.parametrize("name", [name for name in FILES if name != "a.glb"])
def test_whether_to_antialias_is_read(tmp_path, name):
    cloud = dataclasses.replace(scenes.cloud(5), antialias=True)
    assert read_cloud(write(tmp_path / name, cloud)).antialias


def test_a_ply_file_is_read_without_loss(tmp_path):
    cloud = scenes.cloud(20, 3)
    back = read_cloud(write(tmp_path / "a.ply", cloud))
    assert all((getattr(back, name) == getattr(cloud, name)).all() for name in ("means", "log_scales", "sh"))
    assert (back.logit_opacities == cloud.logit_opacities).all()


def test_infinite_opacities_and_scales_of_zero_are_read_and_what_is_not_finite_is_omitted(tmp_path):
    cloud = scenes.cloud(6)
    cloud.logit_opacities[1], cloud.log_scales[2, 0], cloud.means[3, 1], cloud.quats[4] = np.inf, -np.inf, np.nan, 0.0
    back = read_cloud(write(tmp_path / "a.ply", cloud))
    assert len(back) == 4
    assert back.finite.all()
    assert float(back.splats().opacities[1]) == 1.0
    assert back.splats().scales[2, 0] < 1e-19


def test_a_file_without_gaussians_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a\.ply has no Gaussians"):
        read_cloud(write(tmp_path / "a.ply", scenes.cloud(0)))


def legacy_spz(path, version):
    """A file of one Gaussian at (1, -2, 3) turned by a quarter around z, as of SPZ's first versions."""
    position = np.array([1, -2, 3], "<f2").tobytes()
    if version == 2:
        position = b"".join((value * 4096 & 0xFFFFFF).to_bytes(3, "little") for value in (1, -2, 3))
    header = struct.pack("<4sIIBBBB", b"NGSP", version, 1, 0, 12, 1, 0)
    turn = round(127.5 * (1 + 0.5**0.5))
    path.write_bytes(gzip.compress(header + position + bytes([128, 255, 128, 0, 96, 112, 128, 128, 128, turn])))
    return path


@pytest.mark.parametrize("version", [1, 2])
def test_early_versions_of_spz_are_read(tmp_path, version):
    cloud = rotated(read_cloud(legacy_spz(tmp_path / "a.spz", version)), Y_DOWN_TO_Y_UP)
    assert cloud.means[0] == pytest.approx([1, -2, 3], abs=1e-6)
    assert np.abs(cloud.quats[0]) == pytest.approx([0.5**0.5, 0, 0, 0.5**0.5], abs=0.01)
    assert cloud.log_scales[0] == pytest.approx([-4, -3, -2])
    assert 0.5 + SH_C0 * cloud.sh[0, 0] == pytest.approx([0.5 + SH_C0 / 0.3, 0.5, 0.5 - SH_C0 / 0.3], abs=0.01)
    assert cloud.antialias


def test_coefficients_of_degree_four_are_dropped(tmp_path):
    cloud = scenes.cloud(4, 3)
    write_spz_gzip(tmp_path / "b.spz", cloud)
    content = bytearray(gzip.decompress((tmp_path / "b.spz").read_bytes()))
    rest = np.frombuffer(content, np.uint8)[-4 * 45 :].reshape(4, 45)
    wider = np.concatenate([rest, np.full((4, 27), 200, np.uint8)], 1)
    content[12] = 4
    (tmp_path / "c.spz").write_bytes(gzip.compress(bytes(content[: -4 * 45]) + wider.tobytes()))
    clouds = [read_cloud(tmp_path / name) for name in ("b.spz", "c.spz")]
    assert all((getattr(clouds[0], name) == getattr(clouds[1], name)).all() for name in ARRAYS)


def test_a_splat_file_is_read(tmp_path):
    """By its layout: centre, scales, colour with opacity, quaternion."""
    row = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.4, 255, 0, 51, 204, 192, 128, 128, 239)
    (tmp_path / "a.splat").write_bytes(row * 2)
    cloud = read_cloud(tmp_path / "a.splat")
    assert cloud.means.tolist() == [[1, 2, 3]] * 2
    assert np.exp(cloud.log_scales[0]) == pytest.approx([0.1, 0.2, 0.4])
    assert 0.5 + SH_C0 * cloud.sh[0, 0] == pytest.approx([1, 0, 0.2], abs=1e-6)
    assert float(cloud.splats().opacities[0]) == pytest.approx(0.8)
    assert cloud.quats[0] == pytest.approx(np.array([64, 0, 0, 111]) / np.hypot(64, 111))


def edit_glb(path, change):
    """Changes the JSON document of a binary glTF file."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    path.write_bytes(
        struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest
    )
    return path


def test_gaussians_of_gltf_are_where_their_nodes_are(tmp_path):
    """A child that is moved along y in a parent that is turned by a quarter around z and twice as large."""
    cloud = scenes.cloud(30, 2)
    path = tmp_path / "a.glb"
    write_glb(path, cloud)
    half = 0.5**0.5

    def nest(document):
        parent = {"children": [1], "rotation": [0, 0, half, half], "scale": [2, 2, 2]}
        document["nodes"] = [parent, {"mesh": 0, "translation": [0, 1, 0]}]

    back = rotated(read_cloud(edit_glb(path, nest)), Y_DOWN_TO_Y_UP)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = cloud.replaced(
        means=(cloud.means + np.float32([0, 1, 0])), log_scales=cloud.log_scales + np.float32(np.log(2))
    )
    expected = rotated(moved, turn)
    assert back.means == pytest.approx(2 * expected.means, abs=1e-5)
    assert back.log_scales == pytest.approx(expected.log_scales, abs=1e-5)
    assert back.sh == pytest.approx(expected.sh, abs=1e-5)
    assert np.abs((back.quats * expected.quats).sum(1)) == pytest.approx(1, abs=1e-5)


def test_all_primitives_of_gltf_are_read(tmp_path):
    write_glb(tmp_path / "a.glb", scenes.cloud(5))
    twice = edit_glb(
        tmp_path / "a.glb",
        lambda document: document["meshes"][0].update(primitives=2 * document["meshes"][0]["primitives"]),
    )
    assert len(read_cloud(twice)) == 10


def test_gltf_whose_nodes_show_one_mesh_without_end_is_refused(tmp_path):
    def repeat(document):
        document["nodes"] = [{"mesh": 0}] * 20_000
        document["scenes"] = [{"nodes": list(range(20_000))}]

    write_glb(tmp_path / "a.glb", scenes.cloud(100))
    with pytest.raises(ValueError, match=r"a\.glb is damaged: it claims 112,000,000 bytes of Gaussians in "):
        read_cloud(edit_glb(tmp_path / "a.glb", repeat))


def test_normalized_integers_of_gltf_are_read(tmp_path):
    cloud = scenes.cloud(1, 0)
    path = tmp_path / "a.glb"
    write_glb(path, cloud)

    def as_bytes(document):
        index = document["meshes"][0]["primitives"][0]["attributes"][f"{EXTENSION}:OPACITY"]
        document["accessors"][index].update(componentType=5121, normalized=True)

    first = np.float32(cloud.splats().opacities[0]).tobytes()[0]
    assert float(read_cloud(edit_glb(path, as_bytes)).splats().opacities[0]) == pytest.approx(first / 255, abs=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]), "needs the extension 'EXT_meshopt"),
        (lambda d: d["nodes"][0].update(scale=[1, 2, 1]), "mirrored or scaled unequally"),
        (lambda d: d["nodes"][0].update(scale=[-1, 1, 1]), "mirrored or scaled unequally"),
        (lambda d: d["nodes"][0].update(children=[0]), "node 0 has two parents"),
        (lambda d: d["nodes"][0].update(mesh=7), "refers to 7 of 1 objects"),
        (lambda d: d["accessors"][0].update(count=10**9), "beyond the end of its buffer"),
        (lambda d: d["bufferViews"][0].update(byteOffset=10**9), "beyond the end of its buffer"),
        (lambda d: d["accessors"][0].update(componentType=5125), "of a type that is not supported"),
        (lambda d: d["accessors"][0].update(count=1), "has 5 rows, POSITION 1"),
        (lambda d: d["nodes"][0].update(children=7), "children cannot be 7"),
        (lambda d: d["meshes"][0].update(primitives=[]), "no primitive with KHR_gaussian_splatting"),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "a primitive has no POSITION"),
    ],
)
def test_gltf_that_is_damaged_or_not_supported_is_refused(tmp_path, change, message):
    write_glb(tmp_path / "a.glb", scenes.cloud(5))
    with pytest.raises(ValueError, match=message):
        read_cloud(edit_glb(tmp_path / "a.glb", change))


def test_colours_of_gltf_in_another_space_are_refused(tmp_path):
    write_glb(tmp_path / "a.glb", scenes.cloud(5))

    def linear(document):
        document["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["colorSpace"] = "lin_rec709_display"

    with pytest.raises(ValueError, match="has colours in 'lin_rec709_display'"):
        read_cloud(edit_glb(tmp_path / "a.glb", linear))


def edit_sog(path, change=lambda meta: None, images=lambda images: None):
    """Changes the metadata and the encoded images of a .sog file."""
    with zipfile.ZipFile(path) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    meta = json.loads(parts.pop("meta.json"))
    change(meta)
    images(parts)
    with zipfile.ZipFile(path, "w") as file:
        for name, data in {**parts, "meta.json": json.dumps(meta).encode()}.items():
            file.writestr(name, data)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda meta: meta.update(version=1), "has version 1 of SOG"),
        (lambda meta: meta.update(count=10**7), "count cannot be 10000000"),
        (lambda meta: meta.update(count=700), "pixels for 700 values"),
        (lambda meta: meta.update(count=-1), "count cannot be -1"),
        (lambda meta: meta.pop("quats"), "meta.json has no object quats"),
        (lambda meta: meta["scales"].update(codebook=[0.0] * 255), "codebook must be finite numbers of shape"),
        (lambda meta: meta["sh0"].update(files=["a.webp"]), "has no file 'a.webp' of sh0"),
        (lambda meta: meta["sh0"].update(files=[]), "has no file None of sh0"),
        (lambda meta: meta["shN"].update(count=1), "labels are beyond the 1 entries"),
        (lambda meta: meta["shN"].update(bands=2), "192 × 4 pixels for 2,048 values"),
        (lambda meta: meta["shN"].update(bands=2, count=64), "palette is 192 px wide, not 512"),
        (lambda meta: meta["shN"].update(bands=4), "bands cannot be 4"),
        (lambda meta: meta["quats"].update(files=["sh0.webp"]), "rotations have other modes"),
    ],
)
def test_metadata_of_sog_that_do_not_fit_are_refused(tmp_path, change, message):
    write_sog(tmp_path / "a.sog", scenes.cloud(200, 1))
    with pytest.raises(ValueError, match=message):
        read_cloud(edit_sog(tmp_path / "a.sog", change))


@pytest.mark.parametrize("data", [b"", b"RIFF", cv2.imencode(".png", np.zeros((20, 20, 4), np.uint8))[1].tobytes()])
def test_images_of_sog_that_are_no_webp_are_refused(tmp_path, data):
    write_sog(tmp_path / "a.sog", scenes.cloud(200, 0))
    with pytest.raises(ValueError, match="no WebP image"):
        read_cloud(edit_sog(tmp_path / "a.sog", images=lambda images: images.update({"sh0.webp": data})))


def test_a_palette_that_was_clustered_is_read_as_specified(tmp_path, monkeypatch):
    monkeypatch.setattr(sog, "MAX_PALETTE", 100)
    monkeypatch.setattr(sog, "CLUSTERS", 70)
    back = read_cloud(write(tmp_path / "a.sog", scenes.cloud(300, 2)))
    expected = decoded_sog(tmp_path / "a.sog")
    assert all(getattr(back, name) == pytest.approx(getattr(expected, name), abs=1e-5) for name in ARRAYS)


def test_files_in_which_gaussians_take_far_more_than_their_size_are_refused_before_memory_is_taken(tmp_path):
    """A billion Gaussians in a few bytes."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, 10**9, 3, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + bytes(10**6)))
    (tmp_path / "b.spz").write_bytes(struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 10**9, 3, 12, 0, 6, 32))
    tracemalloc.start()
    try:
        for name in ("a.spz", "b.spz"):
            with pytest.raises(ValueError, match=r"claims .* bytes of Gaussians"):
                read_cloud(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", [*FILES, "a.splat"])
def test_files_that_end_early_or_are_changed_are_refused_in_one_line(tmp_path, name):
    cloud, path = scenes.cloud(60, 1), tmp_path / name
    if name == "a.splat":
        path.write_bytes(bytes(range(256)) * 4)
    else:
        write(path, cloud)
    data, random = path.read_bytes(), np.random.default_rng(0)
    for k in range(60):
        damaged = bytearray(data[: random.integers(len(data))] if k % 2 else data)
        for _ in range(0 if k % 2 else 3):
            damaged[random.integers(min(len(damaged), 400))] = random.integers(256)
        path.write_bytes(damaged)
        with np.errstate(all="ignore"):
            message = scenes.refusal(read_cloud, path)
        assert message is None or (str(path) in message and "\n" not in message)


@pytest.mark.parametrize("name", ["a.sog", "a.spz", "a.v3.spz", "a.glb", "a.compressed.ply"])
def test_half_of_a_file_is_refused(tmp_path, name):
    path = write(tmp_path / name, scenes.cloud(60, 1))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert str(path) in str(scenes.refusal(read_cloud, path))


def test_every_format_has_a_suffix_of_its_own():
    assert {f".{name.rsplit('.', 1)[1]}" for name in FILES} | {".splat"} == set(READERS)


def test_without_zstandard_the_message_says_what_to_install(tmp_path, monkeypatch):
    path = write(tmp_path / "a.spz", scenes.cloud(3))
    monkeypatch.setitem(__import__("sys").modules, "zstandard", None)
    with pytest.raises(OSError, match=r"a\.spz needs zstandard: pip install"):
        read_cloud(path)
