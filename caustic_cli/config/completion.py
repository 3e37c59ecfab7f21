"""Completion of settings: a complete project from a picture and the user's settings.

Screen, picture and base surface follow from the magnification, the stages from control net, rays and pixels.  Optional features are
completed in `optional`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caustic_cli.config.design import relative_to_initial
from caustic_cli.config.optional import (
    centre_screen,
    complete_blank,
    complete_elements,
    complete_over,
    complete_second,
    complete_second_size,
    default_magnification,
)
from caustic_cli.config.settings import (
    DEFAULTS,
    Settings,
    build_screen,
    build_source,
    index_of,
    value_of,
    with_defaults,
)
from caustic_cli.config.table import check, default
from caustic_cli.errors import InputError
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.kinds import complete_design
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.scene import Offset, Source, sources
from caustic_cli.scene.light import RGB

DEFAULT_RESOLUTION = 250
STEEPEST = 1.25  # least radius of a derived sphere in half diagonals of the lens: slopes up to 1.3
PLATE, WALL = 20.0, 3.0  # width beyond which a lens is a thin plate, and its least wall thickness, mm
THICK, SAG = 2.0, 0.45  # thickness over width of a lens with two free-form sides, and largest height of a side over thickness
OBLONG = 2.5  # anamorphic ratio of the magnifications from which on another lens shape is recommended
COLOR_GLASS = "N-BK7"  # for a coloured picture without glass or index, since dispersion has to be known


@dataclass(frozen=True)
class Derivation:
    """Parameters from which settings are derived and which are not stored in a project, by their paths in the table; None if not
    given.

    mag: picture width over lens width; margin: total width of the dark border relative to the picture; throw: distance of the
    screen;
    screen_size: mm, (width,) or (width, height); resolution: pixels, (across,) or (across, up); quality: of the default stages;
    rays: of the last default stage.
    """

    mag: float | None = None
    margin: float | None = None
    throw: float | None = None
    screen_size: tuple[float, ...] | None = None
    resolution: tuple[int, ...] | None = None
    quality: str | None = None
    rays: int | None = None

    def __post_init__(self):
        for key in ("mag", "margin", "throw", "quality", "rays"):
            if getattr(self, key) is not None:
                check(key, getattr(self, key))


def complete(
    given: Settings, aspect: float, by: Derivation | None = None, lit: tuple[float, float] = (1.0, 1.0), gaps: float = 0.0
) -> Settings:
    """The complete settings of a project.

    Args:
        given: the user's settings, from options or a configuration.
        aspect: height over width of the picture.
        by: the user's parameters.
        lit: fractions of the picture's width and height that are not dark.
        gaps: dark gaps between its bright parts, see `Picture.gaps`.

    Raises:
        InputError: a value is out of range, or two contradict each other.
    """
    s, by = with_defaults(given), by or Derivation()
    lens, screen, target = s["lens"], s["screen"], s["target"]
    if value_of(target, "target.sheet"):
        array = check("lens.array", value_of(lens, "lens.array"))
        if max(array) == 1 or value_of(target, "target.color"):
            raise InputError("⟨target.sheet⟩ needs ⟨+lens.array⟩, and a picture without colours")
        aspect, lit = aspect * array[0] / array[1], (1.0, 1.0)
    mirror = value_of(lens, "lens.mirror")
    if by.throw is not None:
        screen["z"] = -by.throw if mirror else by.throw
    elif mirror and "z" not in given.get("screen", {}):
        screen["z"] = -screen["z"]
    if by.screen_size is not None:
        screen["size"] = [by.screen_size[0], by.screen_size[-1] if len(by.screen_size) == 2 else by.screen_size[0] * aspect]
    if by.resolution is not None:
        screen.pop("resolution", None)
        if len(by.resolution) == 2:
            screen["resolution"] = list(by.resolution)
    if value_of(target, "target.color"):
        if s["source"].get("also"):
            raise InputError("[[source]] of a coloured picture must be one, whose three wavelengths are its colours")
        s["source"].setdefault("wavelengths", list(RGB))
        if "index" not in lens:
            lens.setdefault("glass", COLOR_GLASS)
    over = Ranges.parse(value_of(s["design"], "design.over"))
    if over and "throw" in over.keys:
        centre_screen(over, s, given, by.throw)
    mag, margin = by.mag, default("margin") if by.margin is None else by.margin
    check("lens.size", lens["size"])
    if check("screen.z", screen["z"]) == 0:
        raise InputError("⟨screen.z⟩ must lie behind the lens, or before a mirror, got 0 mm")
    if "size" in screen:
        check("screen.size", screen["size"])
    if "size" in target:
        check("target.size", target["size"])
    check("target.flip", target["flip"])
    check("target.encoding", target["encoding"])
    complete_source(s["source"], lens, [stage.get("source", "") for stage in s["design"].get("stages", [])])
    if over:
        complete_over(over, s, given)
    if (over or relative_to_initial(s["design"])) and "initial" not in given.get("design", {}):
        s["design"]["initial"] = "zero-last"
    complete_second(s)
    if "size" not in target or mag is not None:
        if mag is None and "size" in screen:
            fit = min(screen["size"][0], screen["size"][1] / aspect) / (1.0 + margin)
        else:
            fit = (mag or default_magnification(s)) * lens["size"][0]
        target["size"] = [fit, fit * aspect]
    if "size" not in screen:
        screen["size"] = [(1.0 + margin) * x for x in target["size"]]
    if "resolution" not in screen:
        nx = by.resolution[0] if by.resolution else DEFAULT_RESOLUTION
        screen["resolution"] = [nx, max(2, round(nx * screen["size"][1] / screen["size"][0]))]
    complete_second_size(s)
    complete_elements(s)
    build_screen(s)
    source = build_source(s)
    _complete_lens(lens, screen, target, source, sides=2 if "second" in s else 1)
    complete_design(s, Defaults(s, source, by.quality, by.rays, lit, gaps))
    return s


def complete_source(source: dict[str, Any], lens: dict[str, Any], stages: Sequence[str] = (), where: str = "⟨source.type⟩") -> None:
    """Complete the keys of the source types in use, and remove defaults that none of them uses.

    stages: the source types of the stages, "" for the source's own; their keys are needed, too.
    """
    if "also" in source:
        source["also"] = [{**DEFAULTS["source"], **table} for table in source["also"]]
        for table in source["also"]:
            complete_source(table, lens, where="⟨source.also.type⟩")
    types = [sources.type_of(source["type"], where)]
    types += [sources.type_of(type, "⟨design.stages.source⟩") for type in stages if type]
    for type in types:
        for key, value in type.defaults(lens).items():
            source.setdefault(key, value)
    for key in set(DEFAULTS["source"]).difference(sources.COMMON, *(type.keys for type in types)):
        source.pop(key, None)


def first_thickness(size: Sequence[float]) -> float:
    """Default thickness of a lens, mm."""
    width = max(size)
    return width / 2.0 if width <= PLATE else WALL + width / 10.0


def _complete_lens(lens: dict[str, Any], screen: dict[str, Any], target: dict[str, Any], source: Source, sides: int) -> None:
    index, scale = index_of(lens), max(lens["size"]) / 10.0
    check("lens.index", index)
    if lens.get("gradient") == "free":
        complete_blank(lens, screen, index)
    if "glass" not in lens:
        lens["index"] = index
    else:
        lens.setdefault("wavelength", default("lens.wavelength"))
    free = "thickness" not in lens
    lens.setdefault("thickness", THICK * max(lens["size"]) if sides == 2 else first_thickness(lens["size"]))
    lens.setdefault("height_range", [-scale, scale] if sides == 1 else [c * SAG * lens["thickness"] for c in (-1.0, 1.0)])
    if sides == 2:
        lens.setdefault("radius", [math.inf, math.inf])
    mirror, array = value_of(lens, "lens.mirror"), check("lens.array", value_of(lens, "lens.array"))
    if mirror and screen["z"] >= lens["thickness"] + lens["height_range"][0]:
        raise InputError(
            f"⟨screen.z⟩ must lie before the mirror, which begins at"
            f" {lens['thickness'] + lens['height_range'][0]:.4g} mm, got {screen['z']:g} mm"
        )
    if not mirror and screen["z"] <= lens["thickness"] + lens["height_range"][1]:
        raise InputError(
            f"⟨screen.z⟩ must lie behind the lens, which is up to"
            f" {lens['thickness'] + lens['height_range'][1]:.4g} mm thick, got {screen['z']:g} mm"
        )
    if "radius" not in lens:
        # The pictures of lenslets are superimposed: the light through their centres converges like that of a focusing lens.
        across, along = (t / w if k == 1 else 0.0 for t, w, k in zip(target["size"], lens["size"], array, strict=True))
        vergence = 0.0
        if source.nearest < lens["z_in"]:  # vergence at the surface, 1/mm; 0 for a source at infinity
            vergence = 1.0 / (lens["z_in"] - source.centre[2] + (lens["thickness"] - lens["z_in"]) / (1.0 if mirror else index))
        radius = Offset.for_magnification(
            (across, along), -1.0 if mirror else index, screen["z"], lens["thickness"], vergence
        ).radius
        least = STEEPEST * math.hypot(*lens["size"]) / 2.0  # an oblong picture or a near source may ask for a smaller radius
        lens["radius"] = [math.copysign(max(abs(r), least), r) for r in radius]
    if free and sides == 1:
        lens["thickness"] += _missing_room(lens)


def _missing_room(lens: dict[str, Any]) -> float:
    """Increase of the thickness, mm, with which the base surface keeps the least thickness; 0 if the heights have room already.

    A strongly converging lens, for a close source for instance, is thinnest at its corners.
    """
    x, y = (np.array([0.0, width / 2.0]) for width in lens["size"])
    lowest = lens["thickness"] + float(Offset(0.0, tuple(lens["radius"])).sag(x[:, None], y[None, :]).min())
    short = lens["z_in"] + value_of(lens, "lens.min_thickness") - lowest
    return short if short >= lens["height_range"][1] else 0.0


def shape_words(s: Settings) -> str:
    """A recommendation of a lens shape for an oblong picture; "" if the magnifications are similar."""
    (w, h), (a, b) = s["target"]["size"], s["lens"]["size"]
    if OBLONG > h * a / (w * b) > 1.0 / OBLONG:
        return ""
    width = math.sqrt(a * b * w / h)
    return (
        f"the picture is magnified {w / a:.3g} times along x and {h / b:.3g} times along y; a lens of its own shape needs less"
        f" depth: ⟨+lens.size⟩ {width:.3g}x{width * h / w:.3g}"
    )
