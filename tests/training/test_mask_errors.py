"""Masks that miss what moves are completed by what the static image does not show."""

import dataclasses
import json

import pytest
import torch

from tests import tiny, two_ranks
from warpgs.config import RenderSettings
from warpgs.rendering import render
from warpgs.training.blocks import GRID, block_means, from_blocks, num_blocks
from warpgs.training.mask_errors import complete_masks
from warpgs.training.schedule import Phase

PHASE = Phase("stage1", True, True, 1, with_depth=False, with_joint=True)
TOLERANCE = 0.04


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return tiny.write(tmp_path_factory.mktemp("masks") / "capture")


def config_of(tolerance=TOLERANCE):
    return dataclasses.replace(
        tiny.CONFIG,
        loss=dataclasses.replace(tiny.CONFIG.loss, mask_tolerance=tolerance),
        schedule=dataclasses.replace(tiny.SCHEDULE, warmup=0),
    )


@pytest.fixture
def trainer(capture, tmp_path):
    """All frames are what the static image shows, and their masks say that everything is static."""
    trainer = tiny.trainer(capture, tmp_path / "run", config_of())
    trainer._add_dynamic_gaussians()
    stored = trainer.views._all
    stored.static_mask[:] = True
    for index in range(len(trainer.views)):
        view = trainer.views[index]
        with torch.no_grad():
            splats = trainer.scene.splats(view.time, sh_degree=1)
            image = render(splats, view.camera, settings=RenderSettings(branches=True)).static.image
        stored.image[index] = (image.clamp(0, 1) * 255).round().byte()
    return trainer


def complete(trainer):
    return complete_masks(trainer.scene, trainer.views, PHASE, trainer.config)


