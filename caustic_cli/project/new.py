"""A new project from a picture and the user's settings: a preset, a configuration, options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from caustic_cli.config import presets, settings
from caustic_cli.config.lamp import goal_of
from caustic_cli.config.settings import Given, Settings
from caustic_cli.config.wave_stages import without_waves
from caustic_cli.errors import InputError
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.io.files import Piped
from caustic_cli.io.photometry import SUFFIXES, read_photometry
from caustic_cli.io.picture import Picture, is_road, read_picture
from caustic_cli.kinds import kind_of
from caustic_cli.loading import OnDemand
from caustic_cli.optics.obstruction import clear_shift
from caustic_cli.project import attachments, colours, uptodate
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.schema.table import Parameters, TargetSettings

photometric_target = OnDemand("caustic_cli.project.photometric_target")
road_target = OnDemand("caustic_cli.project.road_target")


def new_project(
    target: Path | Piped | Picture,
    given: Mapping[str, Any],
    preset: str | None,
    config: Path | None,
    out: Path | None,
    say: Callable[[str], None],
) -> tuple[Project, Given]:
    """A project, of which nothing is written yet, and the settings that were given, by section.

    Args:
        given: path in `schema.table` -> value, including derived parameters such as "mag".
        preset: a name of `config.presets`, whose settings are overridden by those of config.
        config: a TOML file of further settings, which are overridden by those `given`.
        out: its directory; None for a project in memory.

    Raises:
        InputError: invalid input.
    """
    said = _merged(given, preset, config, say)
    parameters = Parameters(said.pop("", {}))
    if parameters.elements is not None:  # those of the command line replace those of a configuration
        said["element"] = {"list": list(parameters.elements)}
    goal = TargetSettings.of(said.get("target", {}))
    picture = (
        target
        if isinstance(target, Picture)
        else _of_lamps(target, said, parameters, say)
        or read_picture(target, goal.encoding == "linear", goal.color, parameters.invert)
    )
    if not said.get("source", {}).get("weights", True):  # an empty list: weights may follow from the picture
        del said["source"]["weights"]
    said = colours.completed(said, goal, picture)
    full = complete(said, picture.aspect, parameters, picture.lit, picture.gaps)
    if full.lamp is not None:
        full = attachments.named_in_project(_with_picture(full, picture))
        return Project(out, full, picture, uptodate.digest(full, picture)), said
    kind_of(full).refuse_idle(given)
    if full.lens.mirror and "shift" not in full.screen and any(shift := _beside_the_light(full)):
        said["screen"] = said.get("screen", {}) | {"shift": list(shift)}
        full = complete(said, picture.aspect, parameters, picture.lit, picture.gaps)
        say(f"the screen is shifted by {shift[0]:g},{shift[1]:g} mm, beside the light of its source; ⟨+screen.shift⟩ places it")
    settings.refuse_unused(full.source, given, [stage.source for stage in full.design.stages])
    if beyond := colours.beyond_words(picture, settings.build_light(full)):
        say(beyond)
    full = _with_picture(full, picture)
    full = attachments.named_in_project(full)
    asked = uptodate.digest(full, picture)
    return Project(out, full, picture, asked, without_waves=without_waves(full, "stages" in said.get("design", {}))), said


def _of_lamps(target: Path | Piped, said: Given, parameters: Parameters, say: Callable[[str], None]) -> Picture | None:
    """The picture of a target that follows from where a lamp throws it, a photometric file or that of `road_target`, None for
    another; without a size of its picture a lamp gets the angles of the file's light.

    Raises:
        InputError: the file is damaged or has no light, or the design is none of a lamp.
    """
    if isinstance(target, Piped):
        return None
    by_name = is_road(target)
    if not (by_name or target.suffix.lower() in SUFFIXES):
        return None
    if "lamp" not in said:
        what = "the illuminance of a road" if by_name else "a photometric file"
        raise InputError(f"{target}: is {what}, whose light lamps throw: ⟨+lamp.radius⟩ is needed")
    lamp, light = said["lamp"], None if by_name else read_photometry(target)
    if light and (edges := photometric_target.edges_of(light)):
        say(f"{target}: {edges}")
    try:
        if light and "angles" not in lamp and "picture_size" not in parameters and "size" not in said.get("target", {}):
            said["lamp"] = {**lamp, "angles": photometric_target.angles_of(light, lamp.get("projection", "latitude"))}
        goal = goal_of(complete(said, 1.0, parameters))
        return Picture(photometric_target.picture_of(light, goal) if light else road_target.picture_of(goal), "linear")
    except InputError as error:
        raise InputError(f"{target}: {error}") from error


def _with_picture(full: Settings, picture: Picture) -> Settings:
    """Settings that name the picture's file in the project."""
    return full.changed(target=full.target.changed(file=f"target{picture.suffix}", encoding=picture.encoding))


def _merged(given: Mapping[str, Any], preset: str | None, config: Path | None, say: Callable[[str], None]) -> Given:
    """The settings of preset, configuration and command line, with the contents of the files they name."""
    layers = [settings.read(presets.path_of(preset), parameters=True)] if preset else []
    if config:
        layers.append(attachments.located(settings.read(config, parameters=True), config.parent))
    said = settings.merged({}, *map(settings.implied, (*layers, settings.by_section(given))))
    if {"index", "glass"} <= {*said.get("lens", {})}:  # only where both are given at the same level
        glass = said["lens"].pop("glass")
        say(f"⟨lens.index⟩ {said['lens']['index']:g} is used at all wavelengths, and {glass} is ignored")
    return attachments.attached(said)


def _beside_the_light(full: Settings) -> tuple[float, float]:
    """Shift (x, y) mm of a mirror's screen with which it is nowhere in the light of its source; 0 if there is none."""
    scene, over = settings.build_scene(full), Ranges.parse(full.design.over)
    return clear_shift([scene] if over is None else over.ends(scene)) or (0.0, 0.0)
