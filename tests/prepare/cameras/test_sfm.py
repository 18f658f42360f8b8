"""COLMAP in a process of its own: what it is asked, what it answers, and how it ends."""

import itertools
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from tests.prepare import boards
from warpgs.data.lens import Lens
from warpgs.prepare.cameras import colmap, focal_guess, mapping, sfm
from warpgs.prepare.cameras.features import Job
from warpgs.prepare.cameras.focal_guess import calibrated
from warpgs.prepare.cameras.mapping import _map_globally, reconstruct, refine
from warpgs.prepare.cameras.matches import all_pairs, cross_pairs, revisit_pairs, sequence_pairs
from warpgs.prepare.cameras.recovered import Cameras, NoCamerasError
from warpgs.prepare.cameras.sfm import Settings, recover_cameras


def answer(monkeypatch, code: str) -> None:
    """Replaces COLMAP's process by some lines of Python."""
    real = subprocess.Popen

    def start(command, **options):
        return real([sys.executable, "-c", textwrap.dedent(code)], **options)

    monkeypatch.setattr(sfm.subprocess, "Popen", start)


def test_a_crash_is_one_line_with_its_signal(tmp_path, monkeypatch):
    answer(monkeypatch, 'import os, sys; print(\'{"label": "a", "done": 1, "total": 2}\'); os.abort()')
    with pytest.raises(ValueError, match=r"^COLMAP failed on .*: its process ended with SIGABRT$"):
        recover_cameras(tmp_path, ["a"], tmp_path / "work", Settings())


def test_a_full_disk_is_named_as_such(tmp_path, monkeypatch):
    answer(monkeypatch, "import os; os.abort()")
    monkeypatch.setattr(sfm.shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(OSError, match="No space left on device"):
        recover_cameras(tmp_path, ["a"], tmp_path / "work", Settings())


@pytest.mark.parametrize(("unsuitable", "kind"), [("true", NoCamerasError), ("false", ValueError)])
def test_errors_come_back_with_their_kind(unsuitable, kind, tmp_path, monkeypatch):
    answer(monkeypatch, f'print(\'{{"error": "too dark", "unsuitable": {unsuitable}}}\')')
    with pytest.raises(ValueError, match="too dark") as caught:
        recover_cameras(tmp_path, ["a"], tmp_path / "work", Settings())
    assert type(caught.value) is kind


def test_what_libraries_print_is_no_answer(tmp_path, monkeypatch):
    answer(
        monkeypatch,
        """
        import os
        from warpgs.prepare.cameras import colmap, recovered

        def run(job, show):
            os.write(1, b"BLAS : Bad memory unallocation!\\n")
            raise recovered.NoCamerasError("too dark")

        colmap.run = run
        colmap.main()
        """,
    )
    with pytest.raises(NoCamerasError, match="too dark"):
        recover_cameras(tmp_path, ["a"], tmp_path / "work", Settings())
    assert "BLAS" in (tmp_path / "work" / sfm.LOG).read_text()


def test_an_interrupt_ends_the_process(tmp_path, monkeypatch):
    started = []
    real = subprocess.Popen

    def start(command, **options):
        code = 'import time; print(\'{"label": "a"}\', flush=True); time.sleep(600)'  # also when its input closes
        started.append(real([sys.executable, "-c", code], **options))
        return started[0]

    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sfm.subprocess, "Popen", start)
    monkeypatch.setattr(sfm.json, "loads", interrupted)
    with pytest.raises(KeyboardInterrupt):
        recover_cameras(tmp_path, ["a"], tmp_path / "work", Settings())
    assert started[0].returncode == -signal.SIGKILL


def test_colmap_ends_when_the_process_that_started_it_ends(tmp_path):
    """The input of COLMAP's process closes; it must not go on for minutes."""
    code = "from warpgs.prepare import colmap; colmap.run = lambda *_: __import__('time').sleep(60); colmap.main()"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
    job = '{"folder": "", "names": [], "work": "", "lens": "", "masks": null, "thorough": false, '
    job += '"weak_features": false, "focal": null, "refine": false}\n'
    start = time.monotonic()
    process.communicate(job.encode(), timeout=50)
    assert time.monotonic() - start < 50
    assert process.returncode == 1


