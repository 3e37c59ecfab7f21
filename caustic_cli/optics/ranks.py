"""Several processes (`torchrun`), on one machine or more, that share the work of a command.

Rank 0 reads, decides, writes and reports; the others `serve` it, in one of two ways:

    mapped      independent items, such as the draws of a tolerance analysis or the points of a study: every rank takes the next
                one as soon as it is free
    together    an optimisation: all ranks run the same loop with the same numbers.  Each computes some of the chunks of rays, of
                the wavefronts or of the members of a loss, and images and gradients are added in their order (`in_order`,
                `divided`); what depends on a clock or a signal is decided by rank 0 (`decide`)

The result is the same to the last bit for any number of ranks, since neither the items nor the order of summation depend on it, and
all ranks use as many threads as rank 0.  In a single process, and within an item of `mapped`, every function here does nothing.
"""

from __future__ import annotations

import os
import pickle
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from itertools import count, cycle
from typing import Any, Literal, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from caustic_cli.errors import CausticError, InputError
from caustic_cli.schema import checks

T = TypeVar("T")
R = TypeVar("R")

#: How long ranks wait for each other to meet; and for the work of another, whose end is noticed by its closed connection.
MEETING, WAITING = timedelta(minutes=30), timedelta(days=7)
#: Key of the message of a rank that stopped.
STOPPED = "caustic stopped"


@dataclass
class _Process:
    """What this process is doing."""

    #: Its own work, handing out tasks, or a task together with all others.
    scope: Literal["alone", "leading", "together"] = "alone"
    #: Whether a task was handed out whose end this process has not seen.
    pending: bool = False
    #: Where ranks leave notes for each other.
    store: Any = None
    #: Of lists of items.
    numbers: Iterator[int] = field(default_factory=count)


_here = _Process()


class RankStopped(CausticError):
    """Another rank has stopped."""


