"""Console output: results to stdout, as tables or as one JSON object; messages and progress to stderr.

Results are not printed through Rich, which wraps lines at 80 columns when piped.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
import textwrap
import threading
import time
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from caustic_cli.errors import LISTS, MARK, InputError, plain_name, shortened
from caustic_cli.schema.table import TABLE

#: Seconds between lines of --progress json.
LINE_EVERY = 0.5
#: Terminal width from which on a progress bar and the time elapsed are shown, and least width of the values of a table there.
WIDE, NARROW = 90, 24


class _TimeLeft(ProgressColumn):
    """The rest of the expected time of a task, whose total is that time in s."""

    def render(self, task: Task) -> Text:
        """As of a column."""
        left = (task.total or 0.0) - (task.elapsed or 0.0)
        return Text(f"about {left:.0f} s left" if left >= 1.0 else "longer than expected" if left < -1.0 else "nearly done")


class ConsoleReporter:
    """Messages to the user on stderr, unless `quiet`; results on stdout, unless `as_json`: a JSON object stands for them there.
    Colour follows the terminal and NO_COLOR.

    With `progress` json stderr is for programs: one JSON object per line, with the `event` message, progress or result.

    Raises:
        InputError: `progress` is neither auto nor json.
    """

    def __init__(self, quiet: bool = False, progress: str = "auto", as_json: bool = False):
        if progress not in ("auto", "json"):
            raise InputError(f"--progress must be auto or json, got {progress!r}")
        self.console = Console(stderr=True, quiet=quiet, highlight=False, soft_wrap=True)
        self.lines, self.as_json = progress == "json", as_json

    def say(self, text: str) -> None:
        """Print a message."""
        text = named(text)
        if self.lines:
            self._line(event="message", text=text)
        else:
            self.console.print(text, markup=False)

    def _line(self, **values) -> None:
        if not self.console.quiet:
            sys.stderr.write(json.dumps(values) + "\n")
            sys.stderr.flush()

    def result(self, *lines: str) -> None:
        """Print lines of results."""
        if not self.as_json:
            for line in lines:
                emit(named(line))

    def table(self, title: str, rows: list[tuple[str, str]]) -> None:
        """Print a table of names and values as results; on a terminal, values are folded beside their names."""
        if self.lines:
            self._line(event="result", title=title, rows=dict(rows))
        width = max(len(name) for name, _ in rows)
        wide = max(NARROW, shutil.get_terminal_size().columns - width - 4) if sys.stdout.isatty() else math.inf
        self.result(title)
        for name, value in rows:
            folded = textwrap.wrap(value, int(wide)) if len(value) > wide else [value]
            self.result(*(f"  {label:<{width}}  {part}" for label, part in zip((name, *("",) * len(folded)), folded, strict=False)))

    @contextmanager
    def notify_if_slow(self, text: str, seconds: float = 4.0):
        """Print `text` if the block is still running after `seconds`."""
        timer = threading.Timer(seconds, self.say, (text,))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    @contextmanager
    def waiting(self, what: str, seconds: float):
        """On a terminal, a line with the time left of the `seconds` that the block is expected to take; nothing elsewhere."""
        hidden = self.lines or not self.console.is_terminal or self.console.quiet
        with Progress(TextColumn("{task.description}"), _TimeLeft(), console=self.console, transient=True, disable=hidden) as bar:
            bar.add_task(what, total=seconds)
            yield

    @contextmanager
    def progress(self, total: int | None):
        """A progress bar on a terminal, nothing elsewhere; `total` may be set later.  JSON lines are printed every LINE_EVERY
        seconds."""
        if self.lines:
            began, last = time.monotonic(), -math.inf

            def tell(description="", text="", done=None, whole=None) -> None:
                nonlocal last
                now = time.monotonic()
                if now - last >= LINE_EVERY or done == whole:
                    last = now
                    left = round((now - began) * (whole - done) / done, 3) if done and whole else None
                    self._line(
                        event="progress",
                        what=description,
                        text=text,
                        done=done,
                        total=whole,
                        seconds=round(now - began, 3),
                        seconds_left=left,
                    )

            yield tell
            return
        numbers = [TextColumn("{task.description}"), MofNCompleteColumn(), TextColumn("{task.fields[text]}")]
        left = [TextColumn("left"), TimeRemainingColumn()]
        wide = self.console.width >= WIDE
        columns = [numbers[0], BarColumn(), *numbers[1:], TimeElapsedColumn(), *left] if wide else [*numbers, *left]
        bar = Progress(
            *columns,
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal or self.console.quiet,
        )
        with bar:
            task = bar.add_task("beginning", total=total, text="")
            yield lambda description="", text="", done=None, whole=None: bar.update(
                task, description=description, text=text, completed=done, total=whole
            )


#: What is on disk if the command is interrupted now.
_kept = [""]


def set_kept(text: str) -> None:
    """Set the clause on what is on disk that the message of an interruption adds."""
    _kept[0] = text


def kept() -> str:
    """What is on disk if the command is interrupted now; "" if nothing is known."""
    return named(_kept[0])


#: Names of the options with which settings were given in this run, by path.
_option_names: dict[str, str] = {}


def option_names() -> dict[str, str]:
    """The names of the options with which settings were given, by path."""
    return dict(_option_names)


def set_option_names(options: dict[str, str]) -> None:
    """Set the names under which messages refer to settings, by path: the options used; other settings are named as in
    project.toml."""
    _option_names.clear()
    _option_names.update(options)


def named(text: str) -> str:
    """A text with marks replaced by option names, or by names of project.toml where no option was used."""

    def name(path: str) -> str:
        row = TABLE.get(path.removeprefix("+"))
        if row and row.option and (path.startswith("+") or not row.section):
            return row.option.name
        return _option_names.get(path) or (plain_name(path) if "." in path or path in LISTS else "--" + path.replace("_", "-"))

    return MARK.sub(lambda found: name(found[1]), text)


def emit_json(value: dict) -> None:
    """Print one JSON object on stdout."""
    sys.stdout.write(json.dumps(value, allow_nan=False) + "\n")
    sys.stdout.flush()


def emit(line: str) -> None:
    """Print a line of results on stdout, with control characters replaced, and those escaped that its encoding lacks."""
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(printable(line).encode(encoding, "backslashreplace").decode(encoding) + "\n")
    sys.stdout.flush()


def printable(text: str) -> str:
    """A text with control characters replaced, for instance those of a malicious file name."""
    return "".join(c if c.isprintable() else "?" for c in text)


def error(message: str) -> None:
    """Print one line on stderr, even if quiet, with control characters replaced."""
    line = printable(" ".join(named(message).split()))
    sys.stderr.write(f"caustic: {shortened(line)}\n")


def number(figures: dict, key: str, form: str) -> str:
    """A figure in a format, - where it is unknown."""
    value = figures.get(key)
    return "-" if value is None else format(value, form)


def noise(figures: dict, key: str, form: str = ".2g") -> str:
    """The noise of a figure as a clause, empty where it is unknown."""
    return "" if figures.get(key) is None else f", noise {figures[key]:{form}}"
