"""The terms of the training loss (paper Eq. 9, 12, 14 and 15)."""

import dataclasses

import pytest
import torch

from tests import plain
from tests.reference.ssim import ssim_map
from tests.scenes import (
    as_gaussians,
    assert_same_gradients,
    error,
    generator,
    make_camera,
    make_splats,
    select,
)
from warpgs.config import RenderSettings
from warpgs.data.capture import Capture, Frame
from warpgs.initialization.alignment import DepthTrust
from warpgs.model.scene import SplitScene
from warpgs.rendering import render
from warpgs.training.loss_terms import TERMS
from warpgs.training.losses import LossTerm, dynamic_loss, image_loss, static_loss
from warpgs.training.schedule import Protocol
from warpgs.training.step import Sample, Step
from warpgs.views.pixels import mask_border
from warpgs.views.views import Views

HEIGHT, WIDTH = 21, 18
BLACK = torch.zeros(3)
PURPLE = torch.tensor([0.7, 0.1, 0.9])
WEIGHTS = [0.0, 0.2]


@pytest.fixture(autouse=True)
def terms_of_the_paper(monkeypatch):
    """A term that is added to the dictionary has tests of its own."""
    known = {"static", "dynamic", "joint", "squared", "depth", "depth_dynamic"}
    for name in TERMS.keys() - known:
        monkeypatch.delitem(TERMS, name)


def random_image(seed):
    return torch.rand(HEIGHT, WIDTH, 3, generator=generator(seed))


def static_mask():
    """True where static: everywhere but in a block."""
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[5:13, 4:11] = False
    return mask


IMAGE, TRUTH, MASK = random_image(1), random_image(2), static_mask()


def compared(image, truth, weight):
    """L1 + λ (1 − SSIM) in double precision."""
    image, truth = image.double(), truth.double()
    return (image - truth).abs().mean() + weight * (1.0 - ssim_map(image, truth).mean())


def where(mask):
    return mask[..., None].double()


def assert_same_loss(loss, expected, *arguments):
    """Compares a loss of the image, and its gradient, with those of a function of the image in double precision."""
    image, double = IMAGE.clone().requires_grad_(), IMAGE.double().requires_grad_()
    ours, theirs = loss(image, *arguments), expected(double)
    assert error(ours, theirs) < 1e-6
    assert_same_gradients([ours], [theirs], [image], [double])


def gradient(loss, image, *arguments):
    leaf = image.clone().requires_grad_()
    loss(leaf, *arguments).backward()
    return leaf.grad


@pytest.mark.parametrize("weight", WEIGHTS)
def test_images_are_compared_by_l1_and_similarity(weight):
    assert_same_loss(image_loss, lambda image: compared(image, TRUTH, weight), TRUTH, weight)


@pytest.mark.parametrize("weight", WEIGHTS)
def test_the_static_loss_masks_both_images(weight):
    """Eq. 9 of the paper."""
    truth = TRUTH * where(MASK)
    assert_same_loss(static_loss, lambda image: compared(image * where(MASK), truth, weight), TRUTH, MASK, weight)


@pytest.mark.parametrize("weight", WEIGHTS)
def test_the_dynamic_loss_masks_the_ground_truth_only(weight):
    """Eq. 12 of the paper."""
    truth = TRUTH * where(~MASK)
    assert_same_loss(dynamic_loss, lambda image: compared(image, truth, weight), TRUTH, MASK, weight, BLACK)


@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize("background", [BLACK, PURPLE])
def test_a_perfect_dynamic_image_over_its_background_has_no_loss(weight, background):
    perfect = background.repeat(HEIGHT, WIDTH, 1)
    perfect[5:13, 4:11] = TRUTH[5:13, 4:11]
    assert dynamic_loss(perfect, TRUTH, MASK, weight, background).abs() < 1e-6


def test_a_perfect_dynamic_image_over_another_background_has_a_loss():
    perfect = torch.zeros(HEIGHT, WIDTH, 3)
    perfect[5:13, 4:11] = TRUTH[5:13, 4:11]
    static_fraction = 1.0 - 8 * 7 / (HEIGHT * WIDTH)
    expected = static_fraction * PURPLE.double().mean()
    assert error(dynamic_loss(perfect, TRUTH, MASK, 0.0, PURPLE), expected) < 1e-6


