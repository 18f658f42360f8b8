"""What is said of a capture that does not exist."""

from pathlib import Path

import pytest

from tests.errors import error_line
from warpgs.captures.opening import load_capture
from warpgs.data.published import PUBLISHED, dataset_in

NERFDS = "https://github.com/JokerYan/NeRF-DS"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def message(path, dataset=None):
    with pytest.raises(ValueError, match="does not exist") as caught:
        load_capture(path, dataset)
    return str(caught.value)


def captures(*paths):
    for path in map(Path, paths):
        path.mkdir(parents=True)
        (path / "dataset.json").touch()


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("nerfds/as", "; warpgs download nerfds as downloads it; "),
        ("/nowhere/nerfds/as", "; warpgs download nerfds as --to /nowhere downloads it; "),
        ("data/NeRF-DS/as", "; warpgs download nerfds as --to data downloads it to data/nerfds/as; "),
        ("nerfds", "; warpgs download nerfds downloads it; "),
        ("data/nerf_ds", "; warpgs download nerfds --to data downloads it to data/nerfds; "),
        ("hypernerf/hand", "; warpgs download hypernerf hand downloads it; "),
        ("dnerf/hook", "; warpgs download dnerf hook downloads it; "),
        ("/nowhere/NeRF-DS/as_novel_view", NERFDS),
        ("nerfds/as/rgb", NERFDS),
        ("hypernerf/vrig/vrig-chicken", "https://github.com/google/hypernerf/releases"),
        ("nerfies/dog", "https://github.com/google/nerfies"),
        ("dycheck/iphone/spin", "https://github.com/KAIR-BAIR/dycheck"),
        ("iphone/paper-windmill", "https://github.com/KAIR-BAIR/dycheck"),
        ("D-NeRF/data/lego", "https://github.com/albertpumarola/D-NeRF"),
        ("nvidia/Balloon1", "https://gorokee.github.io/jsyoon/dynamic_synth"),
        ("hand", "https://github.com/facebookresearch/nonrigid_nerf"),
        ("nonrigid_nerf/data/example_sequence", "https://github.com/facebookresearch/nonrigid_nerf"),
    ],
)
@pytest.mark.parametrize("dataset", [None, "nerfds"])
def test_a_path_that_is_named_after_a_public_dataset_says_where_that_is_and_what_there_is_without(
    path, source, dataset
):
    said = message(path, dataset)
    assert said.startswith(f"{path} does not exist; ")
    assert source in said
    for other in ("warpgs train (a built-in scene)", "--data builtin:studio", "warpgs prepare VIDEO CAPTURE"):
        assert other in said
    assert "\n" not in said


@pytest.mark.parametrize("path", ["holiday", "videos/garden", "my-iphone-video", "as"])
def test_other_paths_are_told_no_source(path):
    assert message(path) == f"{path} does not exist"


@pytest.mark.parametrize("name", ["as_novel_view", "AS", "as-2x"])
def test_a_folder_nearby_that_has_the_words_of_the_name_is_named(name):
    Path("nerfds", name).mkdir(parents=True)
    Path("nerfds/basin").mkdir()
    assert message("nerfds/as").startswith(f"nerfds/as does not exist; did you mean nerfds/{name}? warpgs download")


def test_captures_farther_below_are_named_the_most_similar_first():
    captures("data/NeRF-DS/as_novel_view", "data/mine/as", "data/NeRF-DS/basin")
    assert "; did you mean data/mine/as or data/NeRF-DS/as_novel_view?" in message("nerfds/as")


def test_folders_farther_below_that_are_no_captures_and_runs_are_not_named():
    Path("data/as").mkdir(parents=True)
    Path("as-best").mkdir()
    Path("as-best/config.json").touch()
    assert message("as") == "as does not exist"


@pytest.mark.parametrize(
    "arguments",
    [
        *(["train", "--data", "nerfds/as"], ["check", "nerfds/as"], ["prepare", "nerfds/as", "--add", "depth"]),
        ["sweep", "scenes", "--data", "nerfds/as", "--dry-run"],
    ],
)
def test_every_command_says_so(capsys, arguments):
    assert "; warpgs download nerfds as downloads it; " in error_line(capsys, *arguments)


def test_names_of_datasets_are_those_that_paths_are_compared_with():
    for dataset in PUBLISHED:
        for part in dataset.parts:
            assert dataset_in(Path(part, "scene")) == dataset
