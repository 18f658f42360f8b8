"""LPIPS: the networks are the ones that their weights belong to, and files that don't fit are refused in words."""

import dataclasses
import os
import re
import shutil
import zipfile
from pathlib import Path

import pytest
import torch
from torch import nn

from tests import tiny
from warpgs.config import TrainConfig
from warpgs.evaluation import lpips
from warpgs.training import command
from warpgs.training import train as script

NETS = ["squeeze", "alex", "vgg"]
FILES = {"squeeze": "squeezenet1_1_features.pth", "alex": "alexnet-owt.pth", "vgg": "vgg16-397923af.pth"}

WEIGHTS = os.environ.get("WARPGS_LPIPS")
needs_weights = pytest.mark.skipif(not WEIGHTS, reason="WARPGS_LPIPS names no folder with the weights")


@pytest.fixture(autouse=True)
def _nothing_in_the_environment(monkeypatch):
    monkeypatch.delenv("WARPGS_LPIPS", raising=False)


def network(net):
    """LPIPS with random weights."""
    distance = lpips.Lpips(net)
    for parameter in distance.features.parameters():
        nn.init.normal_(parameter, std=0.05)
    for weight in distance.weights:
        nn.init.uniform_(weight)
    return distance.eval()


def write(folder, distance):
    """The two files, named and built as their authors' are."""
    folder.mkdir(exist_ok=True)
    features = {f"features.{name}": value for name, value in distance.features.state_dict().items()}
    torch.save({**features, "classifier.1.weight": torch.zeros(3)}, folder / FILES[distance.net])
    heads = {f"lin{k}.model.1.weight": w[None, :, None, None].clone() for k, w in enumerate(distance.weights)}
    torch.save(heads, folder / f"lpips_v0.1_{distance.net}_lin.pth")
    return folder


@pytest.fixture
def pair():
    return torch.rand(40, 44, 3), torch.rand(40, 44, 3)


@pytest.fixture(scope="module")
def real():
    return next(lpips.find(Path(WEIGHTS), net) for net in NETS if None not in lpips._files(Path(WEIGHTS), net))


@pytest.mark.parametrize("net", NETS)
def test_only_equal_images_have_no_distance_and_it_is_the_same_both_ways(net, pair):
    distance = network(net)
    assert distance(pair[0], pair[0].clone()).item() == 0.0
    assert distance(*pair).item() > 0.0
    assert distance(pair[1], pair[0]).item() == pytest.approx(distance(*pair).item(), rel=1e-5)


def test_the_distance_is_linear_in_the_weights_of_the_layers(pair):
    distance = network("squeeze")
    before = distance(*pair).item()
    for weight in distance.weights:
        weight.mul_(3.0)
    assert distance(*pair).item() == pytest.approx(3.0 * before, rel=1e-5)


def test_the_distance_does_not_depend_on_the_size_of_features(pair):
    """They are compared at unit length: scaling the last layer changes nothing that is compared after it."""
    distance = network("alex")
    before = distance(*pair).item()
    distance.features[10].weight.mul_(7.0)
    distance.features[10].bias.mul_(7.0)
    assert distance(*pair).item() == pytest.approx(before, rel=1e-4)


def test_features_that_are_all_zero_are_no_distance(pair):
    distance = network("squeeze")
    for parameter in distance.features.parameters():
        parameter.zero_()
    assert distance(*pair).item() == 0.0


def test_one_layer_by_hand():
    """Σ w (a/|a| − b/|b|)², averaged over the pixels of the first layer of AlexNet."""
    distance = network("alex")
    for weight in distance.weights[1:]:
        weight.zero_()
    image, truth = torch.rand(32, 36, 3), torch.rand(32, 36, 3)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    layer = distance.features[0].double()
    units = []
    for rgb in (image, truth):
        # The shift and scale of LPIPS are ImageNet's mean and deviation, for values in [-1, 1], rounded.
        x = ((rgb - mean) / std).permute(2, 0, 1)[None].double()
        units.append(nn.functional.normalize(torch.relu(layer(x)), dim=1))
    layer.float()
    expected = ((units[0] - units[1]) ** 2 * distance.weights[0][:, None, None]).sum(1).mean().item()
    assert distance(image, truth).item() == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize(("net", "count"), [("squeeze", 722_496), ("alex", 2_469_696), ("vgg", 14_714_688)])
