"""``warpgs train`` as a child of a Ray worker: ends with the worker, and stops on SIGINT."""

import sys
from collections.abc import Sequence

from warpgs.posix import end_with_parent, unblock_interrupts


def main(arguments: Sequence[str], parent: int) -> int:
    """Trains; returns the exit code.

    A training that outlived its worker would keep its run folder locked, and its GPU busy, unseen by Ray.

    Args:
        arguments: Those of ``warpgs train``.
        parent: Process id of the worker.
    """
    if not end_with_parent(parent):
        return 1
    unblock_interrupts()  # Ray's workers block them
    from warpgs.training.command import main as train

    return train(arguments, "warpgs train")


if __name__ == "__main__":
    sys.exit(main(sys.argv[2:], int(sys.argv[1])))
