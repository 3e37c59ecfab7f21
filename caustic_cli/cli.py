"""Entry point of the `caustic` command: runs a command line, and converts errors and signals to a one-line message and an exit
status.

The parser and its dependencies are imported by `run`, after `main` has installed the signal handlers.
"""

from __future__ import annotations

import errno
import gc
import io
import os
import signal
import sys
import threading
import warnings
from typing import Any

from caustic_cli.loading import leave


class SignalReceived(KeyboardInterrupt):
    """Raised by the signal handlers.  After a plain KeyboardInterrupt in `exec`, Python would terminate itself by SIGINT even if it
    was handled."""


#: Signals that terminate a command, with the words for the message.
SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
#: Signals received by this process.
_sent: list[int] = []
#: Seconds after which a lost signal is sent again.
RETRY_SECONDS = 0.05
#: Environment variables for the libraries' threads, unless set already.  Waiting threads sleep instead of spinning, which would
#: slow down other programs on the same cores.  OpenBLAS, which solves only small systems here, gets a single thread: it would
#: distribute even systems of two equations.
THREADS = {"OMP_WAIT_POLICY": "passive", "OPENBLAS_NUM_THREADS": "1"}


def run(arguments: list[str]) -> int:
    """Run one command line and return its exit status."""
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        return _interrupted()


def _run(arguments: list[str]) -> int:
    import typer  # noqa: PLC0415

    from caustic_cli.commands import console  # noqa: PLC0415
    from caustic_cli.commands.parser import parser  # noqa: PLC0415
    from caustic_cli.errors import Interrupted  # noqa: PLC0415

    console.set_option_names({})
    console.set_kept("")
    debug = "--debug" in arguments or bool(os.environ.get("CAUSTIC_DEBUG"))
    try:
        status = parser().main(arguments, prog_name="caustic", standalone_mode=False, auto_envvar_prefix="CAUSTIC")
        sys.stdout.flush()
        if status == 130:  # some versions of Typer convert a KeyboardInterrupt to this
            raise KeyboardInterrupt
        return status if isinstance(status, int) else 0
    except BrokenPipeError:
        return _closed_pipe()
    except SystemExit as stop:
        return _exited(stop)
    except typer.Exit as stop:
        return stop.exit_code
    except typer.Abort as stop:
        raise KeyboardInterrupt from stop
    except Interrupted as stop:
        console.error(f"{stop}")
        return stop.status
    except Exception as problem:
        if _sent:  # a signal during numba's compilation, for instance, may surface as another exception
            raise KeyboardInterrupt from problem
        if debug:
            raise
        return _report(problem)


def _exited(stop: SystemExit) -> int:
    """Exit status of an exit, such as Typer's reaction to a closed pipe."""
    if isinstance(stop.__context__, OSError) and stop.__context__.errno == errno.EPIPE:
        return _closed_pipe()
    return stop.code if isinstance(stop.code, int) else 1


