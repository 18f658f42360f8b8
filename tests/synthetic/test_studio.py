"""The built-in benchmark."""

import hashlib
import itertools
import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rich
import torch

from warpgs.captures.opening import load_capture
from warpgs.config.builtin import Builtin, parse_builtin
from warpgs.synthetic import studio
from warpgs.synthetic.degraded_depth import DegradedDepth
from warpgs.synthetic.folder import builtin_folder
from warpgs.synthetic.open_sky import sky_colors
from warpgs.synthetic.studio import StudioSize, studio_capture, trace
from warpgs.synthetic.studio_tracks import exact_tracks, with_tracks

SMALL = StudioSize(width=64, height=36, num_frames=4, num_samples=2, num_points=200)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def capture(cache):
    return load_capture(studio_capture("exact", cache, SMALL, quiet=True))


def content(folder):
    """A hash of what the files say, whatever their compression."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(folder)).encode())
        if path.suffix == ".png":
            digest.update(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).tobytes())
        elif path.suffix == ".npy":
            digest.update(np.load(path).tobytes())
        else:
            digest.update(json.dumps(json.loads(path.read_text()), sort_keys=True).encode())
    return digest.hexdigest()


@pytest.mark.parametrize(
    ("depth", "expected"),
    [
        ("exact", "603ccbeafacfd2b02c0448ba97a6fa5e"),
        ("network", "c402b114bfdb361df9a3585c95051f79"),
        ("none", "1e7ae593b30b9e5e09347b0adb973e42"),
    ],
)
def test_the_content_is_the_same_everywhere(cache, depth, expected):
    assert content(studio_capture(depth, cache, SMALL, quiet=True)) == expected


def test_the_content_under_a_sky_is_the_same_everywhere(cache):
    assert content(studio_capture("exact", cache, SMALL, quiet=True, sky=True)) == "000dfeedf92b2bc76fa133d34f4bc5fa"


def test_under_a_sky_rays_end_nowhere_and_points_lie_on_surfaces(cache):
    image, depth, static = trace(0.0, 0.0, SMALL, sky=True)
    is_sky = depth > studio.MAX_DEPTH
    assert 0.25 < float(is_sky.float().mean()) < 0.5
    assert bool(static[is_sky].all())
    assert float(image[is_sky].min()) > 0.1
    assert float(image[is_sky].std()) > 0.1
    capture = load_capture(studio_capture("exact", cache, SMALL, quiet=True, sky=True))
    assert len(capture.points) == SMALL.num_points
    assert float(capture.points.norm(dim=1).max()) < 3.0


def test_colours_of_the_sky_depend_on_directions_alone(cache):
    directions = np.random.default_rng(0).standard_normal((20, 3))
    assert sky_colors(directions) == pytest.approx(sky_colors(7.0 * directions))
    assert 0.0 <= sky_colors(directions).min() < sky_colors(directions).max() <= 1.0


def test_names_tell_whether_the_studio_is_under_a_sky():
    assert parse_builtin("builtin:studio?depth=network&sky=yes") == Builtin("studio", "network", sky=True)
    assert not parse_builtin("builtin:studio?sky=no").sky
    for wrong in ("sky=blue", "sky=yes&tracks=exact"):
        with pytest.raises(ValueError, match="there is no built-in capture"):
            parse_builtin(f"builtin:studio?{wrong}")


def test_one_camera_trains_and_a_second_one_beside_it_evaluates(capture):
    assert capture.train == tuple(f"left_{k:06d}" for k in range(4))
    assert capture.val == ("right_000000", "right_000002")
    left, right = capture.cameras["left_000002"], capture.cameras["right_000002"]
    assert left.time == right.time
    shift = right.position - left.position
    assert float(shift.norm()) == pytest.approx(studio.BASELINE * studio.SCALE, rel=1e-4)
    assert float(shift @ left.viewmat[0, :3]) == pytest.approx(float(shift.norm()), rel=1e-4)


def test_points_lie_on_static_surfaces(capture):
    """Their depth through the camera that saw them is that of the frame, but for the noise."""
    per_frame = len(capture.points) // 4
    inverse = 1.0 / trace(0.0, 0.0, SMALL)[1]
    row, column, depth, inside = capture.cameras["left_000000"].project(capture.points[:per_frame])
    ratio = depth[inside] / studio.SCALE * inverse[row[inside], column[inside]]
    assert float((ratio - 1.0).abs().median()) < 0.01
    assert bool(capture.frame("left_000000").static_mask[row[inside], column[inside]].float().mean() > 0.95)


def test_exact_depth_is_inverse_depth_up_to_scale_and_offset(capture):
    inverse = capture.frame("left_000003").inverse_depth.flatten()
    assert torch.corrcoef(torch.stack([inverse, 1.0 / trace(1.0, 0.0, SMALL)[1].flatten()]))[0, 1] > 0.9999


def test_the_shape_and_the_place_of_what_moves_change():
    masks = [~trace(time, 0.0, SMALL)[2] for time in (0.0, 0.4)]
    assert all(0.02 < float(mask.float().mean()) < 0.3 for mask in masks)
    assert float((masks[0] & masks[1]).sum()) < 0.7 * float(masks[0].sum())


def test_a_network_is_wrong_by_a_few_percent_smoothly_and_moving_objects_by_more():
    flat, nothing = np.full((90, 160), 30_000.0), np.zeros((90, 160), bool)
    flat[:, :80] = 20_000.0
    errors = DegradedDepth(80)
    relative = [errors(k, flat, nothing)[5:-5, 90:] / 30_000.0 - 1.0 for k in range(0, 80, 8)]
    assert 0.05 < float(np.std(relative)) < 0.12
    assert max(float(np.abs(np.diff(error, axis=1)).max()) for error in relative) < 0.02
    moving = nothing.copy()
    moving[30:60, 100:130] = True
    shifts = [int(errors(k, flat, moving)[45, 115]) - int(errors(k, flat, nothing)[45, 115]) for k in range(80)]
    assert 200 < max(map(abs, shifts)) <= 1001
    assert max(abs(a - b) for a, b in itertools.pairwise(shifts)) < 800


def test_variants_differ_in_depth_only(cache):
    folders = {depth: studio_capture(depth, cache, SMALL, quiet=True) for depth in ("exact", "network", "none")}
    files = {depth: {str(p.relative_to(f)) for p in f.rglob("*.*")} for depth, f in folders.items()}
    assert files["network"] == files["exact"]
    assert {name for name in files["exact"] if not name.startswith("depth")} == files["none"]
    for name in files["none"]:
        assert (folders["none"] / name).read_bytes() == (folders["network"] / name).read_bytes()
    assert load_capture(folders["none"]).frame("left_000000").inverse_depth is None


def test_a_name_opens_the_capture_and_it_is_made_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(studio, "StudioSize", lambda num_frames: SMALL)
    capture = load_capture("builtin:studio?depth=none")
    assert len(capture.train) == 4
    assert re.search(r"making the built-in capture .*studio, once: this can take a minute\n", capsys.readouterr().err)
    monkeypatch.setattr(studio, "write_studio", lambda *_: pytest.fail("made again"))
    assert builtin_folder("builtin:studio").name == "studio"
    assert capsys.readouterr().err == ""
    assert load_capture("builtin:studio?depth=network").frame("left_000000").inverse_depth is not None


def test_a_name_tells_depth_and_number_of_frames():
    assert parse_builtin("builtin:studio") == Builtin("studio", "exact", 160)
    assert parse_builtin("builtin:studio?frames=12") == Builtin("studio", "exact", 12)
    assert parse_builtin("builtin:studio?frames=12&depth=none") == Builtin("studio", "none", 12)
    assert parse_builtin("builtin:room") == Builtin("room")


@pytest.mark.parametrize("name", ["studio?frames", "studio?frames=1", "studio?frames=161", "studio?frames=-3"])
def test_a_number_of_frames_that_the_studio_lacks_is_refused(name):
    with pytest.raises(ValueError, match="expected 2 to 160 frames, got"):
        parse_builtin(f"builtin:{name}")


@pytest.mark.parametrize("name", ["room?frames=12", "studio?frame=12", "studio?depth=12", "balls?depth=none"])
def test_an_option_that_a_built_in_capture_lacks_is_refused(name):
    with pytest.raises(ValueError, match=re.escape(f"there is no built-in capture builtin:{name}")):
        parse_builtin(f"builtin:{name}")


def test_fewer_frames_take_wider_steps_along_the_same_path(cache):
    many, few = (
        load_capture(studio_capture("none", cache, replace(SMALL, num_frames=number), quiet=True)) for number in (4, 2)
    )
    for k in (0, -1):
        assert torch.equal(few.cameras[few.train[k]].viewmat, many.cameras[many.train[k]].viewmat)
        assert few.cameras[few.train[k]].time == many.cameras[many.train[k]].time


@pytest.mark.parametrize("quiet", [False, True])
def test_a_terminal_shows_progress_while_it_is_made_unless_quiet(tmp_path, monkeypatch, capsys, quiet):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr(rich.get_console(), "is_interactive", True)  # it asked before
    studio_capture("exact", tmp_path, SMALL, quiet=quiet)
    shown = capsys.readouterr()
    assert ("creating builtin:studio, once for all runs" in shown.out) is not quiet
    assert ("making the built-in capture" in shown.err) is not quiet


@pytest.mark.parametrize(
    "name", ["", "studi", "studio?depth=", "studio?", "room?depth=none", "studio?depth=depth=none"]
)
def test_an_unknown_name_lists_those_that_are(name):
    with pytest.raises(ValueError, match=r"there is no built-in capture builtin:.*, expected one of builtin:room"):
        load_capture(f"builtin:{name}")


def test_a_size_that_no_built_in_capture_has_is_refused_before_it_is_made(monkeypatch):
    monkeypatch.setattr(studio, "write_studio", lambda *_: pytest.fail("made"))
    with pytest.raises(ValueError, match="builtin:studio has images of one size: omit --factor 3"):
        load_capture("builtin:studio", factor=3)


def test_a_single_frame_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least 2 frames, got 1"):
        studio_capture("exact", tmp_path, StudioSize(num_frames=1), quiet=True)


def test_names_tell_the_tracks_of_the_studio():
    assert parse_builtin("builtin:studio?tracks=broken").tracks == "broken"
    assert parse_builtin("builtin:studio").tracks == "none"
    with pytest.raises(ValueError, match="there is no built-in capture"):
        parse_builtin("builtin:studio?tracks=none-at-all")


@pytest.mark.parametrize("kind", ["exact", "broken"])
def test_tracks_are_added_to_a_copy_of_the_studio(cache, kind):
    exact = studio_capture("exact", cache, SMALL, quiet=True)
    tracked = load_capture(with_tracks(exact, kind, SMALL, quiet=True))
    assert load_capture(exact).tracks is None
    assert tracked.tracks.frames == tuple(f"left_{k:06d}" for k in range(4))
    expected, visible = exact_tracks(SMALL)
    errors = np.abs(tracked.tracks.positions * (64, 36) - expected)[visible]
    assert (np.nanmax(errors) < 1e-3) == (kind == "exact")
