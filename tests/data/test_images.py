"""Images are read completely or refused."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from tests.data.captures import SIZE, dynamic_block, image_of, write_array, write_png
from warpgs.data import images


@pytest.fixture
def path(tmp_path):
    write_png(tmp_path / "a.png", image_of("a"))
    return tmp_path / "a.png"


def jpeg(path):
    smooth = cv2.resize(np.random.default_rng(0).integers(0, 256, (3, 5, 3), dtype=np.uint8), SIZE)
    path.write_bytes(cv2.imencode(".jpg", smooth[..., ::-1])[1].tobytes())
    return smooth


def test_an_image_is_read_as_rgb(path):
    assert np.array_equal(images.read_image(path, SIZE), image_of("a"))


def test_a_jpeg_is_read(tmp_path):
    smooth = jpeg(tmp_path / "a.jpg")
    assert abs(images.read_image(tmp_path / "a.jpg", SIZE).astype(int) - smooth).mean() < 8


def test_a_grey_image_has_three_equal_channels(tmp_path):
    write_png(tmp_path / "a.png", dynamic_block())
    assert np.array_equal(images.read_image(tmp_path / "a.png", SIZE)[..., 1], dynamic_block())


def test_16_bit_images_are_converted_to_8_bits(tmp_path):
    write_png(tmp_path / "a.png", image_of("a").astype(np.uint16) * 256 + 7)
    assert np.array_equal(images.read_image(tmp_path / "a.png", SIZE), image_of("a"))


def test_transparent_pixels_are_inpainted(tmp_path):
    pixels = np.full((SIZE[1], SIZE[0], 4), 200, np.uint8)
    pixels[..., 3] = 255
    pixels[5:8, 5:8] = 0
    write_png(tmp_path / "a.png", pixels)
    assert np.abs(images.read_image(tmp_path / "a.png", SIZE).astype(int) - 200).max() <= 1


def refused_quietly(path, data, message, capfd):
    path.write_bytes(data)
    with pytest.raises(ValueError, match=message):
        images.read_image(path, SIZE)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_png_is_refused_by_name(path, fraction, capfd):
    data = path.read_bytes()
    refused_quietly(path, data[: int(fraction * len(data))], r"a\.png is (truncated|not a PNG)", capfd)


def test_a_png_with_one_wrong_byte_is_refused_by_name(path, capfd):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    refused_quietly(path, data, r"a\.png is damaged", capfd)


def test_a_truncated_jpeg_is_refused_by_name(tmp_path, capfd):
    jpeg(tmp_path / "a.jpg")
    refused_quietly(tmp_path / "a.jpg", (tmp_path / "a.jpg").read_bytes()[:-200], r"a\.jpg is truncated", capfd)


def test_a_jpeg_with_data_of_a_phone_behind_the_image_is_read(tmp_path, capfd):
    jpeg(tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "b.jpg").write_bytes(data + b"\0\0ftypmp42 a video SEFT")
    assert np.array_equal(images.read_image(tmp_path / "b.jpg", SIZE), images.read_image(tmp_path / "a.jpg", SIZE))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("keep", [300, -200])
def test_the_end_of_a_preview_does_not_hide_that_a_jpeg_is_truncated(tmp_path, keep):
    jpeg(tmp_path / "a.jpg")
    data, preview = (tmp_path / "a.jpg").read_bytes(), b"Exif\0\0\xff\xd8\xff\xd9"
    segment = b"\xff\xe1" + struct.pack(">H", 2 + len(preview)) + preview
    (tmp_path / "a.jpg").write_bytes(data[:2] + segment + data[2:keep])
    with pytest.raises(ValueError, match=r"a\.jpg is truncated"):
        images.read_image(tmp_path / "a.jpg", SIZE)


def chunk(name, content):
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def bomb(width, height):
    """A valid PNG of 16-bit RGBA, all zero: a thousandth of the size of its pixels."""
    header = struct.pack(">IIBBBBB", width, height, 16, 6, 0, 0, 0)
    row, compress = bytes(1 + 8 * width), zlib.compressobj(1)
    pixels = b"".join(compress.compress(row) for _ in range(height)) + compress.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(20_000, 10), (10, 2**31), (0, 5)])
def test_a_png_that_claims_an_absurd_size_is_refused_before_it_is_decoded(tmp_path, size):
    header = struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0)
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IEND", b""))
    with pytest.raises(ValueError, match=f"claims {size[0]}×{size[1]}"):
        images.decode(tmp_path / "a.png")


@pytest.fixture
def no_decoding(monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))


@pytest.mark.usefixtures("no_decoding")
@pytest.mark.parametrize("read", [images.read_image, images.read_mask])
def test_an_image_of_another_size_is_refused_before_it_is_decoded(tmp_path, read):
    (tmp_path / "a.png").write_bytes(bomb(2000, 1000))
    with pytest.raises(ValueError, match=r"a\.png: the .* is 2000×1000, expected 40×24, the image_size of its camera"):
        read(tmp_path / "a.png", SIZE)


@pytest.mark.usefixtures("no_decoding")
def test_images_and_depth_with_too_many_pixels_are_refused_before_they_are_decoded(tmp_path):
    header = struct.pack(">IIBBBBB", 16000, 16000, 16, 6, 0, 0, 0)
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IEND", b""))
    with pytest.raises(ValueError, match="claims 16000×16000 pixels, expected at most 100,000,000 together"):
        images.decode(tmp_path / "a.png")
    with pytest.raises(ValueError, match="claims 16000×16000 pixels, expected at most 16,777,216 together"):
        images.read_depth(tmp_path / "a.png", SIZE)


def test_the_first_chunk_of_a_png_must_be_its_header(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"tEXt", b"x" * 8) + chunk(b"IEND", b""))
    with pytest.raises(ValueError, match="its first chunk must be its header"):
        images.image_size(tmp_path / "a.png")


@pytest.mark.parametrize("part", [b"\xff", b"\xff\xe0\x00\x02"], ids=["padding", "segments"])
def test_a_jpeg_of_millions_of_parts_is_refused(tmp_path, part):
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8" + part * 3_000_000 + b"\xff\xd9")
    with pytest.raises(ValueError, match="it has no frame header"):
        images.image_size(tmp_path / "a.jpg")


def test_the_size_of_an_image_is_read_without_decoding_it(tmp_path, path, no_decoding):
    jpeg(tmp_path / "b.jpg")
    assert images.image_size(path) == images.image_size(tmp_path / "b.jpg") == SIZE


def test_a_missing_image_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match=r"none\.png is missing"):
        images.read_image(tmp_path / "none.png", SIZE)


def test_a_text_file_is_refused(tmp_path):
    (tmp_path / "a.png").write_text("<html>not found</html>")
    with pytest.raises(ValueError, match="not a PNG or JPEG image"):
        images.read_image(tmp_path / "a.png", SIZE)


@pytest.mark.parametrize("read", [images.read_image, images.read_mask])
def test_an_image_or_mask_of_another_size_is_refused_with_both_sizes(path, read):
    with pytest.raises(ValueError, match=r"a\.png: the .* is 40×24, expected 41×24"):
        read(path, (41, 24))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_depth_images_of_8_and_16_bits_are_scaled_to_1(tmp_path, dtype):
    values = np.linspace(0, np.iinfo(dtype).max, SIZE[0] * SIZE[1]).astype(dtype).reshape(SIZE[1], SIZE[0])
    write_png(tmp_path / "d.png", values)
    depth = images.read_depth(tmp_path / "d.png", SIZE)
    assert depth.dtype == np.float32
    assert np.allclose(depth, values / np.iinfo(dtype).max)


def test_complete_depth_of_half_the_size_is_interpolated(tmp_path):
    ramp = np.tile(np.linspace(0.2, 0.8, SIZE[0] // 2, dtype=np.float32), (SIZE[1] // 2, 1))
    write_array(tmp_path / "d.npy", ramp)
    depth = images.read_depth(tmp_path / "d.npy", SIZE)
    assert depth.shape == (SIZE[1], SIZE[0])
    assert np.ptp(np.diff(depth[0, 1:-1])) < 1e-3


def test_depth_with_unknown_pixels_is_resized_without_new_values(tmp_path):
    values = np.full((SIZE[1] // 2, SIZE[0] // 2), 2.0, np.float32)
    values[3:6, 4:9] = 0
    values[8, 8] = np.inf
    write_array(tmp_path / "d.npy", values)
    depth = images.read_depth(tmp_path / "d.npy", SIZE)
    assert set(np.unique(depth[~np.isnan(depth)])) == {0.0, 2.0}
    assert np.isnan(depth).sum() == 4


def test_depth_of_three_channels_is_refused(path):
    with pytest.raises(ValueError, match="one channel"):
        images.read_depth(path, SIZE)


@pytest.mark.parametrize(
    ("dtype", "bright"), [("uint8", 1), ("uint8", 255), ("uint16", 1), ("uint16", 255), ("uint16", 65535)]
)
def test_a_mask_is_true_where_it_has_its_maximum(tmp_path, dtype, bright):
    mask = (dynamic_block() > 127).astype(dtype) * np.array(bright, dtype)
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    assert np.array_equal(images.read_mask(tmp_path / "mask.png", SIZE), dynamic_block() > 127)
