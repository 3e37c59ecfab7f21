"""A new project from a picture and the user's settings: a preset, a configuration, options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from caustic_cli.config import presets, settings
from caustic_cli.config.completion import Derivation, complete, without_waves
from caustic_cli.config.settings import Settings, value_of
from caustic_cli.errors import InputError
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.io.files import Piped
from caustic_cli.io.picture import Picture, read_picture
from caustic_cli.optics.obstruction import clear_shift
from caustic_cli.project import attachments, uptodate
from caustic_cli.project.project import Project


def new_project(
    target: Path | Piped | Picture,
    given: Mapping[str, Any],
    preset: str | None,
    config: Path | None,
    out: Path | None,
    say: Callable[[str], None],
) -> tuple[Project, Settings]:
    """A project, of which nothing is written yet, and the settings that were given, by section.

    Args:
        given: path in `config.table` -> value, including derived parameters such as "mag".
        preset: a name of `config.presets`, whose settings are overridden by those of config.
        config: a TOML file of further settings, which are overridden by those `given`.
        out: its directory; None for a project in memory.

    Raises:
        InputError: invalid input.
    """
    read = [settings.read(path, parameters=True) for path in (preset and presets.path_of(preset), config) if path]
    if config and "source" in read[-1]:
        read[-1]["source"] = attachments.attached(read[-1]["source"], config.parent)
    if config and "design" in read[-1]:
        read[-1]["design"] = attachments.with_errors(read[-1]["design"], config.parent)
    if config and "screen" in read[-1]:
        read[-1]["screen"] = attachments.with_shape(read[-1]["screen"], config.parent)
    if config and "lens" in read[-1]:
        read[-1]["lens"] = attachments.with_index(read[-1]["lens"], config.parent)
    chosen = settings.by_section(given)
    said = settings.merged({}, *map(settings.implied, (*read, chosen)))
    if {"index", "glass"} <= {*said.get("lens", {})}:  # only where both are given at the same level
        glass = said["lens"].pop("glass")
        say(f"⟨lens.index⟩ {said['lens']['index']:g} is used at all wavelengths, and {glass} is ignored")
    if "design" in said:
        said["design"] = attachments.with_errors(said["design"])
    if "screen" in said:
        said["screen"] = attachments.with_shape(said["screen"])
    parameters = said.pop("", {})
    invert = parameters.pop("invert", False)
    if "elements" in parameters:  # those of the command line replace those of a configuration
        said["element"] = {"list": parameters.pop("elements")}
    by = Derivation(**parameters)
    if "source" in said:
        said["source"] = attachments.attached(said["source"])
    if "lens" in said:
        said["lens"] = attachments.with_index(said["lens"])
    goal = said.get("target", {})
    picture = (
        target
        if isinstance(target, Picture)
        else read_picture(target, goal.get("encoding") == "linear", goal.get("color", False), invert)
    )
    if not said.get("source", {}).get("weights", True):  # an empty list: weights may follow from the picture
        del said["source"]["weights"]
    if goal.get("color", False):
        if isinstance(target, Picture):
            raise InputError("⟨target.color⟩ needs the file of a picture: an array (n_x, n_y) has no colours")
        light = [float(c) for c in picture.irradiance().sum((1, 2))]
        said.setdefault("source", {}).setdefault("weights", [c / sum(light) for c in light])
    profile = said.get("source", {}).get("profile")
    light = read_picture((config.parent if config else Path()) / profile, linear=True) if profile else None
    full = complete(said, picture.aspect, by, picture.lit, picture.gaps)
    for key in ("index_range", "index_control", "index_layers"):
        if f"lens.{key}" in given and full["lens"].get("gradient") != "free":
            raise InputError(f"⟨lens.{key}⟩ belongs to ⟨+lens.gradient⟩ free")
    if value_of(full["lens"], "lens.mirror") and "shift" not in full["screen"] and any(shift := _beside_the_light(full)):
        said["screen"] = said.get("screen", {}) | {"shift": list(shift)}
        full = complete(said, picture.aspect, by, picture.lit, picture.gaps)
        say(f"the screen is shifted by {shift[0]:g},{shift[1]:g} mm, beside the light of its source; ⟨+screen.shift⟩ places it")
    settings.refuse_unused(full["source"], given, [stage.get("source") for stage in full["design"]["stages"]])
    farther = full.get("second", {}).get("file")
    second = None
    if farther:
        at = config.parent if config and "file" not in chosen.get("second", {}) else Path()
        second = read_picture(at / farther, goal.get("encoding") == "linear", False, invert)
        full["second"]["file"] = f"second{second.suffix}"
    full["target"] |= {"file": f"target{picture.suffix}", "encoding": picture.encoding}
    if light is not None:
        full["source"]["profile"] = f"profile{light.suffix}"
    attachments.named_in_project(full)
    made = Project(
        out,
        full,
        picture,
        light,
        second,
        uptodate.digest(full, picture, light, second),
        without_waves=without_waves(full, "stages" in said.get("design", {})),
    )
    return made, said


def _beside_the_light(full: Settings) -> tuple[float, float]:
    """Shift (x, y) mm of a mirror's screen with which it is nowhere in the light of its source; 0 if there is none."""
    scene, over = settings.build_scene(full), Ranges.parse(value_of(full["design"], "design.over"))
    return clear_shift([scene] if over is None else over.ends(scene)) or (0.0, 0.0)