def _closed_pipe() -> int:
    """Exit status after the reader of stdout has closed the pipe."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _report(problem: Exception) -> int:
    """Print a one-line error message; returns the exit status."""
    from caustic_cli.commands import console  # noqa: PLC0415
    from caustic_cli.commands.help import usage_message  # noqa: PLC0415
    from caustic_cli.errors import CausticError, InputError, is_out_of_memory, is_unloadable  # noqa: PLC0415

    if isinstance(problem, CausticError):
        console.error(f"{problem}")
        return 2 if isinstance(problem, InputError) else 1
    if hasattr(problem, "format_message"):  # a usage error of the command-line parser, whichever version wraps it
        if type(problem).__name__ == "NoArgsIsHelpError":  # no command was given: the message is the help
            sys.stderr.write(problem.format_message() + "\n")
        elif message := usage_message(problem):
            console.error(message)
        return 2
    if is_unloadable(problem):
        console.error("out of memory: the libraries cannot be loaded; a higher limit of the address space (ulimit -v) is needed")
    elif is_out_of_memory(problem):
        console.error("out of memory; fewer --rays, a smaller --control or --resolution needs less")
    elif isinstance(problem, OSError) and problem.strerror:
        console.error(": ".join(str(part) for part in (problem.filename, problem.strerror) if part is not None))
        return 2 if problem.errno in (errno.ENAMETOOLONG, errno.ELOOP) else 1  # such a name comes from the user
    elif names := _variables_of(problem):
        console.error(f"the environment's {', '.join(names)}: {problem}")
        return 2
    else:
        console.error(f"internal error: {type(problem).__name__}: {problem} (run again with --debug and report it)")
    return 1


def _variables_of(problem: Exception) -> list[str]:
    """Environment variables that a library may have rejected, judged by the library that raised the error."""
    raised = problem.__traceback__
    while raised is not None and raised.tb_next is not None:
        raised = raised.tb_next
    library = "" if raised is None else raised.tb_frame.f_globals.get("__name__", "").split(".")[0]
    prefix = {"numba": "NUMBA_", "matplotlib": "MPL"}.get(library)
    return sorted(name for name in os.environ if prefix and isinstance(problem, ValueError) and name.startswith(prefix))


def main() -> None:
    """Entry point of the `caustic` script."""
    gc.disable()  # until the libraries are loaded, which create objects that stay
    try:
        _install_signal_handlers()
        _open_streams()
        os.environ |= THREADS | os.environ  # before a library reads them
        if not sys.warnoptions:
            warnings.simplefilter("ignore")  # warnings of libraries address developers
        status = run(sys.argv[1:])
        _ignore_signals()
    except KeyboardInterrupt:  # a second signal, during the report of an error or signal
        status = _interrupted()
    leave(status)


def _install_signal_handlers() -> None:
    """Make SIGNALS raise `SignalReceived`, and repeat a signal where Python cannot propagate the exception."""

    def handle(number: int, _frame) -> None:
        _sent.append(number)
        raise SignalReceived

    def lost(what) -> None:
        if not _sent:
            sys.__unraisablehook__(what)
        elif isinstance(what.exc_value, KeyboardInterrupt):  # in a callback from C code, for instance from LLVM
            again = threading.Timer(RETRY_SECONDS, os.kill, (os.getpid(), _sent[0]))
            again.daemon = True
            again.start()

    sys.unraisablehook = lost
    for number in SIGNALS:
        signal.signal(number, handle)


def _ignore_signals() -> None:
    """Ignore SIGNALS from now on, when the process is about to exit."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _interrupted() -> int:
    """Print which signal terminated the command, and what is on disk if that is known; returns the exit status."""
    if _sent:
        _ignore_signals()
    number, console = _sent[0] if _sent else signal.SIGINT, sys.modules.get("caustic_cli.commands.console")
    kept = console.kept() if console is not None and hasattr(console, "kept") else ""  # the signal may come during its import
    sys.stderr.write(f"caustic: {SIGNALS[number]}{f'; {kept}' if kept else ''}\n")
    return 128 + number


def _open_streams() -> None:
    """Open standard output and error as `_Output`, and those streams that are closed on the null device: otherwise the next opened
    file would get their descriptor, and with it the output of libraries."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(opened := os.open(os.devnull, os.O_RDWR), number)
            if opened != number:
                os.close(opened)
            os.set_inheritable(number, True)
        before = getattr(sys, name)
        if number:
            setattr(sys, name, _Output(number).as_text(before))
        elif before is None:
            sys.stdin = open(number, encoding="utf-8", closefd=False)  # noqa: SIM115 - it stays


class _Output(io.FileIO):
    """Standard output, whose first error names it, or standard error, which has none: on a full disk, for instance, a message is
    worth less than the work that it is about.  Data after an error are lost, also those that Python writes when it exits."""

    def __init__(self, number: int):
        super().__init__(number, "w", closefd=False)
        self.silent = number == 2

    def as_text(self, like: io.TextIOWrapper | None) -> io.TextIOWrapper:
        """A text stream of the encoding of another one, if there is one."""
        encoding, errors = ("utf-8", "backslashreplace") if like is None else (like.encoding, like.errors)
        return io.TextIOWrapper(io.BufferedWriter(self), encoding, errors, line_buffering=self.fileno() == 2 or self.isatty())

    def write(self, data: Any) -> int | None:
        """Write bytes; returns how many were written."""
        try:
            return super().write(data)
        except OSError as error:
            if self.silent:
                return len(data)
            self.silent, error.filename = True, "standard output"
            raise
