"""``warpgs train`` as a child of a Ray worker: ends with the worker, and stops on SIGINT."""

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

PR_SET_PDEATHSIG = 1
"""From <linux/prctl.h>: the signal that a process gets when its parent dies."""


def main(arguments: Sequence[str], parent: int) -> int:
    """Trains; returns the exit code.

    A training that outlived its worker would keep its run folder locked, and its GPU busy, unseen by Ray.

    Args:
        arguments: Those of ``warpgs train``.
        parent: Process id of the worker.
    """
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the line above
        return 1
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])  # Ray's workers block it, and children inherit that
    from warpgs.training.command import main as train

    return train(arguments, "warpgs train")


if __name__ == "__main__":
    sys.exit(main(sys.argv[2:], int(sys.argv[1])))