SPLATS = make_splats()
CAMERA = make_camera()
VIEW_MASK = torch.arange(CAMERA.width).expand(CAMERA.height, -1) < 30
VIEW_IMAGE = torch.randint(0, 256, (CAMERA.height, CAMERA.width, 3), generator=generator(), dtype=torch.uint8)
INVERSE_DEPTH = torch.rand(CAMERA.height, CAMERA.width, generator=generator()).half().float()
ALIGNMENTS = torch.tensor([[0.5, 0.1]])
LOSS = plain.loss(
    ssim=0.3,
    depth=2.0,
    depth_dynamic=0.4,
    depth_end=2.0,  # no decay
)
IMAGES = {"static", "dynamic", "joint"}
NETWORK = plain.model(position_bands=1, time_bands=1, depth=1, width=2, sh_degree=3)
SCHEDULE = plain.schedule(pretrain=2_000, stage1=30_000, stage2=40_000, deform_from=100, appearance_from=100)
VIEW_SIZE = 3.0
STAGES = {"pretrain": 0, "stage1": 2_000, "stage2": 32_000}
"""First iteration of each stage."""


def prepared(stage, loss=LOSS, at=0, trust=(1.0, 0.0), schedule=SCHEDULE, **options):
    """A scene, the plan of an iteration of a stage, by default of the first, and a step that trains the scene."""
    frame = Frame("a", CAMERA, VIEW_IMAGE, VIEW_MASK, INVERSE_DEPTH)
    capture = Capture("made up", {"a": CAMERA}, ["a"], [], torch.zeros(0, 3), None, lambda name: frame)
    config = plain.config(model=NETWORK, loss=loss, schedule=schedule, **options)
    static, dynamic = (as_gaussians(select(SPLATS, chosen)) for chosen in (~SPLATS.is_dynamic, SPLATS.is_dynamic))
    scene = SplitScene(static, dynamic, NETWORK, torch.zeros(3), torch.ones(3))
    plan = Protocol(config, has_depth=True).at(STAGES[stage] + at)
    assert plan.phase.stage == stage
    views = Views(capture, torch.device("cpu"), 1 << 30, loss.mask_margin)
    trusts = DepthTrust(*torch.tensor(trust)[:, None])
    return scene, plan, Step(config, scene, views, ALIGNMENTS, trusts, VIEW_SIZE)


def terms_of(stage, loss=LOSS, schedule=SCHEDULE):
    """The weighted terms of the first iteration of a stage (Eq. 15), and the rendering that they compare."""
    scene, plan, step = prepared(stage, loss, schedule=schedule)
    phase = plan.phase
    with torch.no_grad():
        splats = scene.splats(torch.zeros(1), phase.use_deformation, phase.use_appearance, phase.sh_degree)
        rendering = render(splats, CAMERA, settings=RenderSettings(branches=True, depth=True))
    step(plan, Sample(0, 0.0, 0))
    return {name: torch.tensor(value) for name, value in step.take_means().terms.items()}, rendering


def changed_by(stage, loss=LOSS, at=0, **options):
    """Names of the parameters that an iteration of a stage changes; layers of networks count as the network."""
    scene, plan, step = prepared(stage, loss, at, **options)
    before = {name: p.detach().clone() for name, p in scene.named_parameters()}
    step(plan, Sample(0, 0.0, 0))
    changed = [name for name, p in scene.named_parameters() if not torch.equal(p, before[name])]
    return {name.split(".")[0] if name.startswith(("deformation", "appearance")) else name for name in changed}


def keep_terms(monkeypatch, *names):
    """The loss has these terms alone."""
    monkeypatch.setattr("warpgs.training.step.TERMS", {name: TERMS[name] for name in names})


def of(branch, names):
    """What comes after ``branch.`` in the names that begin with it."""
    return {name.removeprefix(f"{branch}.") for name in names if name.startswith(f"{branch}.")}


def view_truth():
    return VIEW_IMAGE.double() / 255.0


def view_depth():
    return 1.0 / (0.5 * INVERSE_DEPTH.double() + 0.1)


def expected_depth(layer, region):
    known = region & (layer.alpha > 0.5)
    assert known.any()
    return ((layer.depth.double() - view_depth()) * known).abs().mean() / VIEW_SIZE


