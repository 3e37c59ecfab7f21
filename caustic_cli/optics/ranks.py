"""Several processes (`torchrun`), on one machine or more, that share the work of a command.

Rank 0 reads, decides, writes and reports; the others `serve` it.  In a design each rank traces its share of the rays, and images
and gradients are summed: all run the same loop with the same numbers, and decisions that depend on a clock or a signal are
broadcast by rank 0.  Independent items, such as the draws of a tolerance analysis, are dealt out (`mapped`).  In a single process
every function here does nothing.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from caustic_cli.errors import CausticError, InputError, Interrupted
from caustic_cli.schema import checks

T = TypeVar("T")
R = TypeVar("R")


@contextmanager
def process_group(device: str) -> Iterator[int]:
    """Join the process group if torchrun started this process, over gloo on CPUs and nccl on GPUs; yields the rank.

    Rank 0 releases the others when its block ends; when it fails, their next collective operation fails.

    Raises:
        InputError: the environment holds no valid rank, number of ranks or address.
        CausticError: the group cannot be formed.
    """
    if checks.rank_and_size()[1] == 1:
        yield 0
        return
    place = f"{os.environ['MASTER_ADDR']}:{checks.of_environment('MASTER_PORT', None, 1, 65535)}"
    if not dist.is_available():
        raise CausticError("this torch was built without torch.distributed, which torchrun needs")
    local = checks.of_environment("LOCAL_RANK", 0, 0, 10**6)
    if device == "cuda":
        torch.cuda.set_device(local % torch.cuda.device_count())
    try:
        _meet(device)
    except (RuntimeError, ValueError, OSError) as error:
        if "EADDRINUSE" in str(error):
            raise InputError(
                f"{place}: is in use; the environment's MASTER_PORT must be a free port for the ranks to meet"
            ) from error
        raise CausticError(f"{place}: the ranks did not meet there ({str(error).splitlines()[0][:200]})") from error
    rank = dist.get_rank()
    try:
        yield rank
    except Interrupted:
        _say_goodbye(rank)
        raise
    _say_goodbye(rank)


def _meet(device: str) -> None:
    """Initialise the process group in a separate thread: signals are not handled while C++ blocks the main one."""
    failed: list[Exception] = []

    def meet() -> None:
        try:
            if device == "cuda":
                torch.cuda.set_device(current)
            dist.init_process_group("nccl" if device == "cuda" else "gloo")
        except Exception as error:  # re-raised in the main thread
            failed.append(error)

    current = torch.cuda.current_device() if device == "cuda" else None
    waiting = threading.Thread(target=meet, daemon=True)
    waiting.start()
    waiting.join()
    if failed:
        raise failed[0]


def _say_goodbye(rank: int) -> None:
    if rank == 0:
        send(None)
    dist.destroy_process_group()


def rank_and_size() -> tuple[int, int]:
    """Rank of this process, and number of ranks."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def send(task: Callable[[], Any] | None) -> None:
    """Rank 0: let the others call a task, a picklable function (`serve`); None releases them."""
    if rank_and_size()[1] > 1:
        _call(dist.broadcast_object_list, [task], 0)


def serve() -> None:
    """The other ranks: call the tasks of rank 0 until it releases this one."""
    task: list[Any] = [None]
    while True:
        _call(dist.broadcast_object_list, task, 0)
        if task[0] is None:
            return
        task[0]()


def mapped(function: Callable[[T], R], items: Iterable[T], progress: Callable[[int], None] = lambda done: None) -> list[R]:
    """`function` of every item, in their order; on rank 0, where the others `serve`, each rank takes its share.

    The same for any number of ranks if the result of an item depends on that item alone.

    Args:
        function, items: to be pickled; progress: called with the number of items done, about.
    """
    items = list(items)
    send(partial(_share, function, items))
    return _share(function, items, progress)


def _share(function: Callable[[T], R], items: list[T], progress: Callable[[int], None] = lambda done: None) -> list[R]:
    """All results, of which this rank computes every n-th."""
    rank, size = rank_and_size()
    found: list[Any] = [None] * len(items)
    for k in range(rank, len(items), size):
        found[k] = function(items[k])
        progress(min(len(items), k - rank + size))
    if size > 1:
        parts: list[Any] = [None] * size
        _call(dist.all_gather_object, parts, found[rank::size])
        for r, part in enumerate(parts):
            found[r::size] = part
    return found


def all_reduce(*tensors: Tensor) -> None:
    """Replace each tensor by its sum over all ranks, bitwise the same on every rank."""
    if rank_and_size()[1] > 1:
        for tensor in tensors:
            _call(dist.all_reduce, tensor)


def broadcast(tensor: Tensor) -> None:
    """Replace a tensor by that of rank 0."""
    if rank_and_size()[1] > 1:
        _call(dist.broadcast, tensor, 0)


def decide(answer: bool, device: str | torch.device = "cpu") -> bool:
    """The answer of rank 0, on every rank."""
    if rank_and_size()[1] == 1:
        return answer
    said = torch.tensor(int(answer), device=device)
    broadcast(said)
    return bool(said)


def _call(collective, *arguments) -> None:
    try:
        collective(*arguments)
    except RuntimeError as error:
        raise CausticError(
            f"rank {dist.get_rank()}: another rank has stopped, see its message ({str(error).splitlines()[0][:200]})"
        ) from error
