"""The outputs of a render and the studies are lists of objects, and commands are made of the options they declare."""

import inspect
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import typer

from caustic_cli.commands import options
from caustic_cli.commands.export import TAKERS
from caustic_cli.commands.parser import parser
from caustic_cli.commands.waves import rays_alone
from caustic_cli.errors import MARK
from caustic_cli.export import FORMATS
from caustic_cli.workflow.convergence import NETWORKS, STUDIES
from caustic_cli.workflow.export import LESS
from caustic_cli.workflow.outputs import OUTPUTS, outputs_for
from caustic_cli.workflow.outputs.base import Place, Request


def asked(**given) -> SimpleNamespace:
    """Options of caustic render."""
    return SimpleNamespace(**{p.name: None for p in parser().commands["render"].params} | given)


def test_every_output_has_an_option_or_belongs_to_every_render():
    named = {p.name for p in parser().commands["render"].params}
    own = [kind.option for kind in OUTPUTS if kind.option]
    assert len(own) > 5 and set(own) <= named and len(set(own)) == len(own)
    assert [type(output) for output in outputs_for(asked())] == [kind for kind in OUTPUTS if not kind.option]


def test_outputs_lie_beside_the_image_and_say_what_was_asked(tmp_path):
    found = outputs_for(asked(report=True, tool_radius=2.0, npy=tmp_path / "a.npy", want=Path("other.png")))
    request = Request(tmp_path, outputs=found)
    assert request.asks["report"] is True and request.asks["tool_radius"] == 2.0 and "want" in request.asks
    assert request.shows == {} and "npy" in request.asks and tmp_path / "a.npy" not in request.asks.values()
    place = Place(tmp_path, None, tmp_path / "b.png")
    names = [path.name for output in found for path in output.paths(place)]
    assert names == ["b.png", "b-wave.png", "a.npy", "a-wave.npy", "b-report.json", "b-wanted.png"]


def test_studies_are_known_by_their_names():
    assert all(kind.name == name for name, kind in STUDIES.items()) and NETWORKS.name not in STUDIES
    assert {option for kind in STUDIES.values() for option in kind.takes} == {"seconds", "repeats", "dtype"}


class Toy(options.Debugging):
    """Two options of its own before one that is shared."""

    first: Annotated[int, typer.Option(help="A number.")] = 1
    second: Annotated[str | None, typer.Option(help="A text.")] = None


def test_a_command_is_made_of_the_options_it_declares():
    found = []

    def body(given: Toy) -> None:
        """A toy."""
        found.append(given)

    command = options.command_of(body)
    assert list(inspect.signature(command).parameters) == ["first", "second", "debug"] and command.__doc__ == "A toy."
    command(first=3, second=None, debug=False)
    assert found[0].first == 3 and found[0].second is None and found[0].debug is False


def test_an_error_by_rays_is_excused_where_diffraction_makes_it():
    figures = {"error": 0.07, "relative_rms": 0.87, "noise": 0.002, "on_target": 0.88}
    assert "no fault of the lens" in rays_alone(figures)
    assert "no fault" not in rays_alone(figures | {"error": 2.47, "relative_rms": 2.48})


def test_of_a_slow_export_options_are_named_that_its_format_takes():
    named = [(name, option) for name, words in LESS.items() for option in MARK.findall(words)]
    assert {name for name, _ in named} == {*FORMATS}
    assert all(name in TAKERS.get(option, TAKERS["milling"]) for name, option in named)
