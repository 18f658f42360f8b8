"""Loaders read captures as the real datasets have them."""

import dataclasses
import json
import shutil
import tarfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from tests.data import captures
from tests.data.captures import CENTER, SCALE, SIZE, edit_json, image_of, write_array, write_capture, write_json
from warpgs.cameras import Camera
from warpgs.captures.opening import load_capture, open_capture
from warpgs.config import MaskPerturbation
from warpgs.config.presets import PRESETS
from warpgs.data import loaders
from warpgs.data.capture import Capture, Frame
from warpgs.data.lens import Lens
from warpgs.data.loaders import LOADERS, LoadOptions, recognize

DATASETS = pytest.mark.parametrize("dataset", ["nerfds", "hypernerf", "iphone"])


@pytest.fixture
def iphone(tmp_path):
    return write_capture(tmp_path / "toy", "iphone")


@pytest.fixture
def hypernerf(tmp_path):
    return write_capture(tmp_path / "toy", "hypernerf")


@DATASETS
def test_each_dataset_is_recognized_from_its_files_and_read_completely(tmp_path, dataset):
    root = write_capture(tmp_path / "vrig-misleading", dataset)
    assert recognize(root) == dataset
    scene = load_capture(root)
    train, val = captures.ids_of(dataset)
    assert (scene.train, scene.val) == (tuple(train), tuple(val))
    size = (SIZE[0] // captures.FACTORS[dataset], SIZE[1] // captures.FACTORS[dataset])
    for name in (*train, *val):
        frame = scene.frame(name)
        assert frame.camera.size == size
        assert np.array_equal(frame.image.numpy(), image_of(name, size))
        assert (frame.static_mask is not None) == (dataset == "nerfds")
        assert (frame.inverse_depth is not None) == (dataset == "iphone" and name in train)
        assert (frame.covisible is not None) == (dataset == "iphone" and name in val)


def test_each_loader_is_asked_at_most_once_until_a_capture_is_open_and_its_layout_known(iphone, monkeypatch):
    asked = []

    def counted(name, loader):
        return SimpleNamespace(recognizes=lambda root: asked.append(name) or loader.recognizes(root), load=loader.load)

    for name, loader in [*LOADERS.items()]:
        monkeypatch.setitem(LOADERS, name, counted(name, loader))
    assert load_capture(iphone).layout == "iphone"
    assert len(asked) == len(set(asked))


def test_hypernerf_captures_with_dychecks_additions_are_recognized(hypernerf):
    write_json(hypernerf / "splits/train_mono.json", {"frame_names": []})
    write_json(hypernerf / "extra.json", {})
    (hypernerf / "covisible/2x/val_mono").mkdir(parents=True)
    assert recognize(hypernerf) == "hypernerf"


def test_an_iphone_capture_without_splits_is_recognized_by_its_depth(iphone):
    shutil.rmtree(iphone / "splits")
    shutil.rmtree(iphone / "covisible")
    assert recognize(iphone) == "iphone"


def test_an_iphone_capture_without_any_split_trains_on_camera_0(iphone):
    shutil.rmtree(iphone / "splits")
    edit_json(iphone / "dataset.json", train_ids=None, val_ids=None)
    scene = load_capture(iphone)
    assert (list(scene.train), list(scene.val)) == captures.ids_of("iphone")


def test_a_single_camera_iphone_capture_has_no_evaluation_frames(iphone):
    write_json(iphone / "splits/val.json", {"frame_names": []})
    assert load_capture(iphone).val == ()


@DATASETS
def test_points_are_projected_as_the_camera_model_of_the_files_defines(tmp_path, dataset):
    root = write_capture(tmp_path / "toy", dataset)
    name, factor = captures.ids_of(dataset)[0][2], captures.FACTORS[dataset]
    edit_json(root / f"camera/{name}.json", pixel_aspect_ratio=1.25)
    fields = json.loads((root / f"camera/{name}.json").read_text())
    world = np.array([0.4, -0.3, 1.0])
    x, y, z = np.array(fields["orientation"]) @ (world - fields["position"])
    u = fields["focal_length"] * x / z + fields["principal_point"][0]
    v = 1.25 * fields["focal_length"] * y / z + fields["principal_point"][1]
    camera = load_capture(root).cameras[name]
    scene = torch.tensor((world - CENTER) * SCALE, dtype=torch.float32)
    viewed = camera.viewmat[:3, :3] @ scene + camera.viewmat[:3, 3]
    pixel = camera.K @ viewed / viewed[2]
    assert viewed[2] == pytest.approx(SCALE * z, rel=1e-5)
    assert torch.allclose(pixel, torch.tensor([u / factor, v / factor, 1.0], dtype=torch.float32), atol=1e-4)


def test_the_ray_of_a_pixel_centre_is_that_of_nerfies(root):
    """Nerfies casts the ray of pixel (column, row) through (column + 0.5, row + 0.5) of the file's coordinates."""
    name = captures.ids_of("nerfds")[0][1]
    fields = json.loads((root / f"camera/{name}.json").read_text())
    local = (np.array([7.5, 3.5]) - fields["principal_point"]) / fields["focal_length"]
    world = np.array(fields["orientation"]).T @ (2.0 * np.array([*local, 1.0])) + fields["position"]
    ours = load_capture(root).cameras[name].unproject(torch.tensor([3]), torch.tensor([7]), torch.tensor([2.0 * SCALE]))
    assert torch.allclose(ours[0], torch.tensor((world - CENTER) * SCALE, dtype=torch.float32), atol=1e-5)


def test_odd_sizes_are_rounded_as_in_nerfies(hypernerf):
    for path in (hypernerf / "camera").iterdir():
        edit_json(path, image_size=[39, 23])
    assert {camera.size for camera in load_capture(hypernerf).cameras.values()} == {(20, 12)}


def test_old_camera_files_may_call_the_tangential_distortion_tangential(root):
    path = root / "camera/left_000000.json"
    edit_json(path, tangential_distortion=None, tangential=[0.02, 0.01])
    assert Lens.of(load_capture(root).cameras["left_000000"]).coefficients == pytest.approx((0.0, 0.0, 0.02, 0.01))


def test_a_third_tangential_coefficient_may_be_zero(root):
    edit_json(root / "camera/left_000000.json", tangential_distortion=[0.0, 0.0, 0.0])
    assert len(load_capture(root).train) == 4


@pytest.mark.parametrize(
    ("fields", "model", "coefficients"),
    [
        ({"radial_distortion": [0.3, 0.1, 0.02]}, "radial", (0.3, 0.1, 0.0, 0.0, 0.02)),
        ({"rational_distortion": [0.1, 0.02, 0.03]}, "radial", (*[0.0] * 5, 0.1, 0.02, 0.03)),
        ({"prism_distortion": [0.01, 0.0, 0.02, 0.0]}, "radial", (*[0.0] * 8, 0.01, 0.0, 0.02)),
        ({"fisheye_distortion": [0.1, 0.0, 0.01, 0.0]}, "fisheye", (0.1, 0.0, 0.01)),
        ({"fisheye_distortion": [0.0] * 4}, "fisheye", ()),
    ],
)
def test_frames_are_as_recorded_and_cameras_have_the_distortion_of_their_lens(root, fields, model, coefficients):
    edit_json(root / "camera/left_000000.json", **fields)
    scene = load_capture(root)
    frame, pinhole = scene.frame("left_000000"), scene.frame("left_000001")
    found = Lens.of(frame.camera)
    assert found.model == model
    assert found.coefficients == pytest.approx(coefficients)
    assert torch.equal(frame.camera.K, pinhole.camera.K)
    assert pinhole.camera.distortion is None
    assert np.array_equal(frame.image.numpy(), image_of("left_000000"))
    assert torch.equal(frame.static_mask, pinhole.static_mask)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"radial_distortion": [-500.0, 0.0, 0.0]}, "the lens folds back inside the image"),
        ({"fisheye_distortion": [-3.0, 0.0, 0.0, 0.0]}, "the lens folds back inside the image"),
        ({"radial_distortion": [float("nan"), 0.0, 0.0]}, "radial_distortion"),
        (
            {"fisheye_distortion": [0.1], "radial_distortion": [0.1]},
            "a fisheye_distortion cannot have",
        ),
    ],
)
def test_a_lens_that_cannot_be_used_is_refused_with_its_file(root, fields, message):
    edit_json(root / "camera/left_000000.json", **fields)
    with pytest.raises(ValueError, match=f"camera/left_000000.json.*{message}"):
        load_capture(root)


