"""Compressed PLY: the layout that other readers expect, and the same image up to quantisation."""

import dataclasses

import numpy as np
import pytest

from tests.export import scenes
from warpgs.data.ply import read_ply
from warpgs.formats.compressed import read_compressed, write_compressed
from warpgs.formats.ply import write_ply
from warpgs.model.gaussians import SH_C0


def matched(a, b):
    """The Gaussians of b in the order of the closest ones of a."""
    return b.select(((a.means[:, None] - b.means[None]) ** 2).sum(2).argmin(1))


@pytest.mark.parametrize("num", [0, 1, 255, 256, 257, 600])
def test_a_file_has_one_chunk_per_256_gaussians_and_16_bytes_per_gaussian(path, num):
    write_compressed(path, scenes.cloud(num, degree=0))
    tables = read_ply(path)
    assert [len(tables["chunk"]), len(tables["vertex"])] == [-(-num // 256), num]
    assert tables["chunk"].dtype.itemsize == 72
    assert tables["vertex"].dtype.names == ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    assert tables["vertex"].dtype.itemsize == 16
    assert "sh" not in tables
    assert len(read_compressed(path)) == num


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_export_and_import_preserve_the_rendering(path, degree):
    cloud = scenes.cloud(300, degree)
    write_compressed(path, cloud)
    assert scenes.psnr(scenes.image(read_compressed(path)), scenes.image(cloud)) > 40


def test_values_are_restored_to_within_half_a_step(path):
    cloud = scenes.cloud(200, degree=2)
    write_compressed(path, cloud)
    back = matched(cloud, read_compressed(path))
    assert np.abs(back.means - cloud.means).max() <= 2 / 1023 / 2 * 1.01
    assert np.abs(back.log_scales - cloud.log_scales).max() <= np.ptp(cloud.log_scales) / 1023 / 2 * 1.01
    assert np.abs(back.sh[:, 1:] - cloud.sh[:, 1:]).max() <= 8 / 255 / 2 * 1.01
    assert np.abs(back.sh[:, 0] - cloud.sh[:, 0]).max() <= np.ptp(cloud.sh[:, 0]) / 255 / 2 * 1.01
    opacities = [1 / (1 + np.exp(-c.logit_opacities)) for c in (back, cloud)]
    assert np.abs(opacities[0] - opacities[1]).max() <= 0.51 / 255
    assert np.abs((back.quats * cloud.quats).sum(1)).min() > 1 - 1e-5


def test_the_bits_are_in_the_layout_of_playcanvas(path):
    # One Gaussian at the far x, y, z of a chunk of two; its rotation's largest component is z, the others (w, x, y).
    cloud = scenes.cloud(2, degree=1)
    means = np.array([[0, 0, 0], [1, 2, 3]], np.float32)
    quats = np.tile(np.array([[0.0, 0.5, -0.5, np.sqrt(0.5)]], np.float32), (2, 1))
    sh = np.zeros((2, 4, 3), np.float32)
    sh[1, 0] = [1, 2, 3]
    sh[:, 1, 0], sh[:, 2, 0], sh[:, 1, 1] = 4.0, -4.0, 1.0
    cloud = dataclasses.replace(cloud, means=means, quats=quats, sh=sh, logit_opacities=np.full(2, 40.0, np.float32))
    write_compressed(path, cloud)
    tables = read_ply(path)
    words, chunk, rest = tables["vertex"][1], tables["chunk"][0], tables["sh"][1]
    assert words["packed_position"] == 0xFFFFFFFF
    assert words["packed_color"] == 0xFFFFFFFF
    assert words["packed_rotation"] >> 30 == 3
    parts = [((int(words["packed_rotation"]) >> shift & 1023) / 1023 - 0.5) * np.sqrt(2) for shift in (20, 10, 0)]
    assert parts == pytest.approx([0.0, 0.5, -0.5], abs=1e-3)
    assert [chunk["min_x"], chunk["max_z"]] == [0, 3]
    assert chunk["max_b"] == pytest.approx(0.5 + 3 * SH_C0)
    assert [rest["f_rest_0"], rest["f_rest_1"], rest["f_rest_3"]] == [255, 0, 159]  # red, red, green


def as_floats(table):
    return table.astype([(name, "<f4") for name in table.dtype.names])


def test_a_file_without_colour_ranges_is_read(path):
    cloud = dataclasses.replace(scenes.cloud(10, degree=0), sh=np.zeros((10, 1, 3), np.float32))
    write_compressed(path, cloud)
    tables = read_ply(path)
    old = tables["chunk"][list(tables["chunk"].dtype.names[:12])]
    vertex = tables["vertex"].copy()
    vertex["packed_color"] = 0x336699FF
    write_ply(path, {"chunk": as_floats(old), "vertex": vertex})
    colors = 0.5 + SH_C0 * read_compressed(path).sh[:, 0]
    assert colors * 255 == pytest.approx(np.tile([0x33, 0x66, 0x99], (10, 1)), abs=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("chunk"), "has no element chunk or vertex"),
        (lambda t: t.update(chunk=t["chunk"][:1]), "has 1 chunks, expected 2 for 300 Gaussians"),
        (lambda t: t.update(sh=t["sh"][:7]), "has 7 rows of sh for 300 Gaussians"),
        (lambda t: t["chunk"].__setitem__("max_y", np.nan), "ranges that are not finite"),
        (lambda t: t.update(vertex=as_floats(t["vertex"])), "has the wrong type"),
    ],
)
def test_an_inconsistent_file_is_refused(path, change, message):
    write_compressed(path, scenes.cloud(300))
    tables = {name: table.copy() for name, table in read_ply(path).items()}
    change(tables)
    write_ply(path, tables)
    with pytest.raises(ValueError, match=message):
        read_compressed(path)


def test_a_standard_ply_file_is_refused(path):
    write_ply(path, {"vertex": np.zeros(1, [("x", "<f4")])})
    with pytest.raises(ValueError, match="is not a compressed PLY file"):
        read_compressed(path)
