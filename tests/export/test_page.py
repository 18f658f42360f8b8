"""The page: one file that needs no network and shows the images of the scene up to quantisation."""

import dataclasses
import json
import re

import numpy as np
import pytest

from tests.export import scenes
from tests.export.pages import read_page
from warpgs.export import page
from warpgs.export.baking import bake, baked_bytes
from warpgs.export.page import write_page
from warpgs.export.start_camera import StartView
from warpgs.model.gaussians import SH_C0
from warpgs.video.camera_paths import evenly_spaced

KEYS = 9


def start(title="scene", track=False):
    camera = scenes.camera()
    K, view = camera.K, camera.viewmat.tolist()
    intrinsics = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    return StartView(title, camera.size, intrinsics, view, 3.0, [view, view] if track else [], 4.0, False)


@pytest.fixture(scope="module")
def clouds():
    return scenes.clouds()


@pytest.fixture(scope="module")
def baked(clouds):
    return bake(clouds.at, evenly_spaced(KEYS))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "scene.html"


# Baking -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", range(KEYS))
def test_at_key_times_the_image_matches_the_scene_up_to_quantisation(clouds, baked, key):
    time = key / (KEYS - 1)
    assert scenes.psnr(scenes.image(baked.at(time)), scenes.image(clouds.at(time))) > 50


def test_more_key_times_bring_the_images_between_them_closer_to_the_scene(clouds):
    truths = {time: scenes.image(clouds.at(time)) for time in (0.38, 0.71)}
    quality = []
    for keys in (2, 5, 17):
        coarse = bake(clouds.at, evenly_spaced(keys))
        quality.append(np.mean([scenes.psnr(scenes.image(coarse.at(t)), truth) for t, truth in truths.items()]))
    assert quality[0] + 3 < quality[1] < quality[2] - 3


@pytest.mark.parametrize("keys", [1, 2])
def test_a_scene_with_few_key_times_has_an_image_at_every_time(clouds, keys):
    few = bake(clouds.at, evenly_spaced(keys))
    for time in (0.0, 0.5, 1.0):
        assert len(few.at(time)) == 60
    assert scenes.psnr(scenes.image(few.at(0.0)), scenes.image(clouds.at(0.0))) > 50


@pytest.mark.parametrize(("static", "dynamic"), [(0, 20), (40, 0), (0, 0)])
def test_an_empty_branch_stays_empty(path, static, dynamic):
    baked = bake(scenes.clouds(static, dynamic).at, evenly_spaced(3))
    write_page(path, baked, start())
    back = read_page(path)
    assert [len(back.static), len(back.dynamic)] == [static, dynamic]
    assert len(back.at(0.3)) == static + dynamic


def test_a_gaussian_that_is_not_finite_at_one_time_is_omitted_at_all(clouds):
    def at(time):
        cloud = clouds.at(time)
        cloud.means[[3, 50], 0] = np.nan if time == 0.5 else 0.0
        return cloud

    broken = bake(at, evenly_spaced(3))
    assert [len(broken.static), len(broken.dynamic)] == [39, 19]
    assert broken.at(0.5).finite.all()


def test_a_flat_gaussian_does_not_reduce_the_precision_of_the_others(clouds):
    def at(time):
        cloud = clouds.at(time)
        cloud.log_scales[0, 0] = -46.0
        return cloud

    kept = bake(at, evenly_spaced(2)).at(0.0)
    assert np.abs(kept.log_scales[1:40] - clouds.at(0.0).log_scales[1:40]).max() < 16 / 1023


def test_a_distant_gaussian_leaves_the_others_within_a_thousandth_of_a_pixel(clouds):
    def at(time):
        cloud = clouds.at(time)
        cloud.means[0] = 1000.0
        return cloud

    kept = bake(at, evenly_spaced(2)).at(0.0)
    assert np.abs(kept.means[1:40] - clouds.at(0.0).means[1:40]).max() < 1001 / 2**21


@pytest.mark.parametrize("value", [1e3, -1e3, 1e30])
def test_an_extreme_colour_does_not_reduce_the_precision_of_the_others(clouds, value):
    def at(time):
        cloud = clouds.at(time)
        cloud.sh[[0, -1]] = value
        return cloud

    kept = bake(at, evenly_spaced(2)).at(0.0)
    for rows in (slice(1, 40), slice(40, 59)):
        errors = np.abs(kept.sh[rows] - clouds.at(0.0).sh[rows])
        assert errors[:, 0].max() < 0.51 * 3 / 255 / SH_C0
        assert errors[:, 1:].max() < 0.51 * 4 / 255


# The file -----------------------------------------------------------------------------------------------------------


def test_a_page_holds_the_baked_scene_exactly(path, baked):
    write_page(path, baked, start())
    back = read_page(path)
    assert back.keys == KEYS
    for name in ("static", "dynamic"):
        a, b = getattr(back, name), getattr(baked, name)
        for array in page.ARRAYS:
            assert (getattr(a, array) == getattr(b, array)).all()
        for bound in ("means", "log_scales", "colors", "rest"):
            assert (getattr(a.bounds, bound) == getattr(b.bounds, bound)).all()


def test_writing_a_page_is_deterministic(path, baked):
    write_page(path, baked, start())
    first = path.read_bytes()
    write_page(path, baked, start())
    assert path.read_bytes() == first


def test_a_page_contains_no_address(path, baked):
    write_page(path, baked, start())
    text = path.read_text()
    assert not re.search(r"https?:|//[a-z]+\.|@import|<link(?![^>]*data:)|src=", text)
    assert "default-src 'none'" in text


@pytest.mark.parametrize("title", ["</script><script>alert(1)</script>", "[[scene]]", "<b>&amp;", "Tür ★"])
def test_a_title_is_escaped(path, baked, title):
    write_page(path, baked, start(title))
    text = path.read_text()
    assert text.count("<script") == 11
    assert "<b>" not in text
    assert read_page(path).keys == KEYS
    assert json.loads(re.search(r'id="scene">([^<]*)<', text)[1])["start"]["title"] == title


def test_a_page_contains_every_part_of_the_player(path, baked):
    write_page(path, baked, start())
    text = path.read_text()
    assert not page.PLACEHOLDER.search(text)
    for part in ("class Orbit", "gl_Position", "discard", "postMessage({order", "touch-action"):
        assert part in text


def test_baked_bytes_is_the_memory_of_the_arrays(baked):
    branches = [baked.static, baked.dynamic]
    held = sum(getattr(branch, array).nbytes for branch in branches for array in page.ARRAYS)
    assert baked_bytes(40, 20, KEYS, 3) == held


def test_too_many_key_times_are_refused(path, baked):
    with pytest.raises(ValueError, match="at most 256 key times, got 300"):
        write_page(path, dataclasses.replace(baked, keys=300), start())


def test_too_many_gaussians_are_refused(path, baked, monkeypatch):
    monkeypatch.setattr(page, "MAX_GAUSSIANS", 39)
    with pytest.raises(ValueError, match="at most 39 static Gaussians, got 40"):
        write_page(path, baked, start())
