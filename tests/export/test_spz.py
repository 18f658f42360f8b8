"""SPZ: the layout of its specification, and a loss that is not visible."""

import dataclasses
import gzip
import struct
import sys

import numpy as np
import pytest

from tests.export import scenes
from warpgs.cli import main
from warpgs.formats.cloud import Cloud, logit
from warpgs.formats.spz import write_spz, write_spz_gzip

WIDTHS = (9, 1, 3, 3, 4)
"""Bytes per Gaussian of positions, opacities, colours, scales and rotations."""


def parts(path):
    """The header and the streams of a file of version 3 or 4."""
    data = path.read_bytes()
    legacy = data[:2] == b"\x1f\x8b"
    data = gzip.decompress(data) if legacy else data
    magic, version, num, degree, bits, flags, count = struct.unpack_from("<4sIIBBBB", data)
    assert magic == b"NGSP"
    sizes = [num * width for width in (*WIDTHS, 3 * ((degree + 1) ** 2 - 1)) if width]
    if legacy:
        assert (version, count) == (3, 0)
        ends = np.cumsum(sizes)
        assert len(data) == 16 + ends[-1]
        streams = [data[16 + end - size : 16 + end] for end, size in zip(ends, sizes, strict=True)]
    else:
        zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed (extra 'export')")
        assert (version, count) == (4, len(sizes))
        (start,) = struct.unpack_from("<I", data, 16)
        table = np.frombuffer(data, "<u8", 2 * count, start).reshape(count, 2)
        assert table[:, 1].tolist() == sizes
        ends = start + 16 * count + np.cumsum(table[:, 0])
        assert ends[-1] == len(data)
        begins = [start + 16 * count, *ends[:-1]]
        streams = [zstandard.decompress(data[b:e]) for b, e in zip(begins, ends, strict=True)]
    return (num, degree, bits, flags), [np.frombuffer(stream, np.uint8) for stream in streams]


def decoded(path):
    """The cloud of a file, by the specification."""
    (num, degree, bits, flags), streams = parts(path)
    raw = streams[0].reshape(num, 3, 3).astype(np.int32)
    fixed = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    means = (fixed - ((fixed & 0x800000) << 1)) / 2.0**bits
    quats = np.zeros((num, 4))
    for k, word in enumerate(streams[4].view("<u4").tolist()):
        largest = word >> 30
        for axis in reversed([a for a in range(4) if a != largest]):
            size = (word & 511) / 511 / np.sqrt(2)
            quats[k, axis] = -size if word & 512 else size
            word >>= 10
        quats[k, largest] = np.sqrt(1 - (quats[k] ** 2).sum())
    rest = (streams[5].reshape(num, (degree + 1) ** 2 - 1, 3) - 128.0) / 128 if degree else np.zeros((num, 0, 3))
    constant = (streams[2].reshape(num, 1, 3) / 255 - 0.5) / 0.15
    return Cloud(
        means=means.astype(np.float32),
        quats=np.roll(quats, 1, axis=1).astype(np.float32),
        log_scales=(streams[3].reshape(num, 3) / 16 - 10).astype(np.float32),
        logit_opacities=logit(streams[1] / 255).astype(np.float32),
        sh=np.concatenate([constant, rest], 1).astype(np.float32),
        is_dynamic=np.zeros(num, bool),
        antialias=bool(flags & 1),
    )


WRITERS = pytest.mark.parametrize("write", [write_spz, write_spz_gzip], ids=["v4", "v3"])


@WRITERS
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_image_is_nearly_the_same_after_export(path, write, degree):
    pytest.importorskip("zstandard") if write is write_spz else None
    cloud = scenes.cloud(200, degree)
    assert write(path, cloud) == path.stat().st_size
    back = decoded(path)
    assert np.abs(back.means - cloud.means).max() < 1e-6
    assert np.abs(back.log_scales - cloud.log_scales).max() <= 1 / 32 + 1e-6
    assert (np.abs((back.quats * cloud.quats).sum(1)) > 1 - 1e-5).all()
    assert scenes.psnr(scenes.image(back), scenes.image(cloud)) > 42


@WRITERS
@pytest.mark.parametrize("num", [0, 1])
def test_small_clouds_have_all_streams(path, write, num):
    pytest.importorskip("zstandard") if write is write_spz else None
    write(path, scenes.cloud(num, 2))
    assert decoded(path).sh.shape == (num, 9, 3)


@pytest.mark.parametrize("antialias", [False, True])
def test_a_flag_says_whether_to_antialias(path, antialias):
    write_spz_gzip(path, dataclasses.replace(scenes.cloud(3), antialias=antialias))
    assert decoded(path).antialias == antialias


@pytest.mark.parametrize("reach", [0.5, 1.0, 100.0, 8e6])
def test_positions_use_all_bits_that_their_range_leaves(path, reach):
    cloud = scenes.cloud(50)
    means = (cloud.means / np.abs(cloud.means).max() * reach).astype(np.float32)
    write_spz_gzip(path, dataclasses.replace(cloud, means=means))
    assert np.abs(decoded(path).means - means).max() <= reach * 2.0**-21 + 2.0**-20


def test_a_position_that_does_not_fit_is_refused(path):
    cloud = scenes.cloud(2)
    with pytest.raises(ValueError, match=f"{path}: SPZ holds positions up to 8,388,608, got a larger one"):
        write_spz_gzip(path, dataclasses.replace(cloud, means=cloud.means * np.float32(1e9)))
    assert not path.exists()


def test_without_zstandard_the_error_says_what_to_do(finished_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    options = ["--format", "spz", "--up", "scene", "--out", str(tmp_path)]
    assert main(["export", str(finished_run), *options]) == 2
    error = capsys.readouterr().err
    assert "scene.spz needs zstandard: pip install " in error
    assert error.endswith("[export]'\n") or error.endswith("[export]\n")
    assert list(tmp_path.iterdir()) == []
