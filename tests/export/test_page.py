"""The page: one file that needs no network and shows the images of the scene up to quantisation."""

import dataclasses
import json
import re
from importlib import resources

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.export import node, scenes
from tests.export.pages import read_page
from warpgs.editing.contribution import contribution
from warpgs.export import page
from warpgs.export.baking import PARTS, STEPS, TEXEL, bake, nearest_to_identity, octaves_of, texture_bytes
from warpgs.export.page import write_page
from warpgs.export.start_camera import StartView
from warpgs.formats.cloud import sigmoid
from warpgs.formats.compressed import morton_order
from warpgs.model.gaussians import SH_C0
from warpgs.video.camera_paths import evenly_spaced
from warpgs.video.filmed import DRAG_LIMIT, Filmed

KEYS = 9
BRANCHES = (slice(0, 40), slice(40, 60))
"""Rows of static and dynamic Gaussians."""


FILMED = Filmed(np.array([[0.0, 0.0, -3.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([3.0]), np.array([0.4]))
"""By one camera that looks at the origin."""


def start(title="scene", track=False, filmed=None):
    camera = scenes.camera()
    K, view = camera.K, camera.viewmat.tolist()
    intrinsics = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    tracks = [view, view] if track else []
    return StartView(title, camera.size, intrinsics, view, 3.0, tracks, 4.0, False, 0.999, filmed=filmed)


@pytest.fixture(scope="module")
def weights(clouds):
    return contribution(clouds.scene, [scenes.camera(time=time) for time in evenly_spaced(KEYS)]).largest.numpy()


@pytest.fixture(scope="module")
def baked(clouds, weights):
    return bake(clouds.at, evenly_spaced(KEYS), weights=weights)


@pytest.fixture(scope="module")
def fine(clouds):
    return bake(clouds.at, evenly_spaced(KEYS), precision=4.0)


@pytest.mark.parametrize("key", range(KEYS))
def test_at_key_times_the_image_matches_the_scene_up_to_quantisation(clouds, baked, fine, key):
    time = key / (KEYS - 1)
    truth = scenes.image(clouds.at(time))
    assert scenes.psnr(scenes.image(baked.at(time)), truth) > 35  # of so few, two that change their order show
    assert scenes.psnr(scenes.image(fine.at(time)), truth) > 48


def test_more_key_times_bring_the_images_between_them_closer_to_the_scene(clouds):
    truths = {time: scenes.image(clouds.at(time)) for time in (0.38, 0.71)}
    quality = []
    for keys in (2, 5, 17):
        coarse = bake(clouds.at, evenly_spaced(keys), precision=4.0)
        quality.append(np.mean([scenes.psnr(scenes.image(coarse.at(t)), truth) for t, truth in truths.items()]))
    assert quality[0] + 3 < quality[1] < quality[2] - 3


@pytest.mark.parametrize("keys", [1, 2])
def test_a_scene_with_few_key_times_has_an_image_at_every_time(clouds, keys):
    few = bake(clouds.at, evenly_spaced(keys), precision=4.0)
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


def test_steps_of_colours_are_coarser_for_gaussians_that_are_hardly_visible():
    assert octaves_of(np.array([1, 4, 16, 1e-3, 1e6], np.float32)).tolist() == [2, 1, 0, 4, -5]
    assert octaves_of(np.array([0, 0, 0, 1, 4, 16], np.float32)).tolist() == [2, 2, 2, -1, -2, -3]
    assert octaves_of(np.zeros(3, np.float32)).tolist() == [0, 0, 0]
    assert octaves_of(np.zeros(0, np.float32)).tolist() == []


def test_colours_of_gaussians_that_are_hardly_visible_are_less_precise(clouds):
    weights = np.geomspace(1.0, 1e4, 60)[np.random.default_rng(0).permutation(60)].astype(np.float32)
    baked = bake(clouds.at, [0.0], weights=weights).at(0.0)
    order = np.concatenate([morton_order(clouds.at(0.0).means[rows]) + rows.start for rows in BRANCHES])
    error = np.abs(baked.sh - clouds.at(0.0).sh[order]).mean((1, 2))
    hardly, well = weights[order] < 10, weights[order] > 1000
    assert error[hardly].mean() > 8 * error[well].mean()


def test_the_order_of_the_gaussians_keeps_their_own_steps(clouds):
    weights = np.geomspace(1.0, 1e4, 60).astype(np.float32)
    baked = bake(clouds.at, evenly_spaced(3), weights=weights)
    order = morton_order(clouds.at(0.0).means[:40])
    assert (baked.static.octaves == octaves_of(weights[:40])[order]).all()


def test_a_gaussian_that_is_not_finite_at_one_time_is_omitted_at_all(clouds):
    def at(time):
        cloud = clouds.at(time)
        cloud.means[[3, 50], 0] = np.nan if time == 0.5 else 0.0
        return cloud

    broken = bake(at, evenly_spaced(3))
    assert [len(broken.static), len(broken.dynamic)] == [39, 19]
    assert broken.at(0.5).finite.all()


def rows(cloud):
    """The Gaussians of a cloud without their order, which depends on all means."""
    coefficients = cloud.sh.reshape(len(cloud), -1)
    parts = (cloud.means, cloud.quats, cloud.log_scales, cloud.logit_opacities[:, None], coefficients)
    return {tuple(row) for row in np.concatenate(parts, 1).tolist()}


@pytest.mark.parametrize(
    ("part", "value"), [("log_scales", -46.0), ("means", 1e3), ("means", 1e30), ("sh", 1e3), ("sh", -1e3), ("sh", 1e30)]
)
def test_an_extreme_gaussian_leaves_the_others_exactly_as_they_are(clouds, part, value):
    def at(time):
        cloud = clouds.at(time)
        axes = cloud.log_scales[[0, -1]].argmin(1) if part == "log_scales" else 0  # flat, not small
        getattr(cloud, part)[[0, -1], axes] = value
        return cloud

    kept, usual = bake(at, [0.0]).at(0.0), bake(clouds.at, [0.0]).at(0.0)
    assert len(usual) == len(rows(usual)) == len(rows(kept))
    assert len(rows(kept) - rows(usual)) == 2
    assert kept.finite.all()


def test_a_distant_gaussian_stays_distant(clouds):
    def at(time):
        cloud = clouds.at(time)
        cloud.means[[0, -1]] = 1e3
        return cloud

    assert (np.abs(bake(at, [0.0]).at(0.0).means - 1e3).max(1) < 0.01).sum() == 2


def test_values_at_one_time_are_within_half_a_step(clouds):
    order = [morton_order(clouds.at(0.0).means[rows]) + rows.start for rows in BRANCHES]
    kept, cloud = bake(clouds.at, [0.0], precision=4.0), clouds.at(0.0).select(np.concatenate(order))
    back = kept.at(0.0)

    def within(error, steps, part=0.501):
        return (np.abs(error).reshape(60, -1).max(1) <= part * np.repeat(steps, [40, 20])).all()

    assert within(back.means - cloud.means, [kept.static.means.steps[0], kept.dynamic.means.steps[0]])
    steps = {name: np.array(pair) / 4 for name, pair in STEPS.items()}
    assert within(np.sort(back.log_scales) - np.sort(cloud.log_scales), steps["log_scales"])
    assert within(sigmoid(back.logit_opacities) - sigmoid(cloud.logit_opacities), steps["opacities"])
    # a channel is luma and both chroma, whose steps are twice as coarse; the rest has three coefficients in one basis
    assert within(back.sh[:, 1:] - cloud.sh[:, 1:], 5 * np.sqrt(3) * steps["rest"])
    assert within((back.sh[:, 0] - cloud.sh[:, 0]) * SH_C0, 5 * steps["colors"])


def test_renamed_axes_are_the_same_ellipsoids():
    random = np.random.default_rng(0)
    quats, scales = random.normal(size=(500, 4)), random.uniform(0.1, 1.0, (500, 3))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    turned, axes = nearest_to_identity(quats)

    def covariances(quats, scales):
        matrices = Rotation.from_quat(np.roll(quats, -1, 1)).as_matrix() * scales[:, None]
        return matrices @ matrices.transpose(0, 2, 1)

    assert np.allclose(covariances(turned, np.take_along_axis(scales, axes, 1)), covariances(quats, scales), atol=1e-12)
    assert turned[:, 0].min() > 0.85
    assert np.allclose(np.linalg.norm(turned, axis=1), 1.0)


def test_a_page_holds_the_baked_scene_exactly(path, baked):
    write_page(path, baked, start())
    back = read_page(path)
    assert back.keys == KEYS
    for name in ("static", "dynamic"):
        a, b = getattr(back, name), getattr(baked, name)
        for part in PARTS:
            for field in ("levels", "steps", "octaves", "basis"):
                assert (getattr(getattr(a, part), field) == getattr(getattr(b, part), field)).all()


PROGRAM = """
import {readFileSync} from 'fs';
const blocks = {}, scripts = /<script type="[^"]+" id="([a-z_-]+)">([^<]*)</g;
for (const [, id, textContent] of readFileSync(process.argv[2], 'utf8').matchAll(scripts))
  blocks[id] = {textContent, remove() {}};
const element = (id) => blocks[id], SCENE = JSON.parse(element('scene').textContent);
%s
const result = {};
for (const [name, parts] of Object.entries(SCENE.branches)) {
  const octaves = await integers(`${name}-octaves`, parts.means.shape[1]);
  for (const part of Object.keys(parts)) result[`${name}-${part}`] = [...await unpacked(name, part, octaves)];
}
console.log(JSON.stringify(result));
"""


@pytest.mark.skipif(node.NODE is None, reason="the test needs node")
@pytest.mark.parametrize(("static", "dynamic", "keys"), [(40, 20, KEYS), (40, 20, 1), (0, 20, 2), (40, 0, 3)])
def test_the_player_restores_the_same_values(tmp_path, static, dynamic, keys):
    weights = np.geomspace(1.0, 1e4, static + dynamic).astype(np.float32)
    baked = bake(scenes.clouds(static, dynamic).at, evenly_spaced(keys), weights=weights)
    write_page(tmp_path / "scene.html", baked, start())
    player = re.search(r"const BASIS_UNIT = .*?\n(?=function boundsOf)", page._player("", "", ""), re.DOTALL)[0]
    printed = json.loads(node.run(tmp_path, PROGRAM % player, tmp_path / "scene.html"))
    for name in ("static", "dynamic"):
        for part in PARTS:
            values = getattr(getattr(baked, name), part).values.transpose(0, 2, 1).reshape(-1)
            assert np.allclose(printed[f"{name}-{part}"], values, rtol=1e-6, atol=1e-6 * np.abs(values).max(initial=0))


DRAGS = """
import {readFileSync} from 'fs';
const {filmed} = JSON.parse(readFileSync(process.argv[2], 'utf8').match(/id="scene">([^<]*)</)[1]);
const views = JSON.parse(process.argv[3]), result = {outside: [], dragged: {}};
for (const [position, forward] of views) result.outside.push(outsideOf(filmed, {rotation: [0, 0, forward], position}));
const moves = {rotate: [0.05, 0.01], pan: [0.05, 0.02], zoom: [0.1], nearer: [-0.1]};
for (const [name, step] of Object.entries(moves)) {
  const orbit = new Orbit({rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], position: [0, 0, -3]}, 3);
  const move = (x, y) => step.length === 1 ? orbit.zoom(Math.exp(x)) : orbit[name](x, y);
  for (let k = 0; k < 200; k++) orbit.within(filmed, move, ...step);
  result.dragged[name] = outsideOf(filmed, orbit.camera);
}
console.log(JSON.stringify(result));
"""


@pytest.fixture(scope="module")
def dragged(tmp_path_factory, baked):
    """How far views are outside for the player, and how far the mouse can move a view."""
    folder = tmp_path_factory.mktemp("drags")
    write_page(folder / "scene.html", baked, start(filmed=FILMED))
    camera = (resources.files("warpgs.export") / "player" / "camera.js").read_text()
    return json.loads(node.run(folder, camera + DRAGS, folder / "scene.html", json.dumps(VIEWS)))


VIEWS = [[[0, 0, -3], [0, 0, 1]], [[0.5, 0.2, -2], [0, 0, 1]], [[0, 0, -3], [0.6, 0, 0.8]], [[1, 1, 1], [0, -1, 0]]]
"""Positions and forward axes."""


@pytest.mark.skipif(node.NODE is None, reason="the test needs node")
def test_the_player_decides_what_was_filmed_as_python_does(dragged):
    expected = [FILMED.outside(np.array(position, float), np.array(forward, float)) for position, forward in VIEWS]
    assert dragged["outside"] == pytest.approx(expected, abs=1e-6)


@pytest.mark.skipif(node.NODE is None, reason="the test needs node")
@pytest.mark.parametrize("move", ["rotate", "pan", "zoom", "nearer"])
def test_the_mouse_cannot_leave_the_region_around_what_was_filmed(dragged, move):
    assert 0.8 * DRAG_LIMIT < dragged["dragged"][move] <= DRAG_LIMIT


@pytest.fixture(scope="module")
def text(baked, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "scene.html"
    write_page(path, baked, start())
    return path.read_text()


def test_writing_a_page_is_deterministic(path, baked, text):
    write_page(path, baked, start())
    assert path.read_text() == text


def test_a_page_contains_no_address(text):
    assert not re.search(r"https?:|//[a-z]+\.|@import|<link(?![^>]*data:)|src=", text)
    assert "default-src 'none'" in text


@pytest.mark.parametrize("title", ["</script><script>alert(1)</script>", "[[scene]]", "<b>&amp;", "Tür ★"])
def test_a_title_is_escaped(path, baked, title):
    write_page(path, baked, start(title))
    text = path.read_text()
    assert text.count("<script") == 33
    assert "<b>" not in text
    assert read_page(path).keys == KEYS
    assert json.loads(re.search(r'id="scene">([^<]*)<', text)[1])["start"]["title"] == title


def test_a_page_contains_every_part_of_the_player(text):
    assert not page.PLACEHOLDER.search(text)
    for part in ("class Orbit", "gl_Position", "discard", "postMessage({order", "touch-action"):
        assert part in text


def textures_of(branch):
    """Bytes of a branch's textures, from the sizes of its arrays."""
    (geometry, num, _), colors = branch.means.levels.shape, branch.colors.levels.shape[0]
    rest = branch.rest.levels.shape[0]
    return num * (geometry * TEXEL["geometry"] + colors * TEXEL["colors"] + rest * TEXEL["rest"])


def test_texture_bytes_is_the_memory_of_the_textures(baked):
    assert texture_bytes(40, 20, KEYS, 3) == textures_of(baked.static) + textures_of(baked.dynamic)


def test_what_hardly_changes_takes_few_bytes(path, clouds):
    still = clouds.at(0.5)
    sizes = []
    for keys in (1, 30):
        write_page(path, bake(lambda time: still, evenly_spaced(keys)), start())
        sizes.append(path.stat().st_size)
    assert sizes[1] < sizes[0] * 1.1


def test_too_many_key_times_are_refused(path, baked):
    with pytest.raises(ValueError, match="at most 256 key times, got 300"):
        write_page(path, dataclasses.replace(baked, keys=300), start())


def test_too_many_gaussians_are_refused(path, baked, monkeypatch):
    monkeypatch.setattr(page, "MAX_GAUSSIANS", 39)
    with pytest.raises(ValueError, match="at most 39 static Gaussians, got 40"):
        write_page(path, baked, start())
