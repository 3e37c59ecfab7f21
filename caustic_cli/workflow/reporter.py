"""What a workflow tells while it works, and to whom: a terminal, a program, a notebook or nobody."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from caustic_cli.errors import plain

#: Called with what is being done, a text about it, how much of it is done and of how much in all (None where unknown).
Tell = Callable[..., None]


class Reporter(Protocol):
    """Whoever listens."""

    def say(self, text: str) -> None:
        """A line for the user."""

    def progress(self, total: int | None) -> AbstractContextManager[Tell]:
        """What is told of the work in the block, of `total` steps in all."""

    def notify_if_slow(self, text: str, seconds: float = 4.0) -> AbstractContextManager[None]:
        """Say `text` if the block is still at work after so many seconds."""


class Listener:
    """Passes progress on to a function, or to nobody.

    Args:
        on_progress: called with (stage, text, done, total) after every step.
        on_message: called with each line.
    """

    def __init__(
        self,
        on_progress: Callable[[str, str, int | None, int | None], None] | None = None,
        on_message: Callable[[str], None] | None = None,
    ):
        self.on_progress, self.on_message = on_progress, on_message

    def say(self, text: str) -> None:
        """Pass a line on."""
        if self.on_message is not None:
            self.on_message(plain(text))

    @contextmanager
    def progress(self, total: int | None) -> Iterator[Tell]:
        """Pass every step on."""

        def tell(description: str = "", text: str = "", done: int | None = None, whole: int | None = None) -> None:
            if self.on_progress is not None:
                self.on_progress(description, text, done, total if whole is None else whole)

        yield tell

    @contextmanager
    def notify_if_slow(self, text: str, seconds: float = 4.0) -> Iterator[None]:
        """Wait in silence."""
        yield
