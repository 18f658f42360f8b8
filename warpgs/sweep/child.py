"""``warpgs train`` or ``warpgs eval`` as a child of a Ray worker: ends with the worker, and stops on SIGINT."""

import sys
from collections.abc import Sequence

from warpgs.errors import run_command
from warpgs.posix import end_with_parent, unblock_interrupts


def main(arguments: Sequence[str], parent: int) -> int:
    """Trains or evaluates; returns the exit code.

    A training that outlived its worker would keep its run folder locked, and its GPU busy, unseen by Ray.

    Args:
        arguments: The name of the command, and its arguments.
        parent: Process id of the worker.
    """
    if not end_with_parent(parent):
        return 1
    unblock_interrupts()  # Ray's workers block them
    name, *rest = arguments
    if name == "train":
        from warpgs.training.command import main as train

        return train(rest, "warpgs train")
    from warpgs.command_line.parsing import parse
    from warpgs.evaluation.command import run as evaluate
    from warpgs.evaluation.options import Eval

    prog = "warpgs eval"
    return run_command(lambda: evaluate(parse(Eval, rest, prog)), prog)


if __name__ == "__main__":
    sys.exit(main(sys.argv[2:], int(sys.argv[1])))