@pytest.mark.parametrize(("num_cameras", "advice"), [(1, "move the camera sideways"), (2, "at most 20° apart")])
def test_the_advice_where_no_two_frames_match_suits_the_number_of_cameras(num_cameras, advice):
    assert advice in colmap.unmatched(num_cameras)
    assert ("move the camera" in colmap.unmatched(num_cameras)) == (num_cameras == 1)


def test_frames_are_matched_with_the_next_ones_and_at_powers_of_two():
    assert sequence_pairs(3) == all_pairs(3) == [(0, 1), (0, 2), (1, 2)]
    assert [b for a, b in sequence_pairs(100) if a == 0] == [*range(1, 11), 16, 32, 64]


def test_frames_of_two_cameras_are_matched_at_near_times_and_every_eighth_with_all():
    """The second camera starts half a frame later; a third one stands still, with one image."""
    groups = [[*range(20)], [*range(20, 40)], [40]]
    times = [*range(0, 2000, 100), *range(50, 2050, 100), 0]
    pairs = cross_pairs(groups, times)
    assert {(a, b) for a, b in pairs if a == 5 and b < 40} == {(5, 24), (5, 25)}
    assert {(a, b) for a, b in pairs if a == 8 and b < 40} == {(8, 20), (8, 27), (8, 28), (8, 36)}
    assert {(k, 40) for k in range(40)} <= {*pairs}
    assert cross_pairs(groups[:1], times) == []


def test_frames_that_see_the_same_points_much_later_are_matched():
    """A camera that goes sideways and comes back, in 60 frames; turned around in the last ten."""
    camera = SimpleNamespace(width=200, height=100, mean_focal_length=lambda: 100.0)
    points = {k: SimpleNamespace(xyz=np.array([0.05 * k - 2.0, 0.0, 5.0])) for k in range(700)}
    images = {}
    for k in range(60):
        x = 0.5 * min(k, 49 - k)
        pose = np.hstack([np.diag([1.0, 1.0, 1.0]) if k < 50 else np.diag([-1.0, 1.0, -1.0]), [[-x], [0.0], [0.0]]])
        seen = [i for i, p in points.items() if abs(p.xyz[0] - x) < 5.0] if k < 50 else []
        observed = [SimpleNamespace(point3D_id=i, has_point3D=lambda: True) for i in seen]
        images[k] = SimpleNamespace(
            name=f"{k}.png", has_pose=True, camera=camera, points2D=observed,
            cam_from_world=lambda pose=pose: SimpleNamespace(matrix=lambda: pose),
        )  # fmt: skip
    pairs = revisit_pairs(SimpleNamespace(images=images, points3D=points), [f"{k}.png" for k in range(60)])
    assert (5, 44) in pairs
    assert all(b - a > 10 and b < 50 for a, b in pairs)
    assert all(abs(min(a, 49 - a) - min(b, 49 - b)) <= 10 for a, b in pairs)


def test_frames_that_see_too_few_points_lose_their_camera():
    seen = {1: (True, 30), 2: (True, 29), 3: (False, 0), 4: (True, 500)}
    images = {k: SimpleNamespace(frame_id=10 + k, has_pose=p, num_points3D=n) for k, (p, n) in seen.items()}
    removed: list[int] = []
    model = SimpleNamespace(images=images, deregister_frame=removed.append)
    assert mapping._supported(model) is model
    assert removed == [12]


def recover(frames: Path, work: Path, **settings: object) -> Cameras:
    """The cameras of all frames of a folder."""
    names = [path.stem for path in sorted(frames.iterdir())]
    found = recover_cameras(frames, names, work, Settings(**settings))
    assert found.names == names
    return found


@pytest.fixture(scope="module")
def turning(tmp_path_factory) -> Path:
    """A camera that pans over an image."""
    return boards.write_folder(tmp_path_factory.mktemp("pan"), boards.pan(12))


