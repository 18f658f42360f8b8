"""Depth and masks of networks: files of their layouts."""

import cv2
import numpy as np
import pytest

from tests.data import layouts
from warpgs.data.results import depth as of_depth
from warpgs.data.results import masks as of_masks
from warpgs.data.results.checked import checked
from warpgs.data.results.depth import read_depths
from warpgs.data.results.masks import read_masks, read_object_mask
from warpgs.files import write_png

SIZE = (56, 42)
NAMES, SIZES = ["a", "b"], [SIZE, SIZE]


@pytest.fixture
def depths():
    """Depth [F, h, w] of two frames at half the size, unknown in a corner."""
    found = np.random.default_rng(0).uniform(1.0, 5.0, (2, 21, 28)).astype(np.float32)
    found[:, 0, 0] = np.inf
    return found


def inverse(depths):
    return np.where(np.isfinite(depths), 1.0 / depths, np.nan)


def refused(read, path, match):
    with pytest.raises(ValueError, match=match) as caught:
        [*read(path, NAMES, SIZES)]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("axis", [False, True], ids=["Depth Anything 3", "VGGT"])
def test_depth_of_all_frames_in_one_file_becomes_inverse_depth(tmp_path, depths, axis):
    np.savez(tmp_path / "results.npz", depth=depths[..., None] if axis else depths, conf=np.ones_like(depths))
    found = [*read_depths(tmp_path / "results.npz", NAMES, SIZES)]
    np.testing.assert_allclose(np.array(found), inverse(depths), rtol=1e-6)


@pytest.mark.parametrize(
    ("module", "read", "array"), [(of_depth, read_depths, "depth"), (of_masks, read_masks, "masks")]
)
def test_a_file_of_all_frames_is_read_once_and_checked_before_the_first_is_given(
    tmp_path, monkeypatch, module, read, array
):
    path, reads = tmp_path / "results.npz", []
    read_npz = module.read_npz
    monkeypatch.setattr(module, "read_npz", lambda *arguments: reads.append(arguments) or read_npz(*arguments))
    np.savez(path, **{array: np.ones((2, *SIZE[::-1]), np.float32)})
    assert len([*checked(read, path, NAMES, SIZES)]) == 2
    assert len(reads) == 1
    with pytest.raises(ValueError, match=r"results\.npz"):
        checked(read, path, NAMES, [SIZE, (SIZE[0], 2 * SIZE[1])])


@pytest.mark.parametrize("file", ["{}/depth.npy", "{}.npy"])
def test_depth_of_moge_is_in_a_file_of_each_frame(tmp_path, depths, file):
    for name, depth in zip(NAMES, depths, strict=True):
        path = tmp_path / file.format(name)
        path.parent.mkdir(exist_ok=True)
        np.save(path, depth)
    np.testing.assert_allclose(np.array([*read_depths(tmp_path, NAMES, SIZES)]), inverse(depths), rtol=1e-6)


def test_depth_of_moge_is_read_from_openexr(tmp_path, depths):
    for name, depth in zip(NAMES, depths, strict=True):
        (tmp_path / name).mkdir()
        data = layouts.exr(depth, "Y")
        (tmp_path / name / "depth.exr").write_bytes(data)
    np.testing.assert_allclose(np.array([*read_depths(tmp_path, NAMES, SIZES)]), inverse(depths), rtol=1e-3)


def test_depth_with_sides_rounded_to_14_gets_the_shape_of_the_frame(tmp_path):
    """504×378 of 1000×750 pixels is exact, 504×280 of 1920×1080 is 3.5 rows too low."""
    np.savez(tmp_path / "results.npz", depth=np.full((2, 280, 504), 2.0, np.float32))
    found = [*read_depths(tmp_path / "results.npz", NAMES, [(1920, 1080)] * 2)]
    assert [plane.shape for plane in found] == [(284, 504)] * 2
    assert (found[0] == 0.5).all()


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"conf": np.ones((2, 21, 28))}, "has no array depth"),
        ({"depth": np.ones((3, 21, 28))}, r"must be \[N, H, W\] of the camera's 2 frames, got \[3, 21, 28\]"),
        ({"depth": np.ones((2, 28, 21))}, "depth of 21×28 pixels has not the shape of frames of 56×42"),
    ],
)
def test_depth_that_does_not_fit_is_refused(tmp_path, arrays, match):
    np.savez(tmp_path / "results.npz", **arrays)
    refused(read_depths, tmp_path / "results.npz", match)


def test_a_frame_without_depth_is_named(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((21, 28)))
    refused(read_depths, tmp_path, "has no depth of frame b")


@pytest.fixture
def dynamic():
    """What moves [F, H, W]: an object in both frames, another one in the second."""
    found = np.zeros((2, *SIZE[::-1]), bool)
    found[:, 10:20, 12:30] = True
    found[1, 30:35, 40:50] = True
    return found


def test_masks_of_all_frames_are_joined_over_objects(tmp_path, dynamic):
    objects = np.zeros((2, 2, *SIZE[::-1]), bool)
    objects[0, 0], objects[1, 0], objects[1, 1] = dynamic[0], dynamic[0], dynamic[1] & ~dynamic[0]
    for name in ("masks", "out_binary_masks"):
        np.savez(tmp_path / f"{name}.npz", **{name: objects})
        np.testing.assert_array_equal([*read_masks(tmp_path / f"{name}.npz", NAMES, SIZES)], dynamic)