@pytest.mark.parametrize("stage", STAGES)
def test_the_static_term_is_the_weighted_static_loss_in_every_stage(stage):
    terms, rendering = terms_of(stage)
    truth = view_truth()
    expected = compared(rendering.static.image * where(VIEW_MASK), truth * where(VIEW_MASK), 0.3)
    assert error(terms["static"], expected) < 1e-6


@pytest.mark.parametrize(("stage", "margin"), [("stage1", 0.0), ("stage2", 0.0), ("stage1", 1.6)])
def test_the_dynamic_term_is_the_weighted_dynamic_loss_over_black(stage, margin):
    """It leaves out the margin of the mask, here in pixels."""
    terms, rendering = terms_of(stage, dataclasses.replace(LOSS, mask_margin=margin / max(VIEW_MASK.shape)))
    dynamic = rendering.dynamic
    image = dynamic.image.double()
    truth = view_truth() * (~VIEW_MASK)[..., None]
    if margin:
        truth = torch.where(mask_border(VIEW_MASK, 2)[..., None], image, truth)
    assert error(terms["dynamic"], compared(image, truth, 0.3)) < 1e-6


def test_along_the_borders_of_the_mask_the_dynamic_loss_is_that_of_its_own_image():
    border = mask_border(MASK, 1)
    loss = dynamic_loss(IMAGE, TRUTH, MASK, 0.2, PURPLE, border)
    truth = torch.where(border[..., None], IMAGE, torch.where(MASK[..., None], PURPLE, TRUTH))
    assert error(loss, compared(IMAGE, truth, 0.2)) < 1e-6
    assert not gradient(dynamic_loss, IMAGE, TRUTH, MASK, 0.0, PURPLE, border)[border].any()
    assert gradient(dynamic_loss, IMAGE, TRUTH, MASK, 0.0, PURPLE, border)[~border].any(1).all()


def test_the_schedule_compares_the_joint_image_in_stage_1_already():
    schedule = dataclasses.replace(SCHEDULE, joint_from=0)
    terms, rendering = terms_of("stage1", schedule=schedule)
    assert error(terms["joint"], compared(rendering.joint.image, view_truth(), 0.3)) < 1e-6
    assert "joint" not in terms_of("stage1")[0]
    assert "joint" not in terms_of("pretrain", schedule=schedule)[0]


def terms_with_trust(weight, margin, loss=LOSS, **options):
    _, plan, step = prepared("stage1", loss, trust=(weight, margin), **options)
    step(plan, Sample(0, 0.0, 0))
    return step.take_means().terms


def test_lengths_in_the_loss_are_in_view_sizes_or_as_in_the_paper_in_scene_units():
    in_views, in_scene = (terms_with_trust(1.0, 0.0, densify=plain.densify(unit=unit)) for unit in ("pixel", "extent"))
    lengths = {"depth", "depth_dynamic"}
    ratios = {name: in_scene[name] / in_views[name] for name in in_views}
    assert ratios == pytest.approx({name: VIEW_SIZE if name in lengths else 1.0 for name in ratios}, rel=1e-5)


@pytest.mark.parametrize(("unit", "length"), [("pixel", VIEW_SIZE), ("extent", 1.0)])
def test_rates_of_positions_are_in_view_sizes_or_as_in_the_paper_in_scene_units(unit, length):
    densify = plain.densify(unit=unit)
    _, plan, step = prepared("pretrain", densify=densify, optim=plain.optim(means=0.01))
    step(plan, Sample(0, 0.0, 0))
    assert step._inputs.learning_rates["static.means"].item() == pytest.approx(0.01 * length)


def test_depth_terms_are_multiplied_by_the_trust_in_the_view():
    whole, part = terms_with_trust(1.0, 0.0), terms_with_trust(0.25, 0.0)
    for name in ("depth", "depth_dynamic"):
        assert part[name] == pytest.approx(0.25 * whole[name], rel=1e-6)
    assert part["static"] == whole["static"]


def test_what_follows_a_mask_that_is_not_trusted_has_no_loss():
    _, plan, step = prepared("stage2")
    step.views.mask_trust.zero_()
    step(plan, Sample(0, 0.0, 0))
    terms, trusted = step.take_means().terms, terms_with_trust(1.0, 0.0)
    follow = {"static", "dynamic", "depth", "depth_dynamic"}
    assert all(trusted[name] > 0.0 for name in follow)
    assert {name for name, value in terms.items() if value == 0.0} == follow


