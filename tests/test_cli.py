"""The command itself."""

import contextlib
import importlib.metadata
import io
import os
import re
import subprocess
import sys

import pytest

from warpgs.cli import COMMANDS, TRAIN_OPTIONS, Command, main
from warpgs.command_line.parsing import described, flags
from warpgs.config import TrainConfig


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)], ids=str)
def test_every_command_says_the_version(command, capsys):
    assert main([*command, "--version"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == f"warpgs {importlib.metadata.version('warpgs')}"
    assert second.startswith("cpu: kernels for it are ") or second.startswith("cuda (")


def test_the_version_is_said_although_a_package_is_missing(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "warpgs.runtime.machine", None)
    assert main(["--version"]) == 2
    said = capsys.readouterr()
    assert said.out == f"warpgs {importlib.metadata.version('warpgs')}\n"
    assert said.err.startswith("warpgs: import of warpgs.runtime.machine halted")
    assert said.err.count("\n") == 1


def shown(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    assert end.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("option", ["--help", "-h", "--help-all"])
def test_the_list_of_commands_fits_on_a_screen(option, capsys):
    assert main([option]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 24
    assert max(map(len, lines)) <= 90
    assert all(any(line.split()[:1] == [name] for line in lines) for name in COMMANDS)


def test_help_of_train_is_short_and_help_all_complete(capsys):
    short, complete = shown(capsys, "train", "--help"), shown(capsys, "train", "--help-all")
    options = re.compile(r"^[│ ] --([a-z.-]+)", re.MULTILINE)
    assert len(options.findall(short)) == len(TRAIN_OPTIONS) == 14
    assert len(options.findall(complete)) > 60
    assert "--densify.max-gaussians INT" in complete
    assert "warpgs train --help-all" in short
    assert shown(capsys, "train", "--help") == short


@pytest.mark.parametrize("command", sorted(set(COMMANDS) - {"train"}))
def test_other_commands_show_all_options_at_once(command, capsys):
    assert shown(capsys, command, "--help-all") == shown(capsys, command, "--help")


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [(["train", "--help-all"], b"max-gaussians INT"), (["check", "empty \N{RIGHTWARDS ARROW}"], rb"empty \u2192")],
)
def test_what_the_output_cannot_represent_is_escaped(arguments, shown, monkeypatch, tmp_path):
    (tmp_path / "empty \N{RIGHTWARDS ARROW}").mkdir()
    monkeypatch.chdir(tmp_path)
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, "cp1252", write_through=True))
    with contextlib.suppress(SystemExit):
        assert main(arguments) in (0, 1)
    assert shown in written.getvalue()


@pytest.mark.parametrize("columns", [60, 80])
@pytest.mark.parametrize("arguments", [[], ["train"], ["train", "--help-all"], *([name] for name in COMMANDS)])
def test_help_breaks_between_words_and_fits_the_terminal(arguments, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    with contextlib.suppress(SystemExit):
        main([*arguments, *(["--help"] if len(arguments) == 1 else [])])
    text = capsys.readouterr().out
    assert [line for line in text.splitlines() if len(line) > columns] == []
    monkeypatch.setenv("COLUMNS", "300")
    with contextlib.suppress(SystemExit):
        main([*arguments, *(["--help"] if len(arguments) == 1 else [])])
    words = {word.strip("[]") for word in capsys.readouterr().out.replace("│", " ").split()}
    assert [word for word in text.replace("│", " ").split() if word.isalpha() and word not in words] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_rewrapped_and_names_what_is_expected(command, capsys):
    text = shown(capsys, command, "--help-all" if command == "train" else "--help")
    assert "{None}" not in text
    assert "``" not in text
    assert "(default: None)" not in text
    assert not re.search(r"the\s+default\s+is((?!\s--)[^(])*\(default:", text)  # once is enough, in one option
    # a line ends early only at the end of a text
    broken = re.findall(r"^[│ ] {10,}\S[^│\n]{1,25}[a-z,] {20,}│?\n[│ ] {10,}[a-z]", text, re.MULTILINE)
    assert broken == []


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_whether_a_switch_is_on_by_default(command, capsys):
    text = shown(capsys, command, "--help-all" if command == "train" else "--help")
    options = re.split(r"^[│ ] (?=-)", text, flags=re.MULTILINE)
    switches = [
        " ".join(option.replace("│", "").split()) for option in options if re.match(r"--(\S+), --\S*no-", option)
    ]
    assert len(switches) == sum(re.match(r"--(.*\.)?no-", flag) is not None for flag in flags(COMMANDS[command].load()))
    assert [switch for switch in switches if not re.search(r"\(default: (yes|no)\)", switch)] == []


@pytest.mark.parametrize(
    ("command", "metavars"),
    [("prepare", "SOURCE"), ("check", "CAPTURE"), ("eval", "RUN"), ("export", "RUN"), ("render", "RUN")],
)
def test_positional_arguments_have_names(command, metavars, capsys):
    named = shown(capsys, command, "--help").partition("positional arguments")[2].partition("options")[0]
    assert re.findall(r"^[│| ]*([A-Z]+) ", named, re.MULTILINE) == metavars.split()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["exprot"], "warpgs: there is no command exprot; did you mean export?"),
        (["xyz"], "warpgs: there is no command xyz; warpgs --help lists all"),
        (["train", "--help-al"], "warpgs train: there is no option --help-al; did you mean --help-all?"),
        (["check", "--helpall"], "warpgs check: there is no option --helpall; did you mean --help-all?"),
        (["train", "--hel"], "warpgs train: there is no option --hel; did you mean --help?"),
        (["train", "-help"], "warpgs train: unrecognized options: -help; did you mean --help?"),
        (["view", "--versoin"], "warpgs view: there is no option --versoin; did you mean --version?"),
        (["--help-al"], "warpgs: there is no command --help-al; did you mean --help-all?"),
        (["export", "--fromat", "ply"], "warpgs export: there is no option --fromat; did you mean --format?"),
        (["train", "--iteratons=3"], "warpgs train: there is no option --iteratons; did you mean --iterations?"),
        (["train", "--model.dept", "3"], "warpgs train: there is no option --model.dept; did you mean --model.depth?"),
        (
            ["train", "--schedule.relight_from=1"],
            "warpgs train: there is no option --schedule.relight-from; it is --schedule.appearance-from now\n",
        ),
        (
            ["train", "--densify.no-depth-gradients"],
            "warpgs train: there is no option --densify.no-depth-gradients any more: omit it\n",
        ),
        (["train", "--quiet"], "warpgs train: there is no option --quiet; warpgs train --help lists all"),
        (["render", "r", "--zzz"], "warpgs render: there is no option --zzz; warpgs render --help lists all"),
        (["\x1b[2J"], "warpgs: there is no command \\x1b[2J; warpgs --help lists all"),
        (["export", "--\x1b[2J"], "warpgs export: there is no option --\\x1b[2J; "),
        (["export"], "warpgs export: missing: RUN\n"),
        (["import"], "warpgs import: missing: SOURCE CAPTURE\n"),
        (["train", "--resume"], "warpgs train: missing value for --resume\n"),
        (["train", "--iterations", "x"], "warpgs train: error parsing --iterations: expected INT, got 'x'"),
        (
            ["train", "--model.appearance-size", "4"],
            "warpgs train: --model.appearance-size needs 2 values, INT INT; got 4\n",
        ),
        (
            ["train", "--background", "blue"],
            "warpgs train: error parsing --background: expected auto, sky, mean, capture, black, white or FLOAT FLOAT "
            "FLOAT, got 'blue'\n",
        ),
        (
            ["import", "a", "b", "--holdout-camera", "right"],
            "warpgs import: error parsing --holdout-camera: no value is written as 'right'\n",
        ),
        (["train", "--no-dap"], "warpgs train: there is no option --no-dap any more: --omit dap omits it\n"),
        (
            ["render", "r", "--freeze", "1", "abc"],
            "warpgs render: --freeze needs 2 values, NAME TIME, of which TIME is a number; got abc\n",
        ),
        (["view", "r", "--freeze", "1"], "warpgs view: --freeze needs 2 values, NAME TIME; got fewer\n"),
        (
            ["export", "r", "--crop", "1", "2", "3"],
            "warpgs export: --crop needs 6 values, X Y Z X Y Z; got 1 2 3\n",
        ),
        (["report", "r", "--views", "x"], "warpgs report: error parsing --views: expected INT, got 'x'"),
        (["prepare", "v", "c", "--start", "x"], "warpgs prepare: error parsing --start: expected FLOAT, got 'x'"),
        (["train", "--preset", "x"], "warpgs train: --preset must be one of best, paper, patient, quick, got 'x'\n"),
        (["train", "--device", "x"], "warpgs train: --device must be one of cpu, cuda, got 'x'\n"),
        (
            ["render", "r", "--layers", "it's"],
            "warpgs render: --layers must be one of all, alpha, depth, dynamic, joint, objects, static, got ",
        ),
        (
            ["train", "--factor", "2", "capture"],
            "warpgs train: unrecognized options: capture; a capture is given by --data capture\n",
        ),
        (
            ["train", "--dataset", "nerfds"],
            "warpgs train: --dataset says how the capture of --data is read: add --data",
        ),
        (
            ["train", "--resume", "r", "--seed", "1"],
            "warpgs train: --resume takes all but --data, --device, --iterations and --lpips from",
        ),
        (
            ["train", "--resume", "r", "--lpips-net", "alex"],
            "warpgs train: --lpips-net with --resume needs --lpips, the folder of its weights\n",
        ),
    ],
)
def test_a_wrong_option_ends_with_one_line(arguments, message, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(message)
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["train", "--preset", "bets"], "best"),
        (["train", "--preset", "BEST"], "best"),
        (["train", "--preset", "bes't"], "best"),
        (["train", "--data", "builtin:studo"], "builtin:studio"),
        (["train", "--data", "builtin:studio?depth=netwrk"], "builtin:studio?depth=network"),
        (["train", "--data", "captures/hnd"], "captures/hand"),
        (["train", "--resume", "rnus/hand"], "runs/hand"),
        (["import", "captures/hand", "out", "--dataset", "blendr"], "blender"),
        (["prepare", "captures/hnd", "out"], "captures/hand"),
        (["prepare", "captures", "out", "--masks", "moton"], "motion"),
        (["prepare", "captures", "out", "--masks", "captures/hnd"], "captures/hand"),
        (["prepare", "captures", "out", "--depth", "anythin"], "anything"),
        (["prepare", "captures/hand", "--add", "depth", "--depth", "flwo"], "flow"),
        (["render", "runs/hnd"], "runs/hand"),
        (["export", "runs/hand", "--format", "plt"], "ply"),
        (["sweep", "ablations"], "ablation"),
        (["sweep", "ablation", "--preset", "bets"], "best"),
    ],
)
def test_a_misspelt_value_is_told_the_similar_one(arguments, meant, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for folder in ("captures", "runs"):
        (tmp_path / folder / "hand").mkdir(parents=True)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.endswith(f"; did you mean {meant}?\n")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["prepare", "gone", "capture"],
        ["import", "gone", "capture"],
        ["check", "gone"],
        ["train", "--data", "gone"],
        ["sweep", "gone.toml", "--data", "gone"],
        ["eval", "gone"],
        ["render", "gone"],
        ["export", "gone"],
        ["report", "gone"],
    ],
)
def test_a_line_about_wrong_input_begins_as_one_about_a_wrong_option(arguments, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for options in ([], ["--zzz"]):
        assert main([*arguments, *options]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"warpgs {arguments[0]}: ")
        assert error.count("\n") == 1


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
@pytest.mark.parametrize("arguments", [["render", "r", "--size"], ["export"]])
def test_errors_are_the_same_with_and_without_unicode(arguments, encoding):
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    command = [sys.executable, "-m", "warpgs", *arguments]
    ended = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert ended.returncode == 2
    assert re.fullmatch(rb"warpgs \w+: missing[^\n]*\n", ended.stderr)


def test_options_with_underscores_and_without_values_are_known(capsys):
    known = set(flags(TrainConfig))
    assert {"--no-graph", "--densify.max-gaussians", "--data"} <= known
    assert "capture" in shown(capsys, "train", "--checkpoint_every", "3", "--no-graph", "--help")


def test_help_after_an_argument_is_that_of_the_whole_command(capsys):
    shown = []
    for arguments in (["sweep", "--help"], ["sweep", "ablation", "--help"], ["sweep", "ablation", "-h"]):
        with contextlib.suppress(SystemExit):
            main(arguments)
        shown.append(capsys.readouterr().out)
    assert "SWEEP" in shown[0].splitlines()[0]
    assert shown[1] == shown[2] == shown[0]


@pytest.mark.parametrize("columns", range(78, 84))
def test_help_has_no_empty_rows(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, "utf-8", write_through=True))
    with contextlib.suppress(SystemExit):
        main(["sweep", "--help"])
    rows = [line.strip("│ ") for line in written.getvalue().decode().splitlines() if line.startswith("│")]
    assert len(rows) > 20
    assert all(rows)


def test_annotations_are_restored_after_help():
    before = dict(TrainConfig.__annotations__)
    with described(TrainConfig, ("data",)):
        assert TrainConfig.__annotations__ != before
    assert TrainConfig.__annotations__ == before


@pytest.mark.parametrize("arguments", [["check", "capture"], ["train", "--data", "capture"]])
def test_ctrl_c_during_imports_is_one_line_and_exit_code_130(arguments, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Command, "load", interrupted)
    monkeypatch.setattr("importlib.import_module", interrupted)
    assert main(arguments) == 130
    assert capsys.readouterr().err == f"warpgs {arguments[0]}: stopped\n"
