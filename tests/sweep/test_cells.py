"""The plan of a sweep: which cells there are, and with which commands."""

import dataclasses
import json
import os
import re
import shlex
from pathlib import Path

import pytest

from tests import plain
from tests.data import layouts
from warpgs.config import TrainConfig
from warpgs.config.presets import PRESETS
from warpgs.data.writer import STATE, WORK
from warpgs.sweep.cells import (
    arguments,
    as_evaluated_before,
    equal_variants,
    find_problems,
    find_scenes,
    finished_metrics,
    is_evaluated,
    parse_evaluation,
    plan_cells,
    trained_captures,
)
from warpgs.sweep.spec import SweepSpec, Variant, read_spec
from warpgs.training.command import parse


def spec(*variants, seeds=(0,), options=None):
    return SweepSpec(Path("mine"), "Mine", "best", seeds, (), options or {}, variants or (Variant("full", "full", {}),))


def plan(spec, scenes=None, out=None, **overrides):
    return plan_cells(spec, scenes or {"as": "/nerfds/as"}, out, overrides)


def test_there_is_a_cell_for_every_variant_capture_and_seed_and_seeds_come_last(tmp_path):
    two = spec(Variant("a", "", {}), Variant("b", "", {}), seeds=(4, 7))
    names = [cell.name for cell in plan(two, {"x": "/x", "y": "/y"}, tmp_path)]
    first = ["x-a-seed4", "x-b-seed4", "y-a-seed4", "y-b-seed4"]
    assert names == [*first, *(name.replace("4", "7") for name in first)]


def test_the_command_line_precedes_the_variant_which_precedes_the_file(tmp_path):
    variant = Variant("v", "", {"factor": 2, "loss": {"ssim": 0.5}})
    made = spec(variant, options={"factor": 1, "loss": {"ssim": 0.1, "depth": 9.0}})
    assert (plan(made, out=tmp_path)[0].config.factor, plan(made, out=tmp_path, factor=4)[0].config.factor) == (2, 4)
    loss = plan(made, out=tmp_path)[0].config.loss
    assert (loss.ssim, loss.depth, loss.squared) == (0.5, 9.0, PRESETS["best"].loss.squared)


@pytest.mark.parametrize("name", ["ablation", "best", "masks", "scenes", "seeds"])
def test_the_command_of_a_cell_trains_its_config(name, tmp_path):
    for cell in plan(read_spec(name), out=tmp_path):
        assert parse(arguments(cell.config)) == cell.config
        assert cell.command.startswith("warpgs train --preset ")


def test_every_line_about_best_trains_something_else(tmp_path):
    configs = [dataclasses.replace(cell.config, out=None, seed=0) for cell in plan(read_spec("best"), out=tmp_path)]
    assert all(config not in configs[:k] for k, config in enumerate(configs))


def test_every_term_of_the_loss_that_best_changes_has_a_line_and_so_has_the_fit_of_motion(tmp_path):
    configs = [cell.config for cell in plan(read_spec("best"), out=tmp_path)]
    best, usual = PRESETS["best"].loss, plain.loss()
    for field in dataclasses.fields(best):
        if getattr(best, field.name) != getattr(usual, field.name):
            assert any(getattr(c.loss, field.name) != getattr(best, field.name) for c in configs), field.name
    assert any(config.schedule.fit_motion == 0 for config in configs)


def test_every_option_survives_the_way_through_the_command_line(tmp_path):
    def changed(config):
        values = {}
        for field in dataclasses.fields(config):
            value = getattr(config, field.name)
            if dataclasses.is_dataclass(value):
                values[field.name] = changed(value)
            elif isinstance(value, bool):
                values[field.name] = not value
            elif isinstance(value, int | float):
                values[field.name] = value + 1
        return dataclasses.replace(config, **values)

    config = changed(TrainConfig(preset="best", background=(0.1, 0.2, 0.3)))
    assert parse(arguments(config)) == config