def test_a_network_has_as_many_parameters_as_published(net, count):
    """The networks are the features of torchvision's SqueezeNet 1.1, AlexNet and VGG-16."""
    assert sum(p.numel() for p in lpips.Lpips(net).features.parameters()) == count


@pytest.mark.parametrize("net", NETS)
def test_the_smallest_images_leave_a_pixel_in_every_layer(net):
    assert torch.isfinite(network(net)(torch.rand(32, 32, 3), torch.rand(32, 32, 3)))


@pytest.mark.parametrize("size", [(31, 40), (40, 31), (1, 1)])
def test_smaller_images_are_refused(size):
    with pytest.raises(ValueError, match=r"LPIPS needs 32 pixels a side, got \["):
        network("squeeze")(torch.rand(*size, 3), torch.rand(*size, 3))


def test_no_gradient_is_kept(pair):
    assert not network("squeeze")(*pair).requires_grad


def bilinear(values, size):
    """A map enlarged to a size, pixel centres aligned, one pixel after the other."""
    result = torch.zeros(size, dtype=torch.float64)
    for i in range(size[0]):
        for j in range(size[1]):
            y = min(max((i + 0.5) * values.shape[0] / size[0] - 0.5, 0.0), values.shape[0] - 1.0)
            x = min(max((j + 0.5) * values.shape[1] / size[1] - 0.5, 0.0), values.shape[1] - 1.0)
            top, left = int(y), int(x)
            bottom, right = min(top + 1, values.shape[0] - 1), min(left + 1, values.shape[1] - 1)
            above = values[top, left] * (1 - x + left) + values[top, right] * (x - left)
            below = values[bottom, left] * (1 - x + left) + values[bottom, right] * (x - left)
            result[i, j] = above * (1 - y + top) + below * (y - top)
    return result


def test_masked_lpips_is_the_mean_of_the_enlarged_distances_of_masked_images(pair):
    distance, region = network("alex"), torch.zeros(40, 44, dtype=torch.bool)
    region[5:30, 8:40] = True
    black = [image * region[..., None] for image in pair]
    maps = [bilinear(layer.double(), (40, 44)) for layer in distance._layers(*black)]
    assert len(maps) == 5
    assert distance.masked(*pair, region).item() == pytest.approx(sum(maps)[region].mean().item(), rel=1e-5)


def test_masked_lpips_does_not_see_the_rest(pair):
    distance, region = network("squeeze"), torch.zeros(40, 44, dtype=torch.bool)
    region[5:30, 8:40] = True
    other = torch.where(region[..., None], pair[0], torch.rand(40, 44, 3))
    assert distance.masked(other, pair[1], region).item() == distance.masked(*pair, region).item()
    assert distance.masked(pair[0], pair[0], region).item() == 0.0


@pytest.mark.parametrize("net", NETS)
def test_written_weights_are_found_and_measure_the_same(net, pair, tmp_path):
    distance = network(net)
    found = lpips.find(write(tmp_path, distance), net)
    assert found.net == net
    assert found(*pair).item() == distance(*pair).item()


def test_the_linear_layers_may_be_named_as_their_authors_do(tmp_path, pair):
    distance = network("squeeze")
    write(tmp_path, distance)
    (tmp_path / "lpips_v0.1_squeeze_lin.pth").rename(tmp_path / "squeeze.pth")
    assert lpips.find(tmp_path, "squeeze")(*pair).item() == distance(*pair).item()