def test_logits_are_of_an_object_where_positive(tmp_path, dynamic):
    np.savez(tmp_path / "masks.npz", masks=np.where(dynamic, 3.0, -3.0))
    np.testing.assert_array_equal([*read_masks(tmp_path / "masks.npz", NAMES, SIZES)], dynamic)


def test_masks_of_each_frame_are_named_like_it(tmp_path, dynamic):
    np.savez(tmp_path / "a.npz", out_binary_masks=dynamic[:1])
    write_png(tmp_path / "b.png", np.where(dynamic[1], 0, 255).astype(np.uint8))
    np.testing.assert_array_equal([*read_masks(tmp_path, NAMES, SIZES)], dynamic)


def write_with_palette(path, ids, colors):
    """Writes ids [H, W] as a PNG file with a palette."""
    import struct
    import zlib

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = ids.shape
    rows = b"".join(b"\0" + row.tobytes() for row in ids.astype(np.uint8))
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    parts = [(b"IHDR", header), (b"PLTE", np.array(colors, np.uint8).tobytes()), (b"IDAT", zlib.compress(rows))]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in [*parts, (b"IEND", b"")]))


DAVIS = [[0, 0, 0], [128, 0, 0], [0, 128, 0]]


def test_ids_of_a_palette_are_objects_and_0_is_static(tmp_path, dynamic):
    write_with_palette(tmp_path / "a.png", np.where(dynamic[1], 2, 0), DAVIS)
    np.testing.assert_array_equal(read_object_mask(tmp_path / "a.png", SIZE), dynamic[1])


def test_ids_are_told_apart_by_their_numbers_not_by_their_colours(tmp_path, dynamic):
    write_with_palette(tmp_path / "a.png", np.where(dynamic[1], 1, 0), [[0, 0, 0], [0, 0, 0], [0, 128, 0]])
    np.testing.assert_array_equal(read_object_mask(tmp_path / "a.png", SIZE), dynamic[1])


@pytest.mark.parametrize(
    ("values", "message"),
    [((0, 3), "has levels of 0 to 3, but no palette"), (([0, 0, 0], [0, 0, 128]), "has colours, but no palette")],
)
def test_ids_without_a_palette_are_refused(tmp_path, dynamic, values, message):
    static, moving = (np.array(value, np.uint8) for value in values)
    mask = np.where(dynamic[1][..., None] if moving.ndim else dynamic[1], moving, static)
    cv2.imwrite(str(tmp_path / "a.png"), mask)
    with pytest.raises(ValueError, match=message):
        read_object_mask(tmp_path / "a.png", SIZE)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_mask_with_soft_edges_or_of_jpeg_is_dynamic_where_it_is_dark(tmp_path, dynamic, suffix):
    soft = cv2.GaussianBlur(np.where(dynamic[1], 0, 255).astype(np.uint8), (3, 3), 0)
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), cv2.cvtColor(soft, cv2.COLOR_GRAY2BGR))
    assert (read_object_mask(tmp_path / f"a.{suffix}", SIZE) == dynamic[1]).mean() > 0.97


def test_a_palette_of_black_and_white_is_0_where_dynamic(tmp_path, dynamic):
    write_with_palette(tmp_path / "a.png", np.where(dynamic[1], 0, 1), [[0, 0, 0], [255, 255, 255]])
    np.testing.assert_array_equal(read_object_mask(tmp_path / "a.png", SIZE), dynamic[1])


def test_ids_without_their_palette_are_refused_by_the_name_of_the_file(tmp_path, dynamic):
    path = tmp_path / "a.png"
    write_with_palette(path, np.where(dynamic[1], 2, 0), DAVIS)
    before, after = path.read_bytes().split(b"PLTE")
    path.write_bytes(before[:-4] + after[3 * len(DAVIS) + 4 :])  # without the chunk's length, colours and checksum
    with pytest.raises(ValueError, match=r"a\.png is damaged: it has no palette"):
        read_object_mask(path, SIZE)


def test_a_pixel_of_reduced_ids_is_dynamic_if_any_part_of_it_is(tmp_path):
    ids = np.zeros((84, 112), int)
    ids[10, 31] = 1
    write_with_palette(tmp_path / "a.png", ids, DAVIS)
    assert np.argwhere(read_object_mask(tmp_path / "a.png", SIZE)).tolist() == [[5, 15]]


@pytest.mark.parametrize(
    ("masks", "match"),
    [
        (np.ones((3, 42, 56)), r"must be \[N, H, W\] of the camera's 2 frames, got \[3, 42, 56\]"),
        (np.ones((2, 56, 42)), "the mask is 42×56, but the images of its camera are 56×42"),
        (np.ones((2, 42)), r"must be \[N, H, W\]"),
    ],
)
def test_masks_that_do_not_fit_are_refused(tmp_path, masks, match):
    np.savez(tmp_path / "masks.npz", masks=masks)
    refused(read_masks, tmp_path / "masks.npz", match)


def test_a_frame_without_a_mask_is_named(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros(SIZE[::-1], np.uint8))
    refused(read_masks, tmp_path, "has no mask of frame b")


def test_a_file_without_masks_is_refused(tmp_path):
    np.savez(tmp_path / "masks.npz", ids=np.ones(3))
    refused(read_masks, tmp_path / "masks.npz", "has no array masks or out_binary_masks")
