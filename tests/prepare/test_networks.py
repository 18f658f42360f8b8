"""SAM 2 and Depth Anything with tiny networks of random weights, and the errors if they are missing."""

import json
import os
import sys
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from tests.prepare import boards
from warpgs.cli import main
from warpgs.command_line.version import install_command
from warpgs.prepare import weights
from warpgs.prepare.depth.anything import network_size, predict
from warpgs.prepare.masks.sam2 import choose_prompts, track
from warpgs.prepare.networks import load, normalized
from warpgs.prepare.weights import DEPTH_ANYTHING, SAM2, find_weights

needs_transformers = pytest.mark.skipif(find_spec("transformers") is None, reason="transformers is not installed")


@pytest.fixture(scope="module")
def sam2(tmp_path_factory):
    """An untrained SAM 2 of 128 × 128 pixels."""
    pytest.importorskip("transformers")
    from transformers import Sam2VideoConfig, Sam2VideoModel

    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [128, 128],
        "blocks_per_stage": [1, 2, 2, 1], "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 1, 1, 1], "window_size_per_stage": [8, 4, 4, 2],
        "global_attention_blocks": [4],
    }  # fmt: skip
    vision = {
        "model_type": "sam2_vision_model", "backbone_config": backbone, "backbone_channel_list": [64, 32, 16, 8],
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]], "fpn_hidden_size": 128,
    }  # fmt: skip
    config = Sam2VideoConfig(
        vision_config=vision, prompt_encoder_config={"hidden_size": 128, "image_size": 128}, image_size=128,
        mask_decoder_config={"hidden_size": 128, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
        memory_attention_hidden_size=128, memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=16, memory_attention_rope_feat_sizes=[8, 8],
        memory_encoder_hidden_size=128, mask_downsampler_embed_dim=128, memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=16,
    )  # fmt: skip
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights") / "sam2"
    Sam2VideoModel(config).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def depth_anything(tmp_path_factory):
    """An untrained Depth Anything of 70 × 70 pixels."""
    pytest.importorskip("transformers")
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, image_size=70, patch_size=14,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[4, 8, 8, 16], fusion_hidden_size=8
    )
    torch.manual_seed(0)
    network = DepthAnythingForDepthEstimation(config)
    with torch.no_grad():
        for layer in (network.head.conv1, network.head.conv2, network.head.conv3):  # else the ReLUs return zeros
            layer.weight.abs_()
            layer.bias.fill_(1.0)
    folder = tmp_path_factory.mktemp("weights") / "depth"
    network.save_pretrained(folder)
    return folder


def test_the_error_without_the_package_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(weights, "find_spec", lambda name: None)
    shots = boards.write_folder(tmp_path / "shots", boards.record(5)[0])
    for options in (["--masks", "sam2"], ["--depth", "anything"]):
        assert main(["prepare", str(shots), str(tmp_path / "capture"), *options]) == 2
        written = capsys.readouterr().err
        assert written.count("\n") == 1
        assert f"{' '.join(options)} needs the package transformers: {install_command('networks')}" in written
    assert not (tmp_path / "capture").exists()


@pytest.mark.parametrize("network", [SAM2, DEPTH_ANYTHING])
def test_the_error_without_weights_says_where_to_get_them(network, tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "find_spec", lambda name: object())
    with pytest.raises(ValueError, match=rf"{network.title}, which are not in .*hf download {network.names[0]}"):
        find_weights(network, tmp_path)


def test_weights_of_another_network_and_incomplete_ones_are_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "find_spec", lambda name: object())
    for name, model_type in (("a", "depth_anything"), ("b", "sam2_video")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(json.dumps({"model_type": model_type}))
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "config.json").write_text("[damaged")
    (tmp_path / "a" / "model.safetensors").touch()
    assert find_weights(DEPTH_ANYTHING, tmp_path) == tmp_path / "a"
    with pytest.raises(ValueError, match="needs the weights of SAM 2"):
        find_weights(SAM2, tmp_path)


@pytest.mark.parametrize("name", ["model.safetensors", "preprocessor_config.json"])
def test_weights_that_are_not_regular_files_are_refused(tmp_path, monkeypatch, name):
    monkeypatch.setattr(weights, "find_spec", lambda name: object())
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "sam2_video"}))
    (tmp_path / "model.safetensors").touch()
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(ValueError, match=f"{name} is not a file"):
        find_weights(SAM2, tmp_path)


def test_the_best_weights_of_the_cache_are_used(tmp_path, monkeypatch):
    """Only the order of the names is tested; the layout of the cache is that of the package."""
    for name in SAM2.names[1:3]:
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "config.json").write_text(json.dumps({"model_type": "sam2_video"}))
        (tmp_path / name / "model.safetensors").touch()

    class Hub:
        @staticmethod
        def try_to_load_from_cache(name, file):
            return str(tmp_path / name / file) if (tmp_path / name / file).is_file() else None

    monkeypatch.setattr(weights, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "huggingface_hub", Hub)
    assert find_weights(SAM2, None) == tmp_path / SAM2.names[1]


