"""Training by several processes, one for each GPU, which torchrun starts and torch.distributed calls ranks.

Every rank holds the whole scene. In an iteration each renders a view of its own; gradients are averaged over the ranks,
and all take the same step of Adam, so their scenes stay equal bit for bit: an all-reduce gives every rank the same
bits. Whatever else changes the scene happens on rank 0 alone, which then sends the scene to the others: sums by atomic
operations differ in their last bits from GPU to GPU, and with them what is pruned.

Tensors on GPUs travel by NCCL, which CUDA graphs can capture, those on the CPU by Gloo. Without torchrun there is one
rank, and the functions below leave everything as it is.
"""

import contextlib
import datetime
import gc
import hashlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Literal

import torch
import torch.distributed as dist
from torch import Tensor

from warpgs.errors import FAILED, INTERRUPTED, counted, say

TIMEOUT_MINUTES = 10
"""How long a rank waits for the others, as for callbacks and checkpoints of rank 0, before it gives up [minutes]."""

REPORTED = "warpgs/reported"
"""Key of the ranks' common store: how many of them have ended with an error."""


CODE = "warpgs/code"
"""Key of the exit code of the first of them, which all end with."""


class RankLostError(ValueError):
    """Another rank ended, or did not answer for ``TIMEOUT_MINUTES``."""


@contextlib.contextmanager
def joined() -> Iterator[None]:
    """Lets the processes that torchrun started work together inside; does nothing without torchrun.

    If training ends with errors, one rank reports its own, the first one; the others, of which most only miss that
    rank, raise SystemExit. The process has to end after that: it cannot join again.

    Raises:
        RankLostError: If a rank ended without saying why, as a killed one does.
    """
    if not dist.is_available() or not dist.is_torchelastic_launched() or os.environ.get("WORLD_SIZE") == "1":
        yield
        return
    has_nccl = torch.cuda.is_available() and dist.is_nccl_available()
    dist.init_process_group(
        "cpu:gloo,cuda:nccl" if has_nccl else "gloo", timeout=datetime.timedelta(minutes=TIMEOUT_MINUTES)
    )
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, _stop) if is_main else None
    try:
        yield
    except BaseException as error:
        if is_main:  # torchrun ends all when one has ended, but first they are to report
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        _end(error)
        raise
    if before is not None:
        signal.signal(signal.SIGTERM, before)
    if torch.cuda.is_initialized():
        gc.collect()  # of CUDA graphs that hold NCCL's communicator, for which its end would wait
    dist.destroy_process_group()


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt("stopped")


def _end(error: BaseException) -> None:
    """Returns on the rank that is to report its error; ends the others."""
    code = INTERRUPTED if isinstance(error, KeyboardInterrupt) else FAILED
    is_first = True
    with contextlib.suppress(RuntimeError):  # rank 0 may have held the store, if it was not torchrun
        store = dist.distributed_c10d._get_default_store()
        is_first = store.add(REPORTED, 1) == 1
        if is_first:
            store.set(CODE, str(code))
        else:  # torchrun stops the others, which does not make theirs an interruption
            code = int(store.get(CODE))
    if isinstance(error, RankLostError) and torch.cuda.is_initialized():
        # The GPU still waits for the lost rank; an orderly exit would wait for the GPU.
        if is_first:
            say(str(error))
        sys.stderr.flush()
        os._exit(code)
    if not is_first:
        raise SystemExit(code) from error


def num_ranks() -> int:
    """Number of ranks: of views in an iteration."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Index of this process among the ranks of all machines."""
    return dist.get_rank() if num_ranks() > 1 else 0


def is_first() -> bool:
    """Whether this is rank 0, which alone writes files, reports and changes the set of Gaussians."""
    return rank() == 0


def use_device(device: str) -> None:
    """Makes one GPU of this machine the current one of each rank; does nothing for "cpu".

    Raises:
        ValueError: If there are more ranks on this machine than GPUs, or torch has no NCCL.
    """
    if device != "cuda" or num_ranks() == 1:
        return
    here, gpus = int(os.environ["LOCAL_WORLD_SIZE"]), torch.cuda.device_count()
    if here > gpus:
        raise ValueError(
            f"torchrun started {here} processes on this machine, where torch sees {counted(gpus, 'GPU')}: "
            f"expected --nproc-per-node of at most {gpus}"
        )
    if not dist.is_nccl_available():
        raise ValueError("several GPUs need a torch with NCCL, which this one lacks; train on one, without torchrun")
    torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))


@contextlib.contextmanager
def _reaching_all(tensor: Tensor) -> Iterator[None]:
    """Turns the errors of a transfer into RankLostError."""
    try:
        yield
    except RuntimeError as error:
        if tensor.is_cuda and not isinstance(error, dist.DistError):  # out of memory, for example
            raise
        raise RankLostError(
            f"another of the {num_ranks()} processes ended, or did not answer for {TIMEOUT_MINUTES} minutes; "
            "continue from the last checkpoint with --resume"
        ) from error


def add_(tensor: Tensor) -> None:
    """Replaces a tensor on every rank by the sum over the ranks."""
    if num_ranks() > 1 and tensor.numel():
        with _reaching_all(tensor):
            dist.all_reduce(tensor)


def move_to_first_(tensor: Tensor, how: Literal["sum", "maximum"] = "sum") -> None:
    """Replaces a tensor on rank 0 by its sum or maximum over the ranks, and on the others by 0."""
    if num_ranks() > 1 and tensor.numel():
        with _reaching_all(tensor):
            dist.reduce(tensor, 0, dist.ReduceOp.SUM if how == "sum" else dist.ReduceOp.MAX)
        if not is_first():
            tensor.zero_()


def copy_first_(tensor: Tensor) -> None:
    """Replaces a tensor, which has one shape everywhere, by that of rank 0."""
    if num_ranks() > 1 and tensor.numel():
        with _reaching_all(tensor):
            dist.broadcast(tensor, 0)


def any_rank(flag: bool) -> bool:
    """Whether a flag is true on any rank. Waits for all ranks, not for the GPU; a lost rank is an error here."""
    if num_ranks() == 1:
        return flag
    flags = torch.tensor([int(flag)])
    add_(flags)
    return bool(flags.item())


def text_of_first(text: str) -> str:
    """The text that rank 0 has."""
    if num_ranks() == 1:
        return text
    content = torch.tensor(list(text.encode()), dtype=torch.uint8)
    size = torch.tensor([len(content)])
    copy_first_(size)
    if not is_first():
        content = torch.empty(int(size.item()), dtype=torch.uint8)
    copy_first_(content)
    return bytes(content.tolist()).decode()


def require_same(what: str, content: bytes) -> None:
    """Compares something that all ranks must have alike.

    Raises:
        ValueError: If a rank has something else than rank 0; the message begins with ``what``.
    """
    number = int.from_bytes(hashlib.blake2b(content, digest_size=7).digest(), "big")
    numbers = torch.zeros(num_ranks(), dtype=torch.int64)
    numbers[rank()] = number
    add_(numbers)
    different = (numbers != numbers[0]).nonzero()[:, 0].tolist()
    if different:
        raise ValueError(f"expected {what} to be the same on all ranks, rank {different[0]} has another than rank 0")
