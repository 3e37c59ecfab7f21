"""Processes that torchrun starts, beside the first, which runs the command or the script (`optics.ranks`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NoReturn, TypeVar

from caustic_cli.loading import leave
from caustic_cli.optics import ranks
from caustic_cli.schema import checks
from caustic_cli.workflow.progress import signals_collected

T = TypeVar("T")
R = TypeVar("R")


def follow(device: str) -> NoReturn:
    """All processes but the first: serve it, which handles the signals and says what is wrong, and end when its work is done, or it
    has stopped, or interrupts them."""
    status = 0
    try:
        with ranks.process_group(device), signals_collected():
            ranks.serve()
    except (ranks.RankStopped, KeyboardInterrupt):
        status = 1
    leave(status)


def spread(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """`function` of every item, in their order; in a script that torchrun has started, once, by all of its processes.

    Only the first process returns; the others end with the script's last line that they share.  The results are the same for any
    number of processes if that of an item depends on this item alone, and on the number of threads.

    Args:
        function: defined in a module or in the script; its argument and its result can be pickled.

    Raises:
        Exception: what the function raises, for the first item of those for which it does.
    """
    if checks.rank_and_size()[0] > 0:
        follow("cpu")
    with ranks.process_group("cpu"):
        return ranks.mapped(function, items)
