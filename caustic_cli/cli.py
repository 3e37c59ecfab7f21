"""The `caustic` command: runs one command line, and turns errors and signals into one line and an exit status.

The parser and all that it needs are loaded by `run`, after `main` has begun to answer signals.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
import warnings


class SignalReceived(KeyboardInterrupt):
    """A signal ended what was done.  A plain KeyboardInterrupt out of `exec` would have Python end itself by SIGINT, whatever came
    of it."""


#: How a signal is called that ends a command.
SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
#: Those that this process was sent.
_sent: list[int] = []
#: Seconds after which an interruption that was lost is tried again.
AGAIN = 0.05
#: For the libraries' threads, where the environment does not say otherwise.  Threads that wait for one another sleep: beside other
#: programs on the same cores they would otherwise keep these from working.  And OpenBLAS, which only solves small systems here, has
#: one: it hands systems of two equations to a second.
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
    debug = "--debug" in arguments or bool(os.environ.get("CAUSTIC_DEBUG"))
    try:
        status = parser().main(arguments, prog_name="caustic", standalone_mode=False, auto_envvar_prefix="CAUSTIC")
        sys.stdout.flush()
        if status == 130:  # how some versions of Typer pass a KeyboardInterrupt on
            raise KeyboardInterrupt
        return status if isinstance(status, int) else 0
    except BrokenPipeError:  # whoever read our results has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except SystemExit as stop:  # how Typer ends a command whose output nobody reads any more
        if isinstance(stop.__context__, OSError) and stop.__context__.errno == errno.EPIPE:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        return stop.code if isinstance(stop.code, int) else 1
    except typer.Exit as stop:
        return stop.exit_code
    except typer.Abort as stop:
        raise KeyboardInterrupt from stop
    except Interrupted as stop:
        console.error(f"{stop}")
        return stop.status
    except Exception as problem:
        if _sent:  # what an interruption became within numba's compiler, for instance
            raise KeyboardInterrupt from problem
        if debug:
            raise
        return _report(problem)


def _report(problem: Exception) -> int:
    """Say in one line what went wrong; the exit status."""
    from caustic_cli.commands import console  # noqa: PLC0415
    from caustic_cli.commands.help import usage_message  # noqa: PLC0415
    from caustic_cli.errors import CausticError, InputError, is_out_of_memory  # noqa: PLC0415

    if isinstance(problem, CausticError):
        console.error(f"{problem}")
        return 2 if isinstance(problem, InputError) else 1
    if hasattr(problem, "format_message"):  # a usage error of the command-line parser, whichever version wraps it
        if type(problem).__name__ == "NoArgsIsHelpError":  # no command at all: the message is the whole help
            sys.stderr.write(problem.format_message() + "\n")
        elif message := usage_message(problem):
            console.error(message)
        return 2
    if is_out_of_memory(problem):
        console.error("out of memory; fewer --rays, a smaller --control or --resolution needs less")
    elif isinstance(problem, OSError) and problem.strerror:
        console.error(f"{problem.filename or 'a file'}: {problem.strerror}")
        return 2 if problem.errno in (errno.ENAMETOOLONG, errno.ELOOP) else 1  # no name but the user's is like that
    elif names := _variables_of(problem):
        console.error(f"the environment's {', '.join(names)}: {problem}")
        return 2
    else:
        console.error(f"internal error: {type(problem).__name__}: {problem} (run again with --debug and report it)")
    return 1


def _variables_of(problem: Exception) -> list[str]:
    """The variables of the environment that a library may have objected to."""
    raised = problem.__traceback__
    while raised is not None and raised.tb_next is not None:
        raised = raised.tb_next
    library = "" if raised is None else raised.tb_frame.f_globals.get("__name__", "").split(".")[0]
    prefix = {"numba": "NUMBA_", "matplotlib": "MPL"}.get(library)
    return sorted(name for name in os.environ if prefix and isinstance(problem, ValueError) and name.startswith(prefix))


def main() -> None:
    """Entry point of the `caustic` script."""
    try:
        _install_signal_handlers()
        _open_streams()
        os.environ |= THREADS | os.environ  # before a library reads them
        if not sys.warnoptions:
            warnings.simplefilter("ignore")  # libraries' own, which are for developers
        status = run(sys.argv[1:])
        _ignore_signals()
    except KeyboardInterrupt:  # while an error was told, or an interruption
        status = _interrupted()
    sys.exit(status)


def _install_signal_handlers() -> None:
    """Have SIGNALS interrupt what is done, and not be lost where Python can pass no exception on."""

    def answer(number: int, _frame) -> None:
        _sent.append(number)
        raise SignalReceived

    def lost(what) -> None:
        if not _sent:
            sys.__unraisablehook__(what)
        elif isinstance(what.exc_value, KeyboardInterrupt):  # in a function that C called back, of LLVM's for instance
            again = threading.Timer(AGAIN, os.kill, (os.getpid(), _sent[0]))
            again.daemon = True
            again.start()

    sys.unraisablehook = lost
    for number in SIGNALS:
        signal.signal(number, answer)


def _ignore_signals() -> None:
    """Nothing is left to be saved, and the process ends by itself."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _interrupted() -> int:
    """Say in one line which signal ended the command; the exit status."""
    if _sent:
        _ignore_signals()
    number = _sent[0] if _sent else signal.SIGINT
    sys.stderr.write(f"caustic: {SIGNALS[number]}\n")
    return 128 + number


def _open_streams() -> None:
    """Have standard streams that are closed read nothing and write nowhere: a file would take their numbers otherwise, and get
    what libraries write to them."""
    for number, mode in enumerate(("r", "w", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(opened := os.open(os.devnull, os.O_RDWR), number)
            if opened != number:
                os.close(opened)
            os.set_inheritable(number, True)
            stream = open(number, mode, encoding="utf-8", closefd=False)  # noqa: SIM115 - it stays
            setattr(sys, ("stdin", "stdout", "stderr")[number], stream)