def test_depth_of_a_fisheye_capture_is_the_distance(root):
    captures.write_array(root / "depth/1x/left_000000.npy", np.full(SIZE[::-1], 0.5))
    edit_json(root / "camera/left_000000.json", fisheye_distortion=[0.1, 0.0, 0.0, 0.0])
    frame = load_capture(root).frame("left_000000")
    row, column = torch.tensor([3, 20]), torch.tensor([2, 30])
    points = frame.camera.unproject(row, column, 1.0 / frame.inverse_depth[row, column])
    along_axis = (points - frame.camera.position) @ frame.camera.viewmat[2, :3]
    assert along_axis.tolist() == pytest.approx([2.0, 2.0], rel=1e-4)


@pytest.mark.parametrize("k1", [0.8, -500.0])
@DATASETS
def test_without_distortion_cameras_are_pinholes_that_look_at_their_centre(tmp_path, dataset, k1):
    plain, bent = (write_capture(tmp_path / name, dataset) for name in ("plain", "bent"))
    for path in (bent / "camera").iterdir():
        edit_json(path, radial_distortion=[k1, 0.1, 0.0], tangential_distortion=[0.02, 0.01])
    depth = np.linspace(0.1, 0.9, SIZE[0] * SIZE[1]).reshape(SIZE[1], SIZE[0])
    if dataset != "iphone":
        for root in (plain, bent):
            captures.write_array(root / "depth/1x/left_000000.npy", depth)
    factor = captures.FACTORS[dataset]
    capture, expected = load_capture(bent, factor=factor, distortion=False), load_capture(plain)
    for name, camera in capture.cameras.items():
        assert camera.distortion is None
        width, height = camera.size
        K = [[50.0 / factor, 0, width / 2], [0, 50.0 / factor, height / 2], [0, 0, 1]]
        assert torch.equal(camera.K, torch.tensor(K, dtype=torch.float32))
        assert torch.equal(camera.viewmat, expected.cameras[name].viewmat)
        frame, other = capture.frame(name), expected.frame(name)
        assert np.array_equal(frame.image.numpy(), image_of(name, camera.size))
        for part in ("static_mask", "inverse_depth", "covisible"):
            a, b = getattr(frame, part), getattr(other, part)
            assert a is b is None or torch.equal(a, b)
    assert capture.frame(capture.train[0]).inverse_depth is not None


