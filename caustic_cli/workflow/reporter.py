"""Progress and messages of a workflow: the interface, and an implementation by callbacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from caustic_cli.errors import plain

#: Progress callback: activity, status text, steps done, and steps in total (None where unknown).
Tell = Callable[..., None]


class Reporter(Protocol):
    """Receiver of progress and messages."""

    def say(self, text: str) -> None:
        """Report a line to the user."""

    def progress(self, total: int | None) -> AbstractContextManager[Tell]:
        """Report the progress of the work in the block, of `total` steps."""

    def notify_if_slow(self, text: str, seconds: float = 4.0) -> AbstractContextManager[None]:
        """Report `text` if the block takes longer than `seconds`."""

    def waiting(self, what: str, seconds: float) -> AbstractContextManager[None]:
        """Show that the block does `what`, and the time left of the `seconds` that it is expected to take."""


class Listener:
    """Reporter that calls functions, if any.

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
        """Report a line to `on_message`."""
        if self.on_message is not None:
            self.on_message(plain(text))

    @contextmanager
    def progress(self, total: int | None) -> Iterator[Tell]:
        """Report every step to `on_progress`."""

        def tell(description: str = "", text: str = "", done: int | None = None, whole: int | None = None) -> None:
            if self.on_progress is not None:
                self.on_progress(description, text, done, total if whole is None else whole)

        yield tell

    @contextmanager
    def notify_if_slow(self, text: str, seconds: float = 4.0) -> Iterator[None]:
        """Report nothing."""
        yield

    @contextmanager
    def waiting(self, what: str, seconds: float) -> Iterator[None]:
        """Report nothing."""
        yield