def test_a_sweep_may_name_a_colour(tmp_path):
    [cell] = plan(spec(options={"background": [0.1, 0.2, 0.3]}), out=tmp_path)
    assert parse(arguments(cell.config)).background == (0.1, 0.2, 0.3)


@pytest.mark.parametrize("options", [{}, {"assume": "auto"}])
def test_cells_follow_the_masks_unless_the_sweep_says_otherwise(options, tmp_path):
    [cell] = plan(spec(options=options), out=tmp_path)
    assert cell.config.assume == options.get("assume", "masks")


def test_two_cells_with_one_name_are_refused(tmp_path):
    two = spec(Variant("c", "", {}), Variant("b-c", "", {}))
    with pytest.raises(ValueError, match="two cells have the name a-b-c-seed0: variant b-c on a, and variant c on a-b"):
        plan(two, {"a": "/a", "a-b": "/b"}, tmp_path)


def test_variants_are_equal_if_they_train_the_same_on_one_capture_whatever_its_names(tmp_path):
    different = (Variant("a", "", {}), Variant("b", "", {"omit": ["app"]}))
    scenes = {"first": "/as", "second": "/as"}
    assert equal_variants(plan(spec(*different), scenes, tmp_path)) == []
    assert equal_variants(plan(spec(*different, Variant("c", "", {})), scenes, tmp_path)) == [["a", "c"]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"iterations": "many"}, "mine: variant v: iterations cannot be 'many'"),
        ({"model": {"sh_degree": 4}}, "mine: variant v: expected model.sh_degree <= 3, got 4"),
        ({"optim": {"means": "x"}}, "mine: variant v: optim.means cannot be 'x'"),
        ({"densify": {"every": 0}}, "mine: variant v: densify.every must be a number of at least 1"),
    ],
)
def test_options_that_cannot_be_are_refused_before_anything_is_trained(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        plan(spec(Variant("v", "", options)), out=tmp_path)


def test_a_folder_of_captures_stands_for_the_captures_in_it(tmp_path):
    for name in ("bell", "as"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "dataset.json").write_text("{}")
    for name in ("notes", "broken", ".git"):
        (tmp_path / name).mkdir()
    (tmp_path / "notes.txt").touch()
    lines = []
    found = find_scenes([str(tmp_path)], lines.append)
    assert lines == [f"warning: {tmp_path}: skipped folders that are not captures: broken, notes"]
    assert found == {"as": str(tmp_path / "as"), "bell": str(tmp_path / "bell")}
    assert find_scenes([str(tmp_path / "as")], lines.append) == {"as": str(tmp_path / "as")}
    assert len(lines) == 1


def test_a_folder_of_captures_also_stands_for_those_that_were_trained_and_are_gone(tmp_path):
    (tmp_path / "cup").mkdir()
    (tmp_path / "cup/dataset.json").touch()
    known = ["builtin:room", str(tmp_path / "other/as"), str(tmp_path / "cup/bell"), str(tmp_path / "bell")]
    expected = {name: str(tmp_path / name) for name in ("bell", "cup")}
    assert list(find_scenes([str(tmp_path)], known=known).items()) == list(expected.items())
    assert find_scenes([str(tmp_path / "cup")], known=known) == {"cup": expected["cup"]}
    assert find_scenes([f"horn={tmp_path}/bell", str(tmp_path)], known=known) == {
        "horn": expected["bell"],
        "cup": expected["cup"],
    }


def test_a_folder_without_captures_has_no_skipped_folders(tmp_path):
    (tmp_path / "notes").mkdir()
    lines = []
    assert find_scenes([str(tmp_path)], lines.append) == {tmp_path.name: str(tmp_path)}
    assert not lines


@pytest.mark.parametrize("write", [layouts.write_colmap, layouts.write_nerfstudio, layouts.write_llff])
def test_a_folder_of_captures_may_have_any_layout(write, tmp_path):
    for name in ("bell", "as"):
        write(tmp_path / name)
    (tmp_path / "notes.txt").write_text("")
    assert list(find_scenes([str(tmp_path)]).items()) == [(name, str(tmp_path / name)) for name in ("as", "bell")]
    assert find_scenes([str(tmp_path / "bell")]) == {"bell": str(tmp_path / "bell")}


def test_captures_can_be_named_and_built_in_ones_keep_their_name(tmp_path):
    (tmp_path / "dataset.json").touch()
    assert find_scenes([f"mine={tmp_path}", "builtin:room", "b=builtin:room"]) == {
        "mine": str(tmp_path),
        "room": "builtin:room",
        "b": "builtin:room",
    }


@pytest.mark.parametrize("name", ["", "../esc", "a/b", "a|b"])
def test_a_name_of_a_capture_that_no_folder_can_have_is_refused(tmp_path, name):
    (tmp_path / "dataset.json").touch()
    message = re.escape(f"there is no capture {name}={tmp_path}: {name!r} cannot be a name")
    with pytest.raises(ValueError, match=message):
        find_scenes([f"{name}={tmp_path}"])


def test_two_captures_with_one_name_are_refused(tmp_path):
    first, second = tmp_path / "x/as", tmp_path / "y/as"
    for root in (first, second):
        root.mkdir(parents=True)
        (root / "dataset.json").touch()
    message = f"two captures have the name as: {first} and {second}; name one with --data NAME={second}"
    with pytest.raises(ValueError, match=message):
        find_scenes([str(first), str(second)])


@pytest.mark.parametrize("name", ["", "as="])
def test_what_is_no_capture_has_the_problem_that_training_names(name, tmp_path):
    (tmp_path / "empty").mkdir()
    for path, problem in (("nowhere", "does not exist"), ("empty", "has no dataset.json and the files of no other")):
        found = find_problems(find_scenes([f"{name}{tmp_path / path}"]))
        assert list(found) == [name.rstrip("=") or path]
        assert f"{tmp_path / path} {problem}" in found[name.rstrip("=") or path]


@pytest.fixture
def closed(tmp_path, monkeypatch):
    """One of two captures, which may not be read; the other is ``good``."""
    for name in ("good", "closed"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "dataset.json").touch()
    exists = Path.exists

    def refuse(path):
        if "closed" in path.parts:
            raise PermissionError(f"[Errno 13] Permission denied: '{path}'")
        return exists(path)

    monkeypatch.setattr(Path, "exists", refuse)
    return tmp_path / "closed"


def test_a_capture_that_cannot_be_read_has_a_problem_and_others_do_not(tmp_path, closed):
    scenes = {name: str(tmp_path / name) for name in ("good", "closed")} | {"room": "builtin:room"}
    assert find_problems(scenes) == {"closed": f"[Errno 13] Permission denied: '{closed / 'dataset.json'}'"}


@pytest.mark.parametrize("denied", [os.R_OK, os.X_OK])
def test_a_folder_that_may_not_be_read_stands_for_itself_and_is_skipped_in_others(
    tmp_path, monkeypatch, closed, denied
):
    monkeypatch.setattr(os, "access", lambda path, mode: not ("closed" in Path(path).parts and mode & denied))
    lines = []
    assert find_scenes([str(tmp_path)], lines.append) == {"good": str(tmp_path / "good")}
    assert lines == [f"warning: {tmp_path}: skipped folders that are not captures: closed"]
    assert find_scenes([str(closed)]) == {"closed": str(closed)}
    assert find_scenes([str(closed)], known=[str(closed / "as")]) == {"as": str(closed / "as")}


def test_the_captures_of_cells_are_what_their_commands_train_on_each_once(tmp_path):
    captures = {"my cup": str(tmp_path / "my cup"), "room": "builtin:room", "as": str(tmp_path / "as")}
    cells = plan(spec(Variant("data", "", {}), Variant("b", "", {"omit": ["app"]}), seeds=(0, 1)), captures, tmp_path)
    assert trained_captures([*(cell.command for cell in cells), "warpgs train --preset quick"]) == [*captures.values()]


@pytest.mark.parametrize("path", ["scenes", "scenes/b"])
def test_a_capture_that_prepare_has_not_finished_has_a_problem_before_anything_is_trained(path, tmp_path):
    for name, done in (("a", '{"finished": {}}'), ("b", "{}")):
        (tmp_path / "scenes" / name / WORK).mkdir(parents=True)
        (tmp_path / "scenes" / name / "dataset.json").write_text("{}")
        (tmp_path / "scenes" / name / WORK / STATE).write_text(f'{{"done": {done}}}')
    problems = find_problems(find_scenes([str(tmp_path / path)]))
    assert list(problems) == ["b"]
    assert f"{tmp_path}/scenes/b is not finished" in problems["b"]


def test_a_sweep_without_captures_is_refused():
    with pytest.raises(ValueError, match="give them with --data"):
        find_scenes([])


def test_a_query_is_appended_to_built_in_captures_only(tmp_path):
    made = spec(Variant("n", "", {}, "depth=network"))
    assert str(plan(made, {"s": "builtin:studio"}, tmp_path)[0].config.data) == "builtin:studio?depth=network"
    message = "variant n needs a plain built-in capture such as --data builtin:studio, got /as"
    with pytest.raises(ValueError, match=message):
        plan(made, {"as": "/as"}, tmp_path)


def test_an_unknown_built_in_capture_is_refused_before_anything_is_trained(tmp_path):
    for data in ("builtin:synthetic", "builtin:room?depth=none"):
        with pytest.raises(ValueError, match="there is no built-in capture builtin:"):
            plan(spec(), {"s": data}, tmp_path)


def test_cells_that_are_evaluated_in_another_way_are_trained_by_the_same_command(tmp_path):
    commands = [
        plan(spec(), out=tmp_path, **options)[0].command
        for options in ({}, {"lpips": str(tmp_path / "my weights"), "lpips_net": "alex"}, {"lpips_net": "alex"})
    ]
    assert len(set(commands)) == 3
    assert all(parse_evaluation(command)[1] == shlex.split(commands[0]) for command in commands)
    [other] = plan(spec(), out=tmp_path, factor=2)
    assert parse_evaluation(other.command)[1] != shlex.split(commands[0])


def test_a_cell_keeps_how_it_was_evaluated_before_unless_told_otherwise(tmp_path):
    before = {"lpips": str(tmp_path / "weights"), "lpips_net": "alex"}
    [measured] = plan(spec(), out=tmp_path, **before)
    for options, expected in (
        ({"lpips_net": "vgg"}, (tmp_path / "weights", "vgg")),
        ({"lpips": str(tmp_path / "others")}, (tmp_path / "others", "alex")),
    ):
        [cell] = plan(spec(), out=tmp_path, **options)
        config = as_evaluated_before(cell, measured.command, options).config
        assert (config.lpips, config.lpips_net) == expected
    [cell] = plan(spec(), out=tmp_path)
    assert as_evaluated_before(cell, "", {}) == cell
    assert as_evaluated_before(cell, measured.command, {}) == measured


@pytest.mark.parametrize(
    ("options", "metrics", "expected"),
    [
        ({}, {"lpips_net": None}, True),
        ({"lpips": "/weights"}, {"lpips_net": None}, False),
        ({"lpips": "/weights"}, {"lpips_net": "vgg"}, True),
        ({"lpips": "/weights", "lpips_net": "alex"}, {"lpips_net": "vgg"}, False),
    ],
)
def test_a_cell_is_evaluated_again_if_its_metrics_are_not_what_is_asked_for(tmp_path, options, metrics, expected):
    [cell] = plan(spec(), out=tmp_path, **options)
    assert is_evaluated(cell, metrics) == expected


def test_a_cell_is_finished_once_its_last_iteration_was_evaluated(tmp_path):
    (cell,) = plan(spec(), out=tmp_path, iterations=300)
    assert cell.num_iterations == 300
    assert finished_metrics(cell) is None
    cell.folder.mkdir()
    for iterations, expected in ((200, None), (300, {"iterations": 300})):
        (cell.folder / "metrics.json").write_text(json.dumps({"iterations": iterations}))
        assert finished_metrics(cell) == expected