def test_only_depth_of_a_sensor_is_metric(iphone, tmp_path):
    scale = json.loads((iphone / "scene.json").read_text())["scale"]
    assert load_capture(iphone).metric_depth
    assert load_capture(iphone).metres == pytest.approx(1 / scale)
    other = load_capture(write_capture(tmp_path / "other"))
    assert not other.metric_depth
    assert other.metres is None
    shutil.copy(iphone / "depth/2x/0_00000.npy", tmp_path / "kept.npy")
    (iphone / "depth/2x/0_00000.npy").unlink()
    captures.write_png(iphone / "depth/2x/0_00000.png", np.full((12, 20), 100, np.uint8))
    assert not load_capture(iphone).metric_depth
    assert load_capture(iphone).metres is None


def test_captures_of_two_cameras_have_a_factor_of_their_own_as_in_the_preset_paper(hypernerf):
    for path in (hypernerf / "rgb/2x").iterdir():
        captures.write_png(hypernerf / "rgb/4x" / path.name, image_of(path.stem, (SIZE[0] // 4, SIZE[1] // 4)))
    sizes = [load_capture(hypernerf, distortion=bends).cameras["left_000000"].width for bends in (True, False)]
    assert sizes == [SIZE[0] // 2, SIZE[0] // 4]
    assert load_capture(hypernerf, factor=2, distortion=False).cameras["left_000000"].width == SIZE[0] // 2
    config = dataclasses.replace(PRESETS["paper"], data=hypernerf)
    assert open_capture(config).cameras["left_000000"].width == SIZE[0] // 4


def test_captures_of_one_camera_keep_the_factor_of_the_dataset(hypernerf):
    edit_json(hypernerf / "dataset.json", val_ids=[])
    assert load_capture(hypernerf, distortion=False).cameras["left_000000"].width == SIZE[0] // 2


def test_iphone_depth_is_unknown_where_the_sensor_has_no_value_or_a_clamped_one(iphone):
    path = iphone / "depth/2x/0_00000.npy"
    depth = np.load(path)
    depth[0, 0], depth[0, 1], depth[0, 2] = 0.0, 3.0, np.nan
    write_array(path, depth)
    inverse = load_capture(iphone).frame("0_00000").inverse_depth
    assert inverse[0, :3].isnan().all()
    assert inverse.isnan().sum() == 3
    assert inverse[5, 5] == pytest.approx(1.0 / (2.0 * SCALE))


def test_full_size_depth_is_used_with_any_factor(hypernerf):
    name = captures.ids_of("hypernerf")[0][0]
    captures.write_png(hypernerf / f"depth/1x/{name}.png", np.full((SIZE[1], SIZE[0]), 51, np.uint8))
    inverse = load_capture(hypernerf).frame(name).inverse_depth
    assert inverse.shape == (SIZE[1] // 2, SIZE[0] // 2)
    assert torch.allclose(inverse, torch.tensor(0.2))


def test_an_evaluation_frame_may_lack_its_mask(root):
    (root / "resized_mask/1x/right_000000.png.png").unlink()
    assert load_capture(root).frame("right_000000").static_mask is None


def test_masks_may_be_in_a_folder_called_mask(root):
    (root / "resized_mask").rename(root / "mask")
    assert not load_capture(root, "nerfds").frame("left_000000").static_mask[5, 5]


def test_only_training_masks_are_perturbed(root):
    scene = load_capture(root, perturbation=MaskPerturbation(dilate=2))
    truth = torch.from_numpy(captures.dynamic_block() == 255)
    assert scene.frame("left_000000").static_mask.sum() < truth.sum()
    assert torch.equal(scene.frame("right_000000").static_mask, truth)


def test_opening_a_capture_reads_no_image(root):
    for path in (root / "rgb/1x").iterdir():
        path.write_bytes(b"")
    assert len(load_capture(root).train) == 4


def test_a_capture_without_points_opens(root):
    (root / "points.npy").unlink()
    assert load_capture(root).points.shape == (0, 3)


def test_without_a_points_file_points_and_colours_of_a_colmap_model_are_read(root):
    pycolmap = pytest.importorskip("pycolmap")
    (root / "points.npy").unlink()
    model = pycolmap.Reconstruction()
    xyz = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    for k, point in enumerate(xyz):
        model.add_point3D(point, pycolmap.Track(), np.array([10 * k, 20, 30], np.uint8))
    (root / "sparse/0").mkdir(parents=True)
    model.write(str(root / "sparse/0"))
    scene = load_capture(root)
    assert np.allclose(scene.points.numpy(), (xyz - CENTER) * SCALE)
    assert scene.point_colors.tolist() == [[0, 20, 30], [10, 20, 30]]


def test_a_single_time_is_0(root):
    edit_json(root / "dataset.json", train_ids=["left_000000"], val_ids=["right_000000"])
    assert [camera.time for camera in load_capture(root).cameras.values()] == [0.0, 0.0]


def test_interpolation_captures_train_on_every_fourth_frame_and_evaluate_halfway(hypernerf):
    train, val = captures.ids_of("hypernerf")
    ids = [train[0], val[0], train[1], val[1], *train[2:]]
    edit_json(hypernerf / "dataset.json", ids=ids, train_ids=ids, val_ids=[])
    scene = load_capture(hypernerf)
    assert (scene.train, scene.val) == ((ids[0], ids[4]), (ids[2],))


def test_time_is_the_time_id_over_the_maximum_of_training_and_evaluation_frames(root):
    metadata = json.loads((root / "metadata.json").read_text())
    metadata["right_000002"]["time_id"] = 12
    metadata["left_000001"]["warp_id"] = 7
    write_json(root / "metadata.json", metadata)
    times = {name: camera.time for name, camera in load_capture(root).cameras.items()}
    assert (times["left_000000"], times["left_000001"], times["right_000002"]) == (0.0, 1 / 12, 1.0)


def test_without_a_time_id_time_is_the_warp_id(iphone):
    assert load_capture(iphone).cameras["1_00002"].time == pytest.approx(2 / 3)


def test_the_covisible_mask_is_true_where_bright(iphone):
    frame = load_capture(iphone).frame("1_00000")
    assert np.array_equal(frame.covisible.numpy(), captures.dynamic_block((SIZE[0] // 2, SIZE[1] // 2)) == 255)


ARCHIVE = Path(__file__).parents[3] / "shared/data/studio_a.tar"


def one_frame(root, name):
    """A capture of one frame of the path-traced capture, whose images are .webp files."""
    with tarfile.open(ARCHIVE) as tar:
        for member in tar:
            path = Path(*Path(member.name).parts[1:])
            if not member.isfile() or path.name.split(".")[0] not in (name, "scene", "dataset", "metadata", "points"):
                continue
            data = tar.extractfile(member).read()
            folder = path.parent if path.parts[0] == "camera" or len(path.parts) == 1 else path.parent / "1x"
            (root / folder).mkdir(parents=True, exist_ok=True)
            if path.suffix == ".webp":
                image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
                captures.write_png(root / folder / f"{name}.png", image[..., ::-1])
            else:
                (root / folder / path.name).write_bytes(data)
    edit_json(root / "dataset.json", train_ids=[name], val_ids=[])
    return root


@pytest.mark.skipif(not ARCHIVE.exists(), reason="the path-traced capture is not on this machine")
def test_the_points_of_a_real_capture_agree_with_its_depth(tmp_path):
    """Compared by rank: depth has an unknown scale and offset, and some points are hidden."""
    scene = load_capture(one_frame(tmp_path, "left_000040"))
    frame = scene.frame("left_000040")
    row, column, depth, inside = frame.camera.project(scene.points)
    seen = inside & frame.static_mask[row, column]
    pairs = torch.stack([frame.inverse_depth[row, column], 1.0 / depth])[:, seen]
    ranks = pairs.argsort(1).argsort(1).double()
    assert seen.sum() > 1000
    assert 0.8 < frame.static_mask.float().mean() < 0.99
    assert torch.corrcoef(ranks)[0, 1] > 0.9


def test_a_capture_with_full_size_images_only_is_nerfds_even_without_masks(root):
    shutil.rmtree(root / "resized_mask")
    assert recognize(root) == "nerfds"


class TextLoader:
    """A layout that has nothing in common with that of Nerfies."""

    def recognizes(self, root):
        return (root / "capture.txt").is_file()

    def load(self, root, options):
        self.options = options
        camera = Camera(torch.eye(4), torch.eye(3), 4, 2)
        frame = Frame("a", camera, torch.zeros(2, 4, 3, dtype=torch.uint8))
        name = (root / "capture.txt").read_text()
        return Capture(name, {"a": camera}, ["a"], [], torch.zeros(0, 3), None, lambda _: frame)


def test_a_dataset_is_added_by_one_entry(tmp_path, monkeypatch):
    loader = TextLoader()
    monkeypatch.setitem(LOADERS, "text", loader)
    (tmp_path / "capture.txt").write_text("mine")
    assert recognize(tmp_path) == "text"
    assert load_capture(tmp_path).name == "mine"
    assert loader.options == LoadOptions()
    options = {"factor": 3, "perturbation": MaskPerturbation(erode=1), "cache_frames": 7, "distortion": False}
    load_capture(tmp_path, "text", **options)
    assert loader.options == LoadOptions(**options)


def test_a_folder_that_no_loader_recognizes_is_read_as_the_fallback(tmp_path):
    assert recognize(tmp_path) == loaders.FALLBACK
    assert loaders.FALLBACK in LOADERS


def test_a_capture_is_opened_by_a_string_as_well(root):
    assert load_capture(str(root)).train == load_capture(root).train