@pytest.mark.parametrize(
    ("size", "expected"), [((512, 384), (518, 392)), ((384, 512), (392, 518)), ((960, 540), (924, 518))]
)
def test_the_input_size_is_that_of_the_networks_own_preprocessing(size, expected):
    assert network_size(*size, side=518, patch=14) == expected


def test_images_are_normalized_by_imagenets_mean_and_deviation():
    grey = np.full((6, 8, 3), 124, np.uint8)
    values = normalized(grey, 4, 4)
    assert values.shape == (3, 4, 4)
    assert values[:, 0, 0].tolist() == pytest.approx(
        [(124 / 255 - 0.485) / 0.229, (124 / 255 - 0.456) / 0.224, (124 / 255 - 0.406) / 0.225], abs=1e-5
    )


def test_prompts_have_the_median_area_of_each_part_with_motion():
    areas = [1, 9, 5, 0, 0, 0, 2, 4, 3, 7, 8, 6]
    masks = [np.arange(12).reshape(3, 4) < area for area in areas]
    assert choose_prompts(masks) == [2, 8, 9]


def test_weights_without_a_network_are_refused(tmp_path, capsys):
    (tmp_path / "shots").mkdir()
    assert main(["prepare", str(tmp_path / "shots"), str(tmp_path / "c"), "--weights", str(tmp_path)]) == 2
    assert "--weights is for" in capsys.readouterr().err


@needs_transformers
@pytest.mark.parametrize("prompts", [[3], [0, 2, 4, 5]])
def test_sam2_keeps_its_prompts_and_segments_every_frame(prompts, sam2):
    images, masks = boards.record(6)
    dynamic = [mask & (k in prompts) for k, mask in enumerate(masks)]
    assert choose_prompts(dynamic) == prompts
    found = track(images, dynamic, find_weights(SAM2, sam2.parent))
    assert [mask.shape for mask in found] == [(192, 256)] * 6
    for k in prompts:
        assert boards.overlap(found[k], masks[k]) > 0.75


@needs_transformers
def test_sam2_is_not_loaded_if_nothing_moves(sam2, monkeypatch):
    nothing = [np.zeros((4, 5), bool)] * 3
    monkeypatch.setattr("warpgs.prepare.masks.sam2.load", lambda *arguments: pytest.fail("was loaded"))
    assert track([np.zeros((4, 5, 3), np.uint8)] * 3, nothing, sam2) == nothing


@needs_transformers
def test_depth_anything_covers_all_pixels_and_metric_depth_is_inverted(depth_anything, tmp_path):
    images = boards.record(2)[0]
    relative = predict(images, find_weights(DEPTH_ANYTHING, depth_anything))
    assert [plane.shape for plane in relative] == [(192, 256)] * 2
    assert all(np.isfinite(plane).all() and plane.std() > 0 for plane in relative)
    network = load(DEPTH_ANYTHING, depth_anything)
    network.config.depth_estimation_type = "metric"
    network.save_pretrained(tmp_path)
    metric = predict(images[:1], tmp_path)[0]
    values = torch.logit(torch.from_numpy(1.0 / metric))
    assert np.corrcoef(values.ravel(), relative[0].ravel())[0, 1] > 0.99


@needs_transformers
def test_a_capture_is_made_with_both_networks(sam2, depth_anything, tmp_path, capsys, monkeypatch):
    folders = tmp_path / "weights"
    folders.mkdir()
    for folder in (sam2, depth_anything):
        (folders / folder.name).symlink_to(folder)
    monkeypatch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", boards.SIZE[0])
    shots = boards.write_folder(tmp_path / "shots", boards.record(16)[0])
    options = ["--masks", "sam2", "--depth", "anything", "--weights", str(folders)]
    assert main(["prepare", str(shots), str(tmp_path / "made"), *options]) == 0
    assert "known on 100% of the pixels" in capsys.readouterr().out
    assert len(list((tmp_path / "made/depth/1x").iterdir())) == 16


@needs_transformers
def test_damaged_and_incomplete_weights_are_refused(depth_anything, tmp_path):
    from safetensors.torch import load_file, save_file

    tensors = load_file(depth_anything / "model.safetensors")
    (tmp_path / "config.json").write_text((depth_anything / "config.json").read_text())
    save_file({k: v for k, v in tensors.items() if "head" not in k}, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"tensors of Depth Anything V2 are missing, head\."):
        load(DEPTH_ANYTHING, tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(ValueError, match="weights of Depth Anything V2 cannot be read"):
        load(DEPTH_ANYTHING, tmp_path)