def test_a_margin_frees_small_errors_of_the_static_depth_alone():
    none, small, large = (terms_with_trust(1.0, margin) for margin in (0.0, 0.2, 1e3))
    assert 0.0 < small["depth"] < none["depth"]
    assert large["depth"] == 0.0
    assert large["depth_dynamic"] == none["depth_dynamic"] > 0.0


def test_the_joint_and_the_squared_term_compare_the_joint_image_with_the_whole_ground_truth():
    terms, rendering = terms_of("stage2", dataclasses.replace(LOSS, squared=7.0))
    assert error(terms["joint"], compared(rendering.joint.image, view_truth(), 0.3)) < 1e-6
    expected = 7.0 * (rendering.joint.image.double() - view_truth()).square().mean()
    assert error(terms["squared"], expected) < 1e-6


@pytest.mark.parametrize(("stage", "counts"), [("pretrain", False), ("stage1", True), ("stage2", True)])
def test_the_squared_error_counts_wherever_the_joint_image_is_compared(stage, counts):
    loss, schedule = dataclasses.replace(LOSS, squared=7.0), dataclasses.replace(SCHEDULE, joint_from=0)
    terms, _ = terms_of(stage, loss, schedule)
    assert ("squared" in terms) == ("joint" in terms) == counts


@pytest.mark.parametrize(
    ("stage", "used"),
    [
        ("pretrain", {"static", "depth"}),
        ("stage1", {"static", "dynamic", "depth", "depth_dynamic"}),
        ("stage2", {"static", "dynamic", "joint", "depth", "depth_dynamic"}),
    ],
)
def test_each_stage_has_its_active_terms(stage, used):
    terms, _ = terms_of(stage)
    assert set(terms) == used
    assert all(value > 0 for value in terms.values())


@pytest.mark.parametrize("stage", STAGES)
def test_depth_terms_are_those_of_each_branch_in_its_region_and_the_dynamic_one_has_a_relative_weight(stage):
    terms, rendering = terms_of(stage)
    assert error(terms["depth"], 2.0 * expected_depth(rendering.static, VIEW_MASK)) < 1e-5
    if stage != "pretrain":
        assert error(terms["depth_dynamic"], 0.4 * 2.0 * expected_depth(rendering.dynamic, ~VIEW_MASK)) < 1e-5


@pytest.mark.parametrize("stage", ["stage1", "stage2"])
def test_the_depth_term_decays_exponentially(stage):
    constant, _ = terms_of(stage)
    decaying, _ = terms_of(stage, dataclasses.replace(LOSS, depth_end=0.02))
    assert error(decaying["depth"] / constant["depth"], torch.tensor(0.01 ** (STAGES[stage] / 72_000))) < 1e-5


@pytest.mark.parametrize(
    ("weight", "off"),
    [("depth", {"depth", "depth_dynamic"}), ("depth_dynamic", {"depth_dynamic"})],
)
def test_a_term_with_a_weight_of_zero_is_not_reported(weight, off):
    everything = {*IMAGES, "depth", "depth_dynamic"}
    assert set(terms_of("stage2", dataclasses.replace(LOSS, **{weight: 0.0}))[0]) == everything - off


def test_a_term_that_begins_between_two_reports_is_averaged_over_its_own_iterations():
    schedule, sample = dataclasses.replace(SCHEDULE, joint_from=0), Sample(0, 0.0, 0)
    _, plan, step = prepared("stage1", schedule=schedule)
    without = dataclasses.replace(plan, phase=dataclasses.replace(plan.phase, with_joint=False))
    step(without, sample)
    first = step.take_means()
    step(plan, sample)
    second = step.take_means()
    _, plan, step = prepared("stage1", schedule=schedule)
    step(without, sample)
    step(plan, sample)
    both = step.take_means()
    assert "joint" not in first.terms
    assert both.terms["joint"] == pytest.approx(second.terms["joint"], rel=1e-5)
    assert both.terms["static"] == pytest.approx((first.terms["static"] + second.terms["static"]) / 2, rel=1e-5)
    assert both.loss == pytest.approx((first.loss + second.loss) / 2, rel=1e-5)


