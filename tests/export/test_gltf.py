"""Binary glTF with KHR_gaussian_splatting: valid, and read back without loss."""

import json
import struct

import numpy as np
import pytest

from tests.export import scenes
from warpgs.formats.cloud import Cloud, logit
from warpgs.formats.gltf import EXTENSION, write_glb

TYPES = {5126: "<f4", 5121: "u1"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def parts(path):
    """The JSON document, and the attributes of its only primitive."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + length])
    buffer_size, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert (kind, buffer_size) == (b"BIN\0", document["buffers"][0]["byteLength"])
    binary = data[28 + length :]
    assert len(binary) == buffer_size
    arrays = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        values = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        array = np.frombuffer(values, TYPES[accessor["componentType"]])
        arrays[name] = array.reshape(accessor["count"], WIDTHS[accessor["type"]])
    return document, arrays


def decoded(path):
    """The cloud of a file, by the specification."""
    _, arrays = parts(path)
    N = len(arrays["POSITION"])
    degrees = [(d, k) for d in range(4) for k in range(2 * d + 1) if f"{EXTENSION}:SH_DEGREE_{d}_COEF_{k}" in arrays]
    return Cloud(
        means=arrays["POSITION"],
        quats=np.roll(arrays[f"{EXTENSION}:ROTATION"], 1, axis=1),
        log_scales=np.log(arrays[f"{EXTENSION}:SCALE"]),
        logit_opacities=logit(arrays[f"{EXTENSION}:OPACITY"].astype(np.float64))[:, 0].astype(np.float32),
        sh=np.stack([arrays[f"{EXTENSION}:SH_DEGREE_{d}_COEF_{k}"] for d, k in degrees], 1),
        is_dynamic=np.zeros(N, bool),
    )


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_cloud_is_read_back_without_loss(path, degree):
    cloud = scenes.cloud(31, degree)
    assert write_glb(path, cloud) == path.stat().st_size
    back = decoded(path)
    for name in ("means", "quats", "sh"):
        assert (getattr(back, name) == getattr(cloud, name)).all()
    assert back.log_scales == pytest.approx(cloud.log_scales, abs=1e-5)
    assert back.logit_opacities == pytest.approx(cloud.logit_opacities, abs=1e-4)


def test_the_document_declares_the_extension_and_the_range_of_positions(path):
    cloud = scenes.cloud(5)
    write_glb(path, cloud)
    document, _ = parts(path)
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["extensionsUsed"] == [EXTENSION]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION]["kernel"] == "ellipse"
    assert primitive["extensions"][EXTENSION]["colorSpace"] == "srgb_rec709_display"
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == pytest.approx(cloud.means.min(0))
    assert position["max"] == pytest.approx(cloud.means.max(0))


def test_programs_without_the_extension_see_points_of_linear_color(path):
    cloud = scenes.cloud(3, degree=0)
    cloud.sh[:, 0] = ((np.array([0.0, 0.5, 1.5]) - 0.5) / 0.28209479)[:, None]
    write_glb(path, cloud)
    assert parts(path)[1]["COLOR_0"][:, 0].tolist() == [0, 55, 255]  # 0.5 in sRGB is 0.214 linear


def test_an_empty_cloud_is_refused(path):
    with pytest.raises(ValueError, match=f"{path}: glTF needs at least one Gaussian"):
        write_glb(path, scenes.cloud(0))
    assert not path.exists()
