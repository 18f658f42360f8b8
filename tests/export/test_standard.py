"""The PLY file of 3DGS: the layout that other programs expect, read back without loss."""

import dataclasses
import struct

import numpy as np
import pytest

from tests.export import scenes
from warpgs.data.ply import read_ply
from warpgs.formats.compressed import write_compressed
from warpgs.formats.ply import write_ply
from warpgs.formats.standard import columns, read_standard, write_standard

COLUMNS = columns(15)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("num", [0, 1, 37])
def test_a_cloud_is_read_back_exactly_and_shows_the_same_image(path, degree, num):
    cloud = scenes.cloud(num, degree)
    write_standard(path, cloud)
    back = read_standard(path)
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        assert (getattr(back, name) == getattr(cloud, name)).all()
    assert back.quats == pytest.approx(cloud.quats, abs=1e-6)
    assert (scenes.image(back) - scenes.image(cloud)).abs().max() < 1e-5


def test_a_row_of_degree_3_has_248_bytes_in_the_order_of_3dgs(path):
    cloud = scenes.cloud(1, degree=3)
    write_standard(path, cloud)
    row = struct.unpack("<62f", path.read_bytes()[-248:])
    assert COLUMNS[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert row[:3] == pytest.approx(cloud.means[0])
    assert row[3:6] == (0, 0, 0)
    assert row[6:9] == pytest.approx(cloud.sh[0, 0])
    assert row[54:55] == pytest.approx(cloud.logit_opacities)
    assert row[55:58] == pytest.approx(cloud.log_scales[0])
    assert row[58:62] == pytest.approx(cloud.quats[0])


def test_coefficients_are_ordered_by_channel(path):
    cloud = scenes.cloud(1, degree=1)
    write_standard(path, cloud)
    row = struct.unpack("<26f", path.read_bytes()[-104:])
    for channel in range(3):
        assert row[9 + 3 * channel : 12 + 3 * channel] == pytest.approx(cloud.sh[0, 1:, channel])


def test_a_file_of_a_lower_degree_with_other_columns_is_read(path):
    cloud = scenes.cloud(5, degree=1)
    names = [column for column in columns(3) if not column.startswith("n")] + ["extra"]
    table = np.zeros(5, [(name, "<f8") for name in names])
    write_standard(path, cloud)
    full = read_ply(path)["vertex"]
    for name in names[:-1]:
        table[name] = full[name]
    write_ply(path, {"vertex": table})
    assert (read_standard(path).sh == cloud.sh).all()


@pytest.mark.parametrize("name", ["x", "opacity", "rot_3", "f_dc_2", "f_rest_7"])
def test_a_missing_or_mistyped_property_is_named(path, name):
    write_standard(path, scenes.cloud(2, degree=3))
    table = read_ply(path)["vertex"]
    others = [column for column in COLUMNS if column != name]
    write_ply(path, {"vertex": table[others].astype([(column, "<f4") for column in others])})
    with pytest.raises(ValueError, match=f"no property {name}|44 properties f_rest"):
        read_standard(path)
    write_ply(path, {"vertex": table.astype([(c, "<u4" if c == name else "<f4") for c in COLUMNS])})
    with pytest.raises(ValueError, match=f"{name} has the wrong type uint32"):
        read_standard(path)


def test_a_file_without_vertices_is_refused(path):
    write_ply(path, {"face": np.zeros(1, [("x", "<f4")])})
    with pytest.raises(ValueError, match="has no element vertex"):
        read_standard(path)


@pytest.mark.parametrize("write", [write_standard, write_compressed])
@pytest.mark.parametrize("antialias", [False, True])
def test_the_header_says_whether_to_antialias(path, write, antialias):
    write(path, dataclasses.replace(scenes.cloud(3), antialias=antialias))
    assert (b"\ncomment SplatRenderMode: mip\n" in path.read_bytes()) == antialias
    assert len(read_ply(path)["vertex"]) == 3