def test_a_folder_that_is_given_goes_before_one_in_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPGS_LPIPS", str(write(tmp_path / "squeeze", network("squeeze"))))
    assert lpips.find(None, "squeeze").net == "squeeze"
    assert lpips.find(write(tmp_path / "alex", network("alex")), "alex").net == "alex"


def test_without_a_folder_there_is_no_lpips():
    assert lpips.find(None, "vgg") is None
    assert lpips.locate(None, "vgg") is None


def test_weights_are_located_without_being_read(tmp_path):
    for name in (FILES["squeeze"], "lpips_v0.1_squeeze_lin.pth"):
        (tmp_path / name).write_bytes(b"not weights")
    assert lpips.locate(tmp_path, "squeeze") == tmp_path


@pytest.mark.parametrize("missing", [FILES["squeeze"], "lpips_v0.1_squeeze_lin.pth"])
def test_a_folder_that_lacks_a_file_says_what_is_wanted(tmp_path, missing):
    (write(tmp_path, network("squeeze")) / missing).unlink()
    wanted = r"LPIPS with --lpips-net squeeze \(squeezenet1_1\*\.pth and lpips_v0\.1_squeeze_lin\.pth\)$"
    with pytest.raises(ValueError, match=wanted):
        lpips.find(tmp_path, "squeeze")
    with pytest.raises(ValueError, match=r"squeeze.* is missing$"):
        lpips.load(tmp_path, "squeeze")


@pytest.mark.parametrize("net", NETS)
def test_no_other_network_takes_the_place_of_the_one_that_is_asked_for(tmp_path, net):
    others = [other for other in NETS if other != net]
    for other in others:
        for name in (FILES[other], f"lpips_v0.1_{other}_lin.pth"):
            (tmp_path / name).touch()
    with pytest.raises(ValueError, match=f"--lpips-net {net} .*; it has those of ") as caught:
        lpips.find(tmp_path, net)
    assert all(f"--lpips-net {other}" in str(caught.value) for other in others)
    assert "\n" not in str(caught.value)


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    wanted = f"{tmp_path}/nothing does not hold the weights of LPIPS .*: it does not exist"
    with pytest.raises(ValueError, match=wanted):
        lpips.locate(tmp_path / "nothing", "vgg")


def test_a_folder_that_is_misspelt_is_told_the_similar_one(tmp_path):
    (tmp_path / "weights").mkdir()
    wanted = rf"it does not exist; did you mean {re.escape(str(tmp_path / 'weights'))}\?$"
    with pytest.raises(ValueError, match=wanted):
        lpips.locate(tmp_path / "wieghts", "vgg")


@pytest.mark.parametrize("name", [FILES["squeeze"], "lpips_v0.1_squeeze_lin.pth"])
def test_a_damaged_file_is_named(tmp_path, name):
    path = write(tmp_path, network("squeeze")) / name
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=f"{path} cannot be read as weights"):
        lpips.find(tmp_path, "squeeze")


@pytest.mark.parametrize("name", [FILES.get, "lpips_v0.1_{}_lin.pth".format])
def test_weights_of_another_network_are_refused_in_one_line(tmp_path, name):
    write(tmp_path, network("squeeze"))
    write(tmp_path, network("alex"))
    (tmp_path / name("alex")).rename(tmp_path / name("squeeze"))
    with pytest.raises(ValueError, match=r"are not the weights of LPIPS \(squeeze\)") as caught:
        lpips.load(tmp_path, "squeeze")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [[1], torch.zeros(3), {"a": {"deeper": torch.zeros(3)}}, {1: torch.zeros(3)}])
def test_a_file_of_something_else_is_refused_in_words(tmp_path, content):
    path = write(tmp_path, network("squeeze")) / FILES["squeeze"]
    torch.save(content, path)
    with pytest.raises(ValueError, match=str(path)):
        lpips.find(tmp_path, "squeeze")