def test_a_camera_that_only_turns_is_refused_and_named(turning, tmp_path):
    with pytest.raises(NoCamerasError, match=r"the camera only turns: a rotation explains \d+% of the matches"):
        recover(turning, tmp_path / "work", thorough=False)
    assert not (tmp_path / "work/model").exists()  # it was refused before mapping


def test_directions_and_focal_length_of_a_camera_that_turns_are_found(turning, tmp_path):
    found = recover(turning, tmp_path / "work", turns=True)
    assert abs(found.lens.focal[0] / boards.FOCAL - 1.0) < 0.01
    assert not found.have_parallax
    steps = [a.T @ b for a, b in itertools.pairwise(found.poses[:, :, :3])]
    angles = [np.arccos((np.trace(step) - 1.0) / 2.0) for step in steps]
    assert np.allclose(angles, 0.6 / 12, atol=0.012)  # and a little up and down


FISHEYE = Lens(*boards.SIZE, (112.0, 112.0), (130.0, 95.0), (0.04, -0.01, 0.002), "fisheye")


@pytest.mark.parametrize("known", [FISHEYE, None], ids=["known", "found"])
def test_cameras_with_a_fisheye_lens_are_found(known, tmp_path):
    """The lens sees 130° across, and 157° from corner to corner."""
    frames = boards.write_folder(tmp_path / "shots", boards.through_fisheye(8, FISHEYE))
    found = recover(frames, tmp_path / "work", **({"known": known} if known else {"lens": "OPENCV_FISHEYE"}))
    assert found.lens.model == "fisheye"
    assert known is None or found.lens == known
    u, v = np.meshgrid(np.linspace(20, 236, 9), np.linspace(20, 172, 7))
    seen, true = found.lens.unproject(u, v), FISHEYE.unproject(u, v)
    angles = [np.degrees(np.arctan(np.hypot(*rays))) for rays in (seen, true)]
    assert np.abs(angles[0] - angles[1]).max() < 2.5
    found.save(tmp_path / "cameras")
    assert Cameras.load(tmp_path / "cameras").lens == found.lens


def test_a_camera_that_passes_a_wall_needs_its_focal_length(tmp_path, monkeypatch):
    """Static surfaces shift as a whole, as in front of a camera of long focal length that turns."""
    size, generator = (640, 480), np.random.default_rng(0)
    firsts = [generator.uniform((0, 0), size, (100, 2)) for _ in range(12)]
    pairs = [(first, first - (2.0 * k, 0.0)) for k, first in enumerate(firsts, 1)]
    named = {("a", str(k)): pair for k, pair in enumerate(pairs)}
    monkeypatch.setattr(colmap, "verified_matches", lambda database: (named, size))

    def check(focal: float | None) -> None:
        work = str(tmp_path)
        job = Job(work, ["a"], work, "PINHOLE", None, False, False, focal, False)
        colmap._check_parallax(job, tmp_path / "features.db")

    with pytest.raises(NoCamerasError, match=r"over flat ground, give its focal length: --focal PX; masks alone"):
        check(None)
    check(500.0)
    with pytest.raises(NoCamerasError, match=r"instead of turning on the spot; masks alone"):  # it is given already
        check(4000.0)


def test_refinement_uses_the_features_of_the_first_pass(tmp_path):
    images, masks = boards.record(12)
    frames = boards.write_folder(tmp_path / "shots", images)
    for k, mask in enumerate(masks):
        boards.cv2.imwrite(str(tmp_path / f"shot{k:03d}.png.png"), np.where(mask, 0, 255).astype(np.uint8))
    recover(frames, tmp_path / "work", thorough=False)
    extracted = (tmp_path / "work/features.done").stat().st_mtime_ns
    refined = recover(frames, tmp_path / "work", masks=tmp_path, refine=True)
    assert (tmp_path / "work/features.done").stat().st_mtime_ns == extracted
    assert refined.error < 0.4  # that of the first pass, which what moves misleads, is 0.17 to 0.5: not deterministic
    assert abs(refined.lens.focal[0] / boards.FOCAL - 1.0) < 0.03


