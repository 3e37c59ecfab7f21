"""Lamps: completion of their settings, and the lens around the chip and its target made of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from caustic_cli.config import presets
from caustic_cli.config.settings import Given, Settings, index_of, read
from caustic_cli.errors import InputError
from caustic_cli.scene import anglemap
from caustic_cli.scene.lamp import NEAREST, Chip, Goal, Lamp
from caustic_cli.schema.table import (
    DesignSettings,
    LampSettings,
    LensSettings,
    ScreenSettings,
    SourceSettings,
    TargetSettings,
    check,
    check_all,
    default,
)

#: Radius of the hemisphere over that of the lens by the number of free-form surfaces, unless given; and the material, of which
#: lamps are moulded.
INNER, MATERIAL = {1: 4.0 / 15.0, 2: 2.0 / 15.0}, "PMMA"
#: Thickness of the board of an array, mm.
BOARD = 2.0
#: The settings of other sections that a lamp has; parameters have no section.
TAKEN = {
    "lens": ("index", "glass", "wavelength", "array"),
    "screen": ("z", "shift"),
    "target": ("file", "size", "encoding", "flip"),
    "design": ("seed", "start"),
}
PARAMETERS = ("throw", "picture_size", "screen_place", "invert")


def says_lamp(path: Path) -> bool:
    """Whether a path is a project of a lamp."""
    return (path / "project.toml").is_file() and "lamp" in read(path / "project.toml")


def asks_for_lamp(given: Mapping[str, Any], preset: str | None, config: Path | None) -> bool:
    """Whether settings by path, those of a preset or those of a configuration are of a lamp."""
    files = [*([presets.path_of(preset)] if preset else []), *([config] if config else [])]
    return any(path.startswith("lamp.") for path in given) or any("lamp" in read(file, parameters=True) for file in files)


def complete_lamp(given: Given, by: Mapping[str, Any], aspect: float) -> Settings:
    """The complete settings of a lamp.

    Args:
        given: the user's settings by section; by: parameters; aspect: height over width of the picture.

    Raises:
        InputError: a value is out of range, or a setting is given that a lamp does not have.
    """
    _refuse_others(given, by)
    lamp = LampSettings.of(given["lamp"])
    if lamp.radius is None:
        raise InputError(f"⟨lamp.{next(iter(given['lamp']))}⟩ belongs to a lamp, which ⟨+lamp.radius⟩ makes")
    check_all("lamp", lamp, *lamp)
    extent = ["chip"] if any(lamp.chip) else []
    if "file" in lamp and (others := [*extent, *(key for key in ("shape", "intensity") if key in lamp)]):
        raise InputError(f"⟨lamp.file⟩ holds where and how the chip emits: leave out ⟨lamp.{others[0]}⟩")
    radius = lamp.radius
    lamp = lamp.filled(inner=INNER[lamp.surfaces] * radius)
    lens = LensSettings(given.get("lens", {}))
    lens = lens if {"index", "glass"} & {*lens} else lens.filled(glass=MATERIAL)
    check_all("lens", lens, *({"array"} & {*lens}))
    if math.prod(lens.array) > 1:
        lamp = lamp.filled(base=BOARD, pitch=(2.0 * (radius + lamp.wall),) * 2)
    elif "pitch" in lamp:
        raise InputError("⟨lamp.pitch⟩ belongs to an array of lamps, which ⟨+lens.array⟩ makes")
    target, screen = _placed(given, by, lamp, aspect)
    check_all("target", target, *({"flip", "encoding"} & {*target}))
    design = DesignSettings({"seed": default("design.seed"), **given.get("design", {}), "start": "transport"})
    full = Settings(SourceSettings(), lens, screen, target, design, lamp=lamp)
    around, goal = lamp_of(full), goal_of(full)
    if not goal.distance >= NEAREST * around.radius:
        raise InputError(f"⟨screen.z⟩ of a lamp must be {NEAREST:g} times ⟨+lamp.radius⟩ or more, got {goal.distance:g} mm")
    return full


def _placed(given: Given, by: Mapping[str, Any], lamp: LampSettings, aspect: float) -> tuple[TargetSettings, ScreenSettings]:
    """Where the picture of a lamp is, on a screen or in the far field."""
    target, screen = TargetSettings(given.get("target", {})), ScreenSettings()
    far = "far" if by.get("throw") == math.inf else by.get("screen_place")
    if far not in (None, "far"):
        raise InputError(f"⟨screen_place⟩ of a lamp must be far, or be left out for a screen at ⟨+throw⟩, got {far}")
    if lamp.angles is None:
        if "projection" in lamp:
            raise InputError("⟨lamp.projection⟩ belongs to the far field, which ⟨+lamp.angles⟩ makes")
        if far:
            raise InputError("⟨screen_place⟩ far needs ⟨+lamp.angles⟩, the size of the picture in degrees")
        if "picture_size" not in by and "size" not in target:
            raise InputError(
                "a lamp needs the size of its picture: ⟨+picture_size⟩ on a screen, or ⟨+lamp.angles⟩ in the far field"
            )
        size = by.get("picture_size", target.get("size"))
        target = target.changed(size=(size[0], size[1] if len(size) == 2 else size[0] * aspect))
        z = by.get("throw", given.get("screen", {}).get("z", default("screen.z")))
        screen = ScreenSettings({**given.get("screen", {}), "z": z})
        check("target.size", target.size)
        check("screen.shift", screen.shift)
    elif "picture_size" in by or "size" in target or by.get("throw", math.inf) < math.inf or given.get("screen", {}):
        raise InputError(
            "⟨lamp.angles⟩ places the picture in the far field: leave out its distance, its size and its shift on a screen"
        )
    return target, screen


def _refuse_others(given: Given, by: Mapping[str, Any]) -> None:
    """Refuse settings that a lamp does not have.

    Raises:
        InputError: there are some.
    """
    paths = [f"{section}.{key}" for section, table in given.items() if section != "lamp" for key in table]
    others = [path for path in paths if path.split(".")[1] not in TAKEN.get(path.split(".")[0], ())]
    others += [key for key in by if key not in PARAMETERS]
    if others:
        raise InputError(
            f"⟨{others[0]}⟩ is not a setting of a lamp, which has those of [lamp], index or glass, ⟨+throw⟩, ⟨+picture_size⟩ and"
            " ⟨+design.seed⟩"
        )


def lamp_of(settings: Settings) -> Lamp:
    """The lens around the chip.

    Raises:
        InputError: out of range, see `Lamp`.
    """
    s = settings.lamp
    assert s is not None and s.radius is not None and s.inner is not None
    table, rays = (getattr(file, "content", None) for file in (s.intensity, s.file))
    if rays is not None:
        chip = replace(Chip.of_rays(rays), reflectance=s.reflectance)
    else:
        shape = "point" if s.chip == (0.0, 0.0) else s.shape
        chip = Chip(shape, s.chip, table, reflectance=s.reflectance)
    pitch = s.pitch if "pitch" in s else (0.0, 0.0)
    solid = s.inner, s.radius, s.wall, s.surfaces, s.base, s.flange
    return Lamp(chip, index_of(settings.lens), *solid, settings.lens.array, pitch, s.flat, ghosts=s.reflectance > 0)


def goal_of(settings: Settings) -> Goal:
    """Where its light is wanted.

    Raises:
        InputError: out of range, see `Goal`.
    """
    s = settings.lamp
    assert s is not None
    shift = settings.screen.shift
    if s.angles is None:
        return Goal(settings.target.size, settings.screen.z, shift)
    width, height = (anglemap.extent_of(s.projection, angle) for angle in s.angles)
    return Goal((width, height), projection=s.projection)