@pytest.mark.parametrize("size", [(24, 32), (270, 480), (100, 33)])
def test_blocks_cover_an_image_and_have_its_means(size):
    values = torch.rand(*size, 2)
    means = block_means(values)
    assert means.shape[:2] == num_blocks(*size)
    assert max(means.shape) <= GRID
    side = -(-max(size) // GRID)
    torch.testing.assert_close(means[-1, 0], values[(means.shape[0] - 1) * side :, :side].mean((0, 1)))
    chosen = torch.zeros(means.shape[:2], dtype=torch.bool)
    chosen[1, 2] = True
    pixels = torch.zeros(size, dtype=torch.bool)
    pixels[side : 2 * side, 2 * side : 3 * side] = True
    assert torch.equal(from_blocks(chosen, *size), pixels)


def test_a_block_that_the_static_image_does_not_show_becomes_dynamic(trainer):
    stored = trainer.views._all
    stored.image[2, 4:7, 5:9] = 255 - stored.image[2, 4:7, 5:9]
    text = complete(trainer)
    assert text.startswith("masks miss what moves in 1 of 6 views: ")
    blocks = trainer.views.moving_blocks()
    assert blocks[[0, 1, 3, 4, 5]].sum() == 0
    found = from_blocks(blocks[2, :24, :32] > 0, 24, 32)
    assert found[4:7, 5:9].sum() >= 8
    found[4:7, 5:9] = False
    assert not found.any()


def test_masks_stay_where_the_static_image_fits(trainer):
    assert complete(trainer) == ""
    assert trainer.views.moving_blocks().sum() == 0
    assert trainer.views._all.static_mask.all()


def test_what_differs_by_less_than_the_tolerance_stays_static(trainer):
    stored = trainer.views._all
    stored.image[1, 3:6, 3:6] = (stored.image[1, 3:6, 3:6].int() + 8).clamp(max=255).byte()
    assert complete(trainer) == ""


def test_a_view_that_is_not_learned_yet_is_left_as_it_is(trainer):
    trainer.views._all.image[3] = 255 - trainer.views._all.image[3]
    assert complete(trainer) == ""


def test_the_static_image_is_compared_over_the_background_of_the_capture(trainer):
    stored = trainer.views._all
    stored.image[:] = 0
    stored.image[2, 4:7, 5:9] = 255  # wrong where little is over black, and too much over white
    with torch.no_grad():
        trainer.scene.static.logit_opacities.fill_(-20.0)
    trainer.views.background = "white"
    assert complete(trainer) == ""
    trainer.views.background = "black"
    assert complete(trainer) != ""


def test_all_additions_to_a_view_together_have_a_limit(trainer):
    before = torch.zeros(6, GRID, GRID)
    before[3, :12, :16] = 1.0
    trainer.views.set_moving_blocks(before)
    trainer.views._all.static_mask[:] = True
    trainer.views._all.static_mask[3, :12, :16] = False
    trainer.views._all.image[3, 20:22, 20:22] = 255 - trainer.views._all.image[3, 20:22, 20:22]
    assert complete(trainer) == ""
    assert torch.equal(trainer.views.moving_blocks(), before)


def test_a_view_of_little_that_is_static_is_not_completed_when_all_of_it_is_dark(trainer):
    stored = trainer.views._all
    stored.static_mask[:, :, 7:] = False
    stored.image[:, :, :7] = 255 - stored.image[:, :, :7]
    assert complete(trainer) == ""


def test_what_the_mask_calls_dynamic_is_not_compared(trainer):
    stored = trainer.views._all
    stored.static_mask[2, 4:7, 5:9] = False
    stored.image[2, 4:7, 5:9] = 255 - stored.image[2, 4:7, 5:9]
    assert complete(trainer) == ""


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_moving_blocks_are_dynamic_and_can_be_taken_back(capture, tmp_path, resident_bytes):
    loss = dataclasses.replace(tiny.CONFIG.loss, mask_margin=0.05)
    config = dataclasses.replace(tiny.CONFIG, resident_bytes=resident_bytes, loss=loss)
    views = tiny.trainer(capture, tmp_path / "run", config).views
    assert views.resident == (resident_bytes > 0)
    (mask, border), other = (t.clone() for t in (views[1].static_mask, views[1].mask_border)), views[0].static_mask
    assert mask[2:4, 3].all()
    blocks = torch.zeros(6, GRID, GRID)
    blocks[1, 2:4, 3] = 1.0
    views.set_moving_blocks(blocks)
    expected = mask.clone()
    expected[2:4, 3] = False
    assert torch.equal(views[1].static_mask, expected)
    assert torch.equal(views[0].static_mask, other)
    assert torch.equal(views[1].mask_border, border & expected.logical_or(~mask))
    assert torch.equal(views.moving_blocks(), blocks)
    views.set_moving_blocks(torch.zeros_like(blocks))
    assert torch.equal(views[1].static_mask, mask)
    assert torch.equal(views[1].mask_border, border)


def test_a_run_whose_masks_are_completed_says_so_and_resumes_bit_by_bit(capture, tmp_path, capsys):
    config = config_of(tolerance=0.5)
    whole = tiny.trainer(capture, tmp_path / "whole", config)
    tiny.train(whole)
    assert "iteration 12: masks miss what moves in " in capsys.readouterr().out
    first = tiny.trainer(capture, tmp_path / "parts", config)
    tiny.train(first, tiny.StopWhen(lambda: first.iteration >= 14))
    assert first.views.moving_blocks().any()
    second = tiny.trainer(capture, tmp_path / "parts", config)
    second.restore_newest(print)
    assert torch.equal(second.views.moving_blocks(), first.views.moving_blocks())
    tiny.train(second)
    assert tiny.differences(tiny.state(tmp_path / "whole"), tiny.state(tmp_path / "parts")) == []


def test_all_ranks_have_the_masks_of_the_first(capture, tmp_path):
    folder = tmp_path / "ranks"
    config = dataclasses.replace(config_of(), data=capture, out=folder / "run")
    assert two_ranks.start(folder, two_ranks.send_masks, config) == [0, 0]
    first, second = (json.loads((folder / f"rank{k}.json").read_text()) for k in range(2))
    assert first == second
    assert first["sum"] == 1.0
