"""The ``warpgs`` command."""

import contextlib
import importlib
import sys
import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

from .command_line.screen import wrapped
from .command_line.version import version
from .errors import FAILED, ending_at_once, program, run_command, say, suggestion, visible


class Command(NamedTuple):
    """A command.

    Attributes:
        options: Its dataclass of options, as module:class. Its module imports nothing heavy, so that --help is fast, as
            is ``require_inputs``, a method that refuses inputs that do not exist.
        function: Does what the options ask for, as module:function; imported when the command line is right.
        summary: What it does, for the list of commands.
    """

    options: str
    function: str
    summary: str

    def load(self) -> Any:
        """The dataclass of options."""
        return _imported(self.options)

    def run(self, options: Any) -> object:
        """Does what the options ask for; may return the exit code."""
        if hasattr(options, "require_inputs"):
            options.require_inputs()
        with ending_at_once():
            function = _imported(self.function)
        return function(options)


def _imported(name: str) -> Any:
    """A class or function, by module:name."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module, __package__), attribute)


COMMANDS = {
    "demo": Command(".demo:Demo", ".demo:run", "go from a ray-traced video to a trained scene, to see how it works"),
    "download": Command(
        ".download.options:Download", ".download.command:run", "download public captures: NeRF-DS, HyperNeRF, D-NeRF"
    ),
    "prepare": Command(
        ".prepare.options:Prepare", ".prepare.command:run_prepare", "make a capture from a video or a folder of frames"
    ),
    "import": Command(
        ".captures.options:Import",
        ".captures.command:run_import",
        "copy a capture of any layout into the layout of prepare",
    ),
    "check": Command(
        ".captures.options:Check", ".captures.command:run_check", "check whether a capture is fit to train on"
    ),
    "train": Command(".config:TrainConfig", ".training.command:run", "train on a capture or on the built-in scene"),
    "sweep": Command(".sweep.options:Sweep", ".sweep.command:run", "train many runs and make one table"),
    "eval": Command(
        ".evaluation.options:Eval", ".evaluation.command:run", "evaluate a run: PSNR, SSIM, LPIPS, smoothness, FPS"
    ),
    "view": Command(".viewer.options:View", ".viewer.command:run", "look around in a run in the browser"),
    "render": Command(".video.options:Render", ".video.command:run", "render a run to images and a video"),
    "export": Command(".export.options:Export", ".export.command:run", "export a run for other programs"),
    "report": Command(".report.options:Report", ".report.command:run", "write one HTML file about runs"),
    "bench": Command(".bench.options:Bench", ".bench.command:run", "measure rendering times"),
}
"""All commands, in the order in which they are used."""

HELP = ("--help", "-h", "--help-all")
"""Options that show help."""

TRAIN_OPTIONS = (
    *("data", "dataset", "factor", "out", "resume", "preset", "iterations", "device", "seed", "assume", "exposure"),
    *("antialias", "checkpoint_every", "lpips"),
)
"""Options of ``train`` that --help shows; --help-all shows all."""


@program
def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; wrong options and other errors of the user end with one line and exit code 2."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    name, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if name in HELP:
        print(wrapped(usage()))
        return 0
    if name == "--version" or rest == ["--version"]:
        print(f"warpgs {version()}", flush=True)  # first: the rest imports what may be missing or broken
        return run_command(_describe_machine)
    if name.startswith("--tyro"):
        return _print_completion(arguments)
    if name not in COMMANDS:
        advice = suggestion(name, [*COMMANDS, *HELP, "--version"]) or "; warpgs --help lists all"
        say(f"there is no command {visible(name)}{advice}")
        return FAILED
    prog = f"warpgs {name}"
    return train(rest, prog) if name == "train" else run_command(lambda: _run(name, rest, prog), prog)


def _describe_machine() -> None:
    """Says what kernels run on, and whether they are compiled for it."""
    with ending_at_once():
        from .runtime.devices import choose_device
        from .runtime.machine import described, kernels_note
    device = choose_device()
    print(f"{described(device)}: {kernels_note(device)}")


def _run(name: str, arguments: Sequence[str], prog: str) -> object:
    with ending_at_once():
        from .command_line.parsing import parse  # imports tyro

        command = COMMANDS[name]
        options = command.load()
    plain = ["--help" if argument == "--help-all" else argument for argument in arguments]  # help shows all options
    return command.run(parse(options, plain, prog))


@program
def train(arguments: Sequence[str], prog: str) -> int:
    """``warpgs train`` and ``train.py``: trains, then evaluates; returns the exit code."""
    if "--version" in arguments:
        return main(["--version"])
    return run_command(lambda: _train(arguments, prog), prog)


def _train(arguments: Sequence[str], prog: str) -> int:
    with ending_at_once():
        from .command_line.parsing import described
        from .training import command as training

        config = COMMANDS["train"].load()
    help_all = "--help-all" in arguments
    if not set(HELP) & set(arguments):
        return training.main(arguments, prog)
    arguments = ["--help" if argument == "--help-all" else argument for argument in arguments]
    try:
        with described(config, None if help_all else TRAIN_OPTIONS):
            return training.main(arguments, prog)
    finally:
        if not help_all:
            print(wrapped(f"{prog} --help-all shows all options, by group, with the defaults of the preset."))


def usage() -> str:
    """The list of commands."""
    lines = [f"  {name:<9} {command.summary}" for name, command in COMMANDS.items()]
    text = """\
        usage: warpgs COMMAND ...

        SplitGaussian: dynamic scenes from one moving camera as static and dynamic 3D Gaussians.

        commands:
        {commands}

        warpgs COMMAND --help shows the options of a command, warpgs train --help-all all of train, warpgs --version
        the version.
        """
    text = textwrap.dedent(text).replace("--version\n", "--version ")  # the caller wraps it
    return text.format(commands="\n".join(lines)).strip()


def _print_completion(arguments: list[str]) -> int:
    import tyro

    from .command_line.parsing import described

    commands = {name: command.load() for name, command in COMMANDS.items()}
    with contextlib.ExitStack() as stack:
        for command in commands.values():
            stack.enter_context(described(command))
        tyro.extras.subcommand_cli_from_dict(commands, prog="warpgs", args=arguments)
    return 0
