"""The `caustic` command: parses, calls, and turns errors into one line and an exit status.

Torch is loaded inside the commands' bodies only, so that --help answers at once.
"""

from __future__ import annotations

import errno
import os
import sys
from typing import Annotated

import typer

from caustic_cli import __version__
from caustic_cli.commands import console, convergence, design, export, gradmap, render
from caustic_cli.errors import CausticError, InputError, Interrupted, is_out_of_memory

DESCRIPTION = """Design free-form lenses that throw a picture as a caustic.

Lengths are millimetres, angles degrees, wavelengths nanometres, powers watts. Results go to stdout, everything else to
stderr. Exit status: 0 done; 1 could not finish; 2 bad usage or bad input; 130 or 143 interrupted, state saved.
"""

app = typer.Typer(
    help=DESCRIPTION,
    rich_markup_mode=None,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(value: bool) -> None:
    if value:
        console.emit(f"caustic {__version__}")
        raise typer.Exit()


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


for _module in (design, render, gradmap, export, convergence):
    app.command(epilog=_module.EXAMPLES)(_module.run)
# Typer names a command after its function; each module's is `run`.
for _info, _name in zip(app.registered_commands, ("design", "render", "gradmap", "export", "convergence"), strict=True):
    _info.name = _name


def parser():
    """The parser of the whole command line."""
    root = typer.main.get_command(app)
    for command in root.commands.values():
        for parameter in command.params:
            parameter.show_envvar = False  # every option has a variable; the manual says how it is called
    return root


def run(arguments: list[str]) -> int:
    """Run one command line and return its exit status."""
    console.speak({})
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
    except (KeyboardInterrupt, typer.Abort):
        console.error("interrupted")
        return 130
    except Interrupted as stop:
        console.error(f"{stop}")
        return stop.status
    except Exception as problem:
        if debug:
            raise
        return _report(problem)


def _report(problem: Exception) -> int:
    """Say in one line what went wrong; the exit status."""
    if isinstance(problem, CausticError):
        console.error(f"{problem}")
        return 2 if isinstance(problem, InputError) else 1
    if hasattr(problem, "format_message"):  # a usage error of the command-line parser, whichever version wraps it
        message = problem.format_message()
        if type(problem).__name__ == "NoArgsIsHelpError":  # no command at all: the message is the whole help
            sys.stderr.write(message + "\n")
            return 2
        if message:
            console.error(f"{message} (see caustic --help)")
        return 2
    if is_out_of_memory(problem):
        console.error("out of memory; fewer --rays, a smaller --control or --resolution needs less")
    elif isinstance(problem, OSError) and problem.strerror:
        console.error(f"{problem.filename or 'a file'}: {problem.strerror}")
    else:
        console.error(f"internal error: {type(problem).__name__}: {problem} (run again with --debug and report it)")
    return 1


def main() -> None:
    """Entry point of the `caustic` script."""
    sys.exit(run(sys.argv[1:]))