def wide_database(path: Path) -> list[str]:
    """A database of a wide lens, 240 px of 480, for which COLMAP guesses 576; returns the names of the frames."""
    scene = pycolmap.SyntheticDatasetOptions()
    scene.num_rigs, scene.num_frames_per_rig, scene.num_points3D = 1, 6, 100
    scene.camera_width, scene.camera_height, scene.camera_params = 480, 270, [240.0, 240.0, 135.0, 0.0]
    opened = pycolmap.Database.open(path)
    pycolmap.synthesize_dataset(scene, opened)
    set_focal(opened, 576.0)
    names = [Path(image.name).stem for image in opened.read_all_images()]
    opened.close()
    return names


def set_focal(opened: pycolmap.Database, focal: float) -> None:
    (camera,) = opened.read_all_cameras()
    camera.params = [focal, 240.0, 135.0, 0.0]
    opened.update_camera(camera)


def a_model(focal: float, error: float = 0.5, num_points: int = 100, placed: int = 6) -> SimpleNamespace:
    """A reconstruction of frames of 480×270, whose points are seen by four frames and have the same error [px]."""
    camera = SimpleNamespace(width=480, height=270, mean_focal_length=lambda: focal)
    point = SimpleNamespace(error=error, track=SimpleNamespace(length=lambda: 4))
    points = dict.fromkeys(range(num_points), point)
    return SimpleNamespace(images={}, cameras={1: camera}, points3D=points, num_reg_images=lambda: placed)


def agree_on(monkeypatch: pytest.MonkeyPatch, focal: float) -> None:
    """Lets the pairs agree on a focal length."""

    def calibrate(path: Path, options: object) -> bool:
        opened = pycolmap.Database.open(path)
        set_focal(opened, focal)
        opened.close()
        return True

    monkeypatch.setattr(pycolmap, "calibrate_view_graph", calibrate)


@pytest.mark.parametrize(
    ("agreed", "found", "starts", "kept"),
    [
        (400.0, {576.0: (300.0, 0.6)}, [576.0], 300.0),  # near the guess: it serves as well
        (250.0, {250.0: (240.0, 0.3)}, [250.0], 240.0),
        (150.0, {150.0: (240.0, 0.3), 576.0: (400.0, 0.6)}, [150.0, 576.0], 240.0),  # doubtful: the better one
        (150.0, {150.0: (90.0, 0.9), 576.0: (240.0, 0.3)}, [150.0, 576.0], 240.0),
    ],
)
def test_mapping_starts_from_the_focal_length_that_pairs_agree_on(agreed, found, starts, kept, tmp_path, monkeypatch):
    """``found``: by start, the focal length and the reprojection error that mapping ends with."""
    names, started = wide_database(tmp_path / "features.db"), []

    def map_globally(path: Path, *rest: object) -> dict[int, SimpleNamespace]:
        opened = pycolmap.Database.open(path)
        started.append(opened.read_all_cameras()[0].params[0])
        opened.close()
        focal, error = found[started[-1]]
        return {0: a_model(focal, error)}

    agree_on(monkeypatch, agreed)
    monkeypatch.setattr(pycolmap, "global_mapping", map_globally)
    job = Job(str(tmp_path), names, str(tmp_path), "SIMPLE_RADIAL", None, False, False, None, False)
    model = _map_globally(job, tmp_path / "features.db", lambda *progress: None)
    assert started == starts
    assert model.cameras[1].mean_focal_length() == kept
    assert not list(tmp_path.glob("*.calibrated.db"))