@contextmanager
def process_group(device: str) -> Iterator[int]:
    """Join the process group if torchrun started this process, over gloo on CPUs and nccl on GPUs; yields the rank.

    Rank 0 releases the others when its block ends, unless it ends within a task: then their next collective operation fails.

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
        with _within("alone" if rank else "leading"):
            yield rank
    finally:
        if not _here.pending:
            if rank == 0:
                _send(None)
            dist.destroy_process_group()
            _here.store = None


def _meet(device: str) -> None:
    """Initialise the process group in a separate thread: signals are not handled while C++ blocks the main one."""
    from torch.distributed.rendezvous import rendezvous  # noqa: PLC0415  which not every torch has

    failed: list[Exception] = []

    def meet() -> None:
        try:
            if device == "cuda":
                torch.cuda.set_device(current)
            _here.store, rank, size = next(rendezvous("env://", timeout=MEETING))
            dist.init_process_group(
                "nccl" if device == "cuda" else "gloo", store=_here.store, rank=rank, world_size=size, timeout=WAITING
            )
        except Exception as error:  # re-raised in the main thread
            failed.append(error)

    current = torch.cuda.current_device() if device == "cuda" else None
    waiting = threading.Thread(target=meet, daemon=True)
    waiting.start()
    waiting.join()
    if failed:
        raise failed[0]


@contextmanager
def _within(scope: Literal["alone", "leading", "together"]) -> Iterator[None]:
    before, _here.scope = _here.scope, scope
    try:
        yield
    finally:
        _here.scope = before


@contextmanager
def _handed_out(task: Callable[[], Any]) -> Iterator[None]:
    """Let the other ranks call a task, a picklable function, while this one runs the block."""
    _here.pending = True
    _send(task)
    yield
    _here.pending = False  # not after an exception: the others are within the task


def _send(task: Callable[[], Any] | None) -> None:
    _call(dist.broadcast_object_list, [(torch.get_num_threads(), task)], 0)


def serve() -> None:
    """The other ranks: call the tasks of rank 0, with as many threads, until it releases this one.

    Raises:
        RankStopped: another rank has stopped, or this one had to, whose message is left for rank 0.
    """
    given: list[Any] = [None]
    threads = torch.get_num_threads()
    while True:
        _here.pending = True
        _call(dist.broadcast_object_list, given, 0)
        told, task = given[0]
        if task is None:
            _here.pending = False
            return
        torch.set_num_threads(told)
        try:
            task()
        except RankStopped:
            raise
        except Exception as error:
            _here.store.set(STOPPED, f"{error}")
            raise RankStopped(f"{error}") from error
        torch.set_num_threads(threads)


def mapped(function: Callable[[T], R], items: Iterable[T], progress: Callable[[int], None] = lambda done: None) -> list[R]:
    """`function` of every item, in their order; on rank 0, where the others `serve`, every rank takes the next one when it is free.

    The same for any number of ranks if the result of an item depends on that item alone.  What the function raises is raised here,
    of several items that of the first.

    Args:
        function, items: to be pickled, as results are; progress: called with the number of items done, about.
    """
    items = list(items)
    if _here.scope == "leading":
        name = f"caustic item {next(_here.numbers)}"
        with _handed_out(partial(_take, function, items, name)):
            found = _take(function, items, name, progress)
        for k in range(len(items)):
            if isinstance(found.get(k), _Failed):
                raise found[k].error
        progress(len(items))
        return [found[k] for k in range(len(items))]
    results = []
    for k, item in enumerate(items):
        results.append(function(item))
        progress(k + 1)
    return results


class _Failed:
    """What the function raised for an item."""

    def __init__(self, error: Exception):
        try:
            self.error = pickle.loads(pickle.dumps(error))
        except Exception:  # of an exception with an unusual constructor, its message
            self.error = (InputError if isinstance(error, InputError) else CausticError)(f"{error}")


def _take(function: Callable[[T], R], items: list[T], name: str, progress: Callable[[int], None] = lambda done: None):
    """Results of all ranks by the number of their item, after this one has taken items until there are none left."""
    found: dict[int, Any] = {}
    others = dist.get_world_size() - 1
    while (k := _here.store.add(name, 1) - 1) < len(items):
        try:
            with _within("alone"):
                found[k] = function(items[k])
        except Exception as error:
            found[k] = _Failed(error)
            _here.store.add(name, len(items))  # there is no need of later ones
        progress(max(1, min(len(items), _here.store.add(name, 0)) - others))
    parts: list[Any] = [None] * (others + 1)
    _call(dist.all_gather_object, parts, found)
    return {k: result for part in parts for k, result in part.items()}


@contextmanager
def together(task: Callable[[], Any]) -> Iterator[None]:
    """Rank 0: run the block while the others, which `serve`, run the same as a task, a picklable function."""
    if _here.scope != "leading":
        yield
        return
    with _handed_out(partial(_joined, task)), _within("together"):
        yield


def _joined(task: Callable[[], Any]) -> None:
    with _within("together"):
        task()


#: Within a block of `alone()` this rank works for itself.
alone = partial(_within, "alone")


def rank_and_size() -> tuple[int, int]:
    """Rank of this process among those that work `together`, and their number."""
    return (dist.get_rank(), dist.get_world_size()) if _here.scope == "together" else (0, 1)


def turns(share: tuple[int, int]) -> Iterator[bool]:
    """Of items without end, whether each is that of a rank, share: rank and number of ranks; item k is that of rank k modulo n."""
    rank, size = share
    return cycle(k == rank for k in range(size))


def in_order(
    own: Iterable[Sequence[Tensor | None] | None],
    like: Sequence[Tensor],
    share: tuple[int, int],
    owners: Iterable[int] | None = None,
) -> Iterator[Sequence[Tensor | None]]:
    """The tensors of all items in their order, on every rank, one item at a time.

    own: of all items, None for those of other ranks; tensors of zeros may be None.
    like: tensors with the shapes and precisions of an item's.
    share: rank and number of ranks n; owners: numbers whose remainders modulo n are the ranks of the items; 0, 1, .. unless given.
    """
    size = share[1]
    if size == 1:
        yield from own  # type: ignore[misc]
        return
    for owner, values in zip(owners or count(), list(own), strict=False):  # every rank computes its own before any waits
        sent = [torch.zeros_like(t, requires_grad=False) for t in like]
        for buffer, value in zip(sent, values or (), strict=False):
            if value is not None:
                buffer.copy_(value)
        for tensor in sent:
            _call(dist.broadcast, tensor, owner % size)
        yield sent


def divided(tasks: Sequence[Callable[[], R]]) -> list[R]:
    """The results of all tasks on every rank, each of which calls some of them."""
    rank, size = rank_and_size()
    with alone():
        own = [task() for task in tasks[rank::size]]
    if size == 1:
        return own
    parts: list[Any] = [None] * size
    _call(dist.all_gather_object, parts, own)
    return [parts[k % size][k // size] for k in range(len(tasks))]


def broadcast(tensor: Tensor) -> None:
    """Replace a tensor by that of rank 0."""
    if rank_and_size()[1] > 1:
        _call(dist.broadcast, tensor, 0)


def decide(question: Callable[[], bool], device: str | torch.device = "cpu") -> bool:
    """The answer of rank 0, on every rank."""
    with alone():
        answer = question()
    if rank_and_size()[1] == 1:
        return answer
    said = torch.tensor(int(answer), device=device)
    broadcast(said)
    return bool(said)


def _call(collective, *arguments) -> None:
    try:
        collective(*arguments)
    except RuntimeError as error:
        said = f"{error}".splitlines()[0][:200]
        with suppress(RuntimeError):  # its keeper may have stopped as well
            said = _here.store.get(STOPPED).decode() if _here.store.check([STOPPED]) else said
        raise RankStopped(f"another process has stopped: {said}") from error
