"""The pages in man/ are what the commands say, today."""

import re
from pathlib import Path

import pytest
import typer

from caustic_cli.commands import manpage
from caustic_cli.commands.parser import app
from caustic_cli.config import presets
from caustic_cli.scene.materials import MATERIALS
from caustic_cli.schema.table import TABLE

PAGE = Path(__file__).parents[1] / "man" / "caustic.1"
COMMANDS = typer.main.get_command(app).commands


def plain() -> str:
    """The page without roff's escapes."""
    return re.sub(r"\\f[A-Z]", "", manpage.build().replace("\\-", "-").replace("\\&", "").replace("\\e", "\\"))


def test_the_committed_pages_are_fresh():
    committed = {p.name: p.read_text(encoding="utf-8") for p in PAGE.parent.glob("*.[15]")}
    assert committed == manpage.pages(), "python -m caustic_cli.commands.manpage man"
    installed = (PAGE.parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    assert all(f'"man/{name}" = "share/man/man{name[-1]}/{name}"' in installed for name in committed)


def test_the_reference_says_every_setting():
    page = manpage.reference().replace("\\-", "-")
    assert page.count(".TP\n") - len(MATERIALS) - len(presets.names()) == len(TABLE) > 70
    for row in TABLE.values():
        assert f"\\fB{row.key}\\fR\n" in page and (not row.why or row.why in page)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_page_of_each_command_says_what_its_help_says(name):
    page = manpage.pages()[f"caustic-{name}.1"]
    assert re.findall(r"^\.SH (.*)$", page, re.M) == ["NAME", "SYNOPSIS", "DESCRIPTION", "OPTIONS", "EXAMPLES", "SEE ALSO"]
    shown = page.replace("\\-", "-")
    assert all(option in shown for p in COMMANDS[name].params if p.param_type_name == "option" for option in p.opts)
    assert len(re.findall(rf"^caustic {name} ", page.split(".SH EXAMPLES")[1], re.M)) >= 2


def test_five_commands():
    assert set(COMMANDS) == {"design", "render", "gradmap", "export", "convergence"}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_in_its_command_section(name, capsys):
    with pytest.raises(SystemExit):
        COMMANDS[name].main(["--help"], prog_name=f"caustic {name}")
    text = capsys.readouterr().out
    options = set(re.findall(r"^\s+(?:-\w, )?(--[a-z-]+)", text, re.M)) - {"--help"}
    assert len(options) > 5
    section = plain().split(f".SS caustic {name} ", 1)[1].split(".SS ")[0].split(".SH ")[0]
    listed = set(re.findall(r"^(--[a-z-]+)", section, re.M))
    assert listed == options


def test_sections_in_the_usual_order():
    heads = re.findall(r"^\.SH (.*)$", manpage.build(), re.M)
    assert heads == [
        "NAME",
        "SYNOPSIS",
        "DESCRIPTION",
        "COMMANDS",
        "FILES",
        "JSON",
        "LIGHTTOOLS ARCHIVE",
        "ORIENTATION",
        "REPEATED COMMANDS",
        "COMPLETION",
        "EXIT STATUS",
        "ENVIRONMENT",
        "SEVERAL PROCESSES",
        "EXAMPLES",
    ]


def test_no_line_is_taken_for_a_request_by_accident():
    known = {"TH", "SH", "SS", "TP", "PP", "B", "I", "RI", "IR", "BR", "BI", "nf", "fi"}
    requests = re.findall(r"^[.'](\S*)", manpage.build(), re.M)
    assert len(requests) > 100 and set(requests) <= known


def test_every_example_is_of_a_command_that_is():
    examples = re.findall(r"^caustic (\w+)", plain().split(".SH EXAMPLES")[1], re.M)
    assert set(examples) == set(COMMANDS)