def dynamic_alpha(inputs):
    """Mean opacity of the dynamic image."""
    return inputs.rendering.dynamic.alpha.mean()


SPARSITY = LossTerm(
    dynamic_alpha, is_active=lambda phase, config: phase.stage == "stage1", weight=lambda plan, config: 0.25
)


def test_a_term_that_is_added_to_the_dictionary_is_trained_and_reported(monkeypatch):
    monkeypatch.setitem(TERMS, "sparsity", SPARSITY)
    keep_terms(monkeypatch, "sparsity")
    terms, rendering = terms_of("stage1")
    assert error(terms["sparsity"], 0.25 * rendering.dynamic.alpha.double().mean()) < 1e-6
    assert "logit_opacities" in of("dynamic", changed_by("stage1"))


def test_a_term_is_inactive_in_other_phases(monkeypatch):
    monkeypatch.setitem(TERMS, "sparsity", SPARSITY)
    keep_terms(monkeypatch, "depth", "sparsity")
    assert list(terms_of("stage2")[0]) == ["depth"]
    assert of("dynamic", changed_by("stage2")) == set()


def test_terms_are_reported_in_the_order_of_the_dictionary():
    terms, _ = terms_of("stage2", dataclasses.replace(LOSS, squared=7.0))
    assert list(terms) == ["static", "dynamic", "joint", "squared", "depth", "depth_dynamic"]


GEOMETRY = {"means", "quats", "log_scales"}
EARLY_APPEARANCE = {"logit_opacities", "sh_dc"}
"""Spherical harmonics of higher degrees are trained later."""


def test_pretraining_trains_static_gaussians_only():
    changed = changed_by("pretrain")
    assert of("static", changed) == GEOMETRY | EARLY_APPEARANCE
    assert len(changed) == len(of("static", changed))


@pytest.mark.parametrize(("branch", "network"), [("static", "appearance"), ("dynamic", "deformation")])
@pytest.mark.parametrize("in_use", [False, True])
def test_in_stage_1_the_term_of_a_branch_trains_its_gaussians_and_its_network_once_in_use(
    monkeypatch, branch, network, in_use
):
    keep_terms(monkeypatch, branch)
    changed = changed_by("stage1", at=150 if in_use else 0)
    expected = {f"{branch}.{name}" for name in GEOMETRY | EARLY_APPEARANCE}
    assert changed == expected | ({network} if in_use else set())


def test_in_stage_2_the_joint_term_trains_dynamic_gaussians_and_both_networks(monkeypatch):
    keep_terms(monkeypatch, "joint")
    changed = changed_by("stage2")
    assert of("dynamic", changed) >= GEOMETRY | EARLY_APPEARANCE
    assert {"deformation", "appearance"} <= changed


@pytest.mark.parametrize(
    ("options", "trained"),
    [
        ({}, set()),
        ({"frozen": "appearance"}, GEOMETRY),
        ({"frozen": "geometry"}, EARLY_APPEARANCE | {"sh_rest"}),
        ({"omit": ("app",)}, EARLY_APPEARANCE | {"sh_rest"}),
    ],
    ids=["nothing", "geometry", "appearance", "appearance without its network"],
)
def test_stage_2_trains_of_static_gaussians_only_what_the_config_lets_it(options, trained):
    changed = changed_by("stage2", **options)
    assert of("static", changed) == trained
    assert ("appearance" in changed) == ("omit" not in options)


@pytest.mark.parametrize(("color", "fades"), [((0.0, 0.0, 0.0), False), ((0.9, 0.1, 0.4), True)])
def test_black_gaussians_where_nothing_moves_fade_before_another_color(color, fades, monkeypatch):
    keep_terms(monkeypatch, "dynamic")
    scene, plan, step = prepared("stage1")
    with torch.no_grad():
        scene.dynamic.sh_dc.fill_(-10.0)
        scene.dynamic.sh_rest.zero_()
        step.views[0].static_mask.fill_(True)
    before = scene.dynamic.logit_opacities.detach().clone()
    step(plan, Sample(0, 0.0, 0, color))
    changes = scene.dynamic.logit_opacities - before
    assert bool((changes < 0.0).any()) == fades
    assert not bool((changes > 0.0).any())
