"""The command-line parser; torch is imported inside the commands only, so that --help responds immediately."""

from __future__ import annotations

from typing import Annotated

import typer

from caustic_cli import __version__
from caustic_cli.commands import console, convergence, design, export, gradmap, render
from caustic_cli.commands.help import grouped
from caustic_cli.commands.options import command_of, with_lists

DESCRIPTION = """Design free-form lenses that project a picture as a caustic.

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


for _name, _module in (
    ("design", design),
    ("render", render),
    ("gradmap", gradmap),
    ("export", export),
    ("convergence", convergence),
):
    app.command(_name, epilog=_module.EXAMPLES)(command_of(_module.run))


def parser():
    """The parser: a Click group of the commands."""
    root = typer.main.get_command(app)
    for name, command in root.commands.items():
        grouped(name, command)
        with_lists(command)
        for parameter in command.params:
            parameter.show_envvar = False  # every option has a variable, named in the manual page
    return root
