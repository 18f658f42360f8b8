"""SOG: the layout of its specification, and a loss that is not visible."""

import dataclasses
import io
import json
import zipfile

import numpy as np
import pytest
from PIL import Image

from tests.export import scenes
from warpgs.formats import sog
from warpgs.formats.cloud import Cloud, logit
from warpgs.formats.sog import fit_table, write_sog


def parts(path):
    """The metadata and the images."""
    with zipfile.ZipFile(path) as file:
        meta = json.loads(file.read("meta.json"))
        names = [name for name in file.namelist() if name.endswith(".webp")]
        return meta, {name: np.asarray(Image.open(io.BytesIO(file.read(name)))) for name in names}


def decoded(path):
    """The cloud of a file, by the specification."""
    meta, images = parts(path)
    N = meta["count"]

    def pixels(part, index=0):
        image = images[meta[part]["files"][index]]
        return image.reshape(-1, image.shape[2])[:N]

    def table(part, indices):
        return np.array(meta[part]["codebook"])[indices]

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    logs = low + (high - low) * (pixels("means", 0) + 256.0 * pixels("means", 1)) / 65535
    quats, packed = np.zeros((N, 4)), pixels("quats")
    for k, row in enumerate(packed):
        largest = row[3] - 252
        quats[k, [a for a in range(4) if a != largest]] = (row[:3] / 255 * 2 - 1) / np.sqrt(2)
        quats[k, largest] = np.sqrt(1 - (quats[k] ** 2).sum())
    sh = table("sh0", pixels("sh0")[:, None, :3])
    if "shN" in meta:
        rest = (meta["shN"]["bands"] + 1) ** 2 - 1
        labels = pixels("shN", 1).astype(int)
        labels = labels[:, 0] + 256 * labels[:, 1]
        palette = images[meta["shN"]["files"][0]]
        assert palette.shape[1] == 64 * rest
        entries = palette.reshape(-1, rest, palette.shape[2])[..., :3]
        assert labels.max() < meta["shN"]["count"] <= len(entries)
        sh = np.concatenate([sh, table("shN", entries[labels])], 1)
    return Cloud(
        means=(np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
        quats=quats.astype(np.float32),
        log_scales=table("scales", pixels("scales")).astype(np.float32),
        logit_opacities=logit(pixels("sh0")[:, 3] / 255).astype(np.float32),
        sh=sh.astype(np.float32),
        is_dynamic=np.zeros(N, bool),
        antialias=meta.get("model") == "antialiased",
    )


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("num", [1, 200])
def test_the_image_is_nearly_the_same_after_export(path, degree, num):
    cloud = scenes.cloud(num, degree)
    assert write_sog(path, cloud) == path.stat().st_size
    back = decoded(path)
    assert back.sh.shape == (num, (degree + 1) ** 2, 3)
    assert np.abs(np.sort(back.means, 0) - np.sort(cloud.means, 0)).max() < 1e-4
    assert scenes.psnr(scenes.image(back), scenes.image(cloud)) > 42


def test_the_palette_of_a_large_scene_is_clustered(path, monkeypatch):
    monkeypatch.setattr(sog, "MAX_PALETTE", 100)
    monkeypatch.setattr(sog, "CLUSTERS", 128)
    cloud = scenes.cloud(400, 1)
    write_sog(path, cloud)
    assert parts(path)[0]["shN"]["count"] == 128
    clustered = decoded(path)
    monkeypatch.setattr(sog, "CLUSTER_ITERATIONS", 0)
    write_sog(path, cloud)
    order = sog.morton_order(cloud.means)

    def error(back):
        return np.square(back.sh[:, 1:] - cloud.sh[order, 1:]).mean()

    assert error(clustered) < 0.95 * error(decoded(path))
    assert error(clustered) < 0.5 * cloud.sh[:, 1:].var()


def test_a_table_follows_the_distribution_and_keeps_outliers():
    values = np.concatenate([np.random.default_rng(0).normal(size=20_000), [50.0]]).astype(np.float32)
    indices, table = fit_table(values)
    assert (np.diff(table) >= 0).all()
    assert table[indices[-1]] == 50
    assert np.square(table[indices] - values).mean() < 0.25 * (2 * 51 / 256) ** 2 / 12


def test_equal_values_are_exact():
    indices, table = fit_table(np.full((5, 3), 0.25, np.float32))
    assert (table[indices] == 0.25).all()


@pytest.mark.parametrize("antialias", [False, True])
def test_the_metadata_say_whether_to_antialias(path, antialias):
    write_sog(path, dataclasses.replace(scenes.cloud(3), antialias=antialias))
    assert decoded(path).antialias == antialias


def test_equal_scenes_give_equal_files(path, tmp_path):
    write_sog(path, scenes.cloud(20))
    write_sog(tmp_path / "b.sog", scenes.cloud(20))
    assert path.read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_an_empty_cloud_is_refused(path):
    with pytest.raises(ValueError, match=f"{path}: SOG needs at least one Gaussian"):
        write_sog(path, scenes.cloud(0))
    assert not path.exists()