def test_the_focal_length_that_pairs_agree_on_is_the_true_one(tmp_path):
    """The cameras have random positions and directions, because those of ``wide_database`` look at one point."""
    wide_database(tmp_path / "features.db")
    opened, random = pycolmap.Database.open(tmp_path / "features.db"), np.random.default_rng(0)
    calibration = np.linalg.inv([[240.0, 0.0, 240.0], [0.0, 240.0, 135.0], [0.0, 0.0, 1.0]])
    poses = [(Rotation.from_rotvec(random.normal(size=3) * 0.3), random.normal(size=3)) for _ in range(7)]
    for key, pair in zip(*opened.read_two_view_geometries(), strict=True):
        a, b = pycolmap.pair_id_to_image_pair(key)
        turn = (poses[b][0] * poses[a][0].inv()).as_matrix()
        x, y, z = poses[b][1] - turn @ poses[a][1]
        essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ turn
        pair.F = calibration.T @ essential @ calibration
        pair.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
        opened.update_two_view_geometry(a, b, pair)
    opened.close()
    copy = calibrated(tmp_path / "features.db")
    assert copy != tmp_path / "features.db"
    assert focal_guess.read_focals(copy)[0] == pytest.approx(240.0, rel=0.02)


@pytest.mark.parametrize(("placed", "tried"), [(6, 1), (5, 2)])
def test_a_far_focal_length_that_loses_frames_has_a_rival(placed, tried, tmp_path, monkeypatch):
    names, started = wide_database(tmp_path / "features.db"), []

    def map_from(job: Job, path: Path) -> SimpleNamespace:
        started.append(path)
        return a_model(focal_guess.read_focals(path)[0], placed=placed)

    agree_on(monkeypatch, 240.0)
    monkeypatch.setattr(mapping, "_map_from", map_from)
    job = Job(str(tmp_path), names, str(tmp_path), "SIMPLE_RADIAL", None, False, False, None, False)
    assert _map_globally(job, tmp_path / "features.db", lambda *progress: None) is not None
    assert len(started) == tried


@pytest.mark.parametrize(
    ("found", "held", "kept"),
    [
        ((1000.0, 0.5, 100), None, None),  # plausible
        ((4800.0, 0.5, 100), (0.6, 110), 576.0),  # fewer points
        ((4800.0, 0.6, 100), (0.5, 100), 576.0),
        ((4800.0, 0.5, 100), (0.5, 90), None),  # the guess explains less: the lens is long
        ((150.0, 0.5, 100), (0.5, 100), 576.0),  # nothing speaks for the implausible one
    ],
)
def test_an_implausible_focal_length_must_explain_more_than_the_guess(found, held, kept, monkeypatch, tmp_path):
    """``found``: focal length, error [px] and number of points; ``held``: error and number with the guess held."""
    names, jobs = wide_database(tmp_path / "features.db"), []

    def map_all(job: Job, *rest: object) -> SimpleNamespace:
        jobs.append(job.focal)
        return a_model(*found) if job.focal is None else a_model(job.focal, *held)

    monkeypatch.setattr(mapping, "_map", map_all)
    job = Job(str(tmp_path), names, str(tmp_path), "SIMPLE_RADIAL", None, False, False, None, False)
    model, done = reconstruct(job, tmp_path / "features.db", lambda *progress: None)
    assert jobs == ([None] if held is None else [None, 576.0])
    assert done.focal == kept
    assert focal_guess.focal_of(model) == (kept or found[0])


@pytest.mark.parametrize(("drifts_to", "kept"), [(4800.0, 600.0), (700.0, 700.0)])
def test_refinement_does_not_make_a_plausible_focal_length_implausible(drifts_to, kept, monkeypatch):
    def adjust(job: Job, model: object) -> SimpleNamespace:
        return a_model(drifts_to if job.focal is None else job.focal)

    monkeypatch.setattr(mapping, "_adjusted", adjust)
    job = Job("", [], "", "SIMPLE_RADIAL", None, False, False, None, True)
    assert focal_guess.focal_of(refine(job, a_model(600.0), lambda *progress: None)) == kept


def test_a_known_focal_length_is_kept(tmp_path):
    frames = boards.write_folder(tmp_path / "shots", boards.record(10, moves=False)[0])
    assert recover(frames, tmp_path / "work", focal=boards.FOCAL).lens.focal == (boards.FOCAL, boards.FOCAL)