@pytest.mark.parametrize("name", [FILES["squeeze"], "lpips_v0.1_squeeze_lin.pth"])
def test_a_fifo_is_refused(tmp_path, name):
    path = write(tmp_path, network("squeeze")) / name
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ValueError, match=rf"({path} is not a file|is missing)"):
        lpips.load(tmp_path, "squeeze")


@pytest.mark.parametrize("name", ["features", "weights"])
def test_weights_that_are_not_finite_are_refused(tmp_path, name):
    distance = network("squeeze")
    next(getattr(distance, name).parameters()).data.view(-1)[3] = torch.nan
    write(tmp_path, distance)
    with pytest.raises(ValueError, match=r"holds values that are not finite: \w+"):
        lpips.load(tmp_path, "squeeze")


def test_a_file_with_code_is_refused_and_not_executed(tmp_path):
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    path = write(tmp_path, network("squeeze")) / FILES["squeeze"]
    torch.save({"features.0.weight": Bomb()}, path)
    with pytest.raises(ValueError, match="cannot be read as weights"):
        lpips.find(tmp_path, "squeeze")
    assert not (tmp_path / "executed").exists()


def test_a_file_whose_tensors_claim_more_than_it_holds_is_refused(tmp_path):
    path = write(tmp_path, network("squeeze")) / FILES["squeeze"]
    torch.save({"features.0.weight": torch.zeros(1).expand(1 << 20, 1 << 20)}, path)
    with pytest.raises(ValueError, match=r"features\.0\.weight has more numbers than the file has bytes"):
        lpips.find(tmp_path, "squeeze")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data + bytes(10_000))
    with pytest.raises(ValueError, match="cannot be read as weights: its content is compressed"):
        lpips.find(tmp_path, "squeeze")


@needs_weights
def test_real_weights_give_equal_images_no_distance(real, pair):
    assert real(pair[0], pair[0].clone()).item() == 0.0


@needs_weights
def test_real_weights_of_the_layers_are_not_negative(real):
    assert all(bool((weight >= 0).all()) for weight in real.weights)


@needs_weights
def test_real_weights_call_more_noise_farther(real):
    truth = torch.linspace(0, 1, 64).expand(64, 64)[..., None].repeat(1, 1, 3)
    noise = torch.randn(64, 64, 3)
    distances = [real((truth + s * noise).clamp(0, 1), truth).item() for s in (0.01, 0.05, 0.2)]
    assert 0.0 < distances[0] < distances[1] < distances[2] < 2.0


@needs_weights
def test_real_weights_call_blur_farther_than_a_change_of_brightness_of_the_same_psnr(real):
    """Images of equal PSNR that LPIPS is made to tell apart."""
    truth = torch.rand(16, 16, 3).repeat_interleave(4, 0).repeat_interleave(4, 1) * 0.6 + 0.2
    blurred = nn.functional.avg_pool2d(truth.permute(2, 0, 1), 7, 1, 3, count_include_pad=False).permute(1, 2, 0)
    brighter = truth + (blurred - truth).square().mean().sqrt()
    assert real(blurred, truth).item() > 2.0 * real(brighter, truth).item()


def test_training_with_a_wrong_folder_is_refused_before_any_work(tmp_path):
    config = dataclasses.replace(TrainConfig(), data=tmp_path / "capture", out=tmp_path / "run", lpips=tmp_path)
    with pytest.raises(ValueError, match="does not hold the weights of LPIPS"):
        script.make_trainer(config)
    assert not (tmp_path / "run").exists()


def test_resuming_with_a_folder_that_is_gone_is_refused_before_any_work(data, tmp_path):
    weights = write(tmp_path / "weights", network("squeeze"))
    config = dataclasses.replace(tiny.CONFIG, data=data, out=tmp_path / "run", lpips=weights, lpips_net="squeeze")
    run = script.make_trainer(config).run
    shutil.rmtree(weights)
    with pytest.raises(ValueError, match=f"{weights} does not hold the weights of LPIPS"):
        script.make_trainer(command.parse(["--resume", str(run)]))
