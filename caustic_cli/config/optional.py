"""Completion of optional features: networks trained over ranges, two free-form sides, other elements, a designed gradient index.

Each function completes its own part of the settings, if present, for `completion`.
"""

from __future__ import annotations

import math

from caustic_cli.config.default_stages import Table
from caustic_cli.config.settings import Settings, build_source, elements_of, value_of
from caustic_cli.config.table import check, default
from caustic_cli.errors import InputError
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.scene.elements import check_compatible_with_elements

OVER_WIDTH = 128  # width of a dense network over a range: caustic convergence, study design, networks
BEAM = 1.2  # width of a further lens or mirror over that of a beam from the lens' edges to those of the picture
#: For a free gradient: half range about the index; degree of its splines, knot spans per pixel and their largest number.
HALF_RANGE, INDEX_DEGREE, INDEX_SPANS, MOST_SPANS = 0.05, 3, 2, 768


def centre_screen(over: Ranges, s: Settings, given: Settings, throw: float | None) -> None:
    """Place the screen of a network that is trained over throws at the middle of their range.

    Raises:
        InputError: another position is given.
    """
    screen, z = s["screen"], over.middle[over.keys.index("throw")]
    z = -z if value_of(s["lens"], "lens.mirror") else z
    said = throw is not None or "z" in given.get("screen", {})
    if said and not math.isclose(screen["z"], z, rel_tol=1e-9):
        raise InputError(f"⟨screen.z⟩ must be the middle of ⟨design.over⟩ throw, {z:g} mm, or not be given, got {screen['z']:g} mm")
    screen["z"] = z


def complete_over(over: Ranges, s: Settings, given: Settings) -> None:
    """Complete a network that is trained over ranges: source at their middle, preconditioner and width.

    Raises:
        InputError: another source position is given, or the source does not support ranges.
    """
    source, design = s["source"], s["design"]
    middle = {key.removeprefix("source."): v for key, v in zip(over.keys, over.middle, strict=True) if key != "throw"}
    if middle:
        over.refuse(build_source(s))
    if middle and "position" in source:  # a user-defined source type may have none
        place = [middle.get(axis, c) for axis, c in zip("xyz", source["position"][0], strict=True)]
        if "position" in given.get("source", {}) and not all(
            math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9) for a, b in zip(place, source["position"][0], strict=True)
        ):
            raise InputError(
                "⟨source.position⟩ must have the middle of ⟨design.over⟩ where that names it,"
                f" {','.join(f'{c:g}' for c in place)}, got {','.join(f'{c:g}' for c in source['position'][0])}"
            )
        source["position"] = [place]
    if design["network"] != "none":
        design.setdefault("preconditioner", "laplacian")
    if design["network"] == "dense":
        design.setdefault("network_width", OVER_WIDTH)


def default_magnification(s: Settings) -> float:
    """Default magnification of the picture; for collimated or focused light that of a beam as wide as the lens."""
    second = s.get("second", {})
    if "focus" in second and second["focus"][2] != 0:
        return abs(1.0 - s["screen"]["z"] / second["focus"][2])
    return 1.0 if second.get("collimate") else default("mag")


def complete_second(s: Settings) -> None:
    """Complete and check the [second] section, which makes the entrance free-form; an empty section is removed.

    Raises:
        InputError: keys contradict each other, or are combined with unsupported features.
    """
    second = s.get("second", {})
    said = _of_second(s)
    if not said:
        for key in ("z", "size"):
            if key in second:
                raise InputError(f"⟨second.{key}⟩ belongs to ⟨+second.file⟩, which is not given")
        s.pop("second", None)
        return
    if len(said) > 1:
        raise InputError(f"⟨second.{said[0]}⟩ and ⟨second.{said[1]}⟩ both define the light behind the picture: give one of them")
    if "focus" in second:
        places = second["focus"]
        second["focus"] = list(check("second.focus", places[0] if len(places) == 1 else places))
    if "file" in second and "z" not in second:
        raise InputError("⟨second.file⟩ needs ⟨+second.z⟩, the distance of its screen")
    design, source = s["design"], s["source"]
    wrong = {
        "lens.mirror": value_of(s["lens"], "lens.mirror"),
        "target.color": value_of(s["target"], "target.color"),
        "lens.gradient": "gradient" in s["lens"],
        "lens.array": max(value_of(s["lens"], "lens.array")) > 1,
        "design.robust": design.get("robust", ""),
        "design.network": design["network"] != "none",
        "design.optimizer": design["optimizer"] != "lbfgs",
    }
    for path, given in wrong.items():
        if given:
            raise InputError(
                f"⟨{path}⟩ cannot be combined with ⟨second.{said[0]}⟩, which needs two free-form sides of heights by lbfgs"
            )
    if source.get("also") or source["type"] == "rays":
        raise InputError(f"⟨second.{said[0]}⟩ needs one source that is no ray file")


def _of_second(s: Settings) -> list[str]:
    """Keys given of those that define the light behind the picture."""
    return [key for key in ("file", "collimate", "focus") if s.get("second", {}).get(key)]


def complete_second_size(s: Settings) -> None:
    """Default size of a second picture: that of a beam from the lens' edge through that of the first picture."""
    second = s.get("second", {})
    if "file" not in second:
        return
    check("second.z", second["z"])
    grown, size, lens = second["z"] / s["screen"]["z"], s["target"]["size"], s["lens"]["size"]
    second.setdefault("size", [max(0.1 * t, w + (t - w) * grown) for t, w in zip(size, lens, strict=True)])
    check("second.size", second["size"])


def complete_elements(s: Settings) -> None:
    """Default sizes of other lenses and mirrors, and checks of unsupported combinations."""
    tables, design = [dict(table) for table in elements_of(s)], s["design"]
    if not tables:
        s.pop("element", None)
        return
    s["element"] = {"list": tables}
    check_compatible_with_elements(
        {
            **{f"second.{key}": True for key in _of_second(s)},
            "design.robust": design.get("robust"),
            "design.waves": design["waves"] == "on" and "on",
            "lens.gradient": s["lens"].get("gradient"),
        }
    )
    if any(table.get("free", "none") != "none" for table in tables):
        check_compatible_with_elements(
            {
                "design.network": design["network"] != "none" and design["network"],
                "design.optimizer": design["optimizer"] != "lbfgs" and design["optimizer"],
                "target.color": value_of(s["target"], "target.color"),
            },
            free=True,
        )
    lens, picture, throw = s["lens"]["size"], s["target"]["size"], abs(s["screen"]["z"])
    for table in tables:
        if "z" in table:
            along = min(1.0, max(0.0, check("element.z", table["z"]) / throw))
            size = [BEAM * (a + (b - a) * along) if along else a for a, b in zip(lens, picture, strict=True)]
            lean = [math.cos(math.radians(t)) for t in check("element.tilt", table.get("tilt", (0.0, 0.0)))]
            size = [w / c for w, c in zip(size, lean[::-1], strict=True)]
            table.setdefault("size", [max(size)] * 2 if table.get("aperture") == "circle" else size)


def complete_blank(lens: Table, screen: Table, index: float) -> None:
    """Complete a plane-parallel blank whose gradient index is designed; its sides have the smallest control net."""
    if value_of(lens, "lens.mirror"):
        raise InputError("⟨lens.gradient⟩ free needs a lens: light never enters a mirror")
    if any(map(math.isfinite, lens.setdefault("radius", [math.inf, math.inf]))):
        raise InputError(f"⟨lens.radius⟩ of a free gradient must be [inf, inf], two flat sides, got {lens['radius']}")
    lens.setdefault("control", [p + 1 for p in check("lens.degree", lens["degree"])])
    lens.setdefault("index_range", [max(1.0, index - HALF_RANGE), index + HALF_RANGE])
    lens.setdefault("index_control", [min(MOST_SPANS, INDEX_SPANS * n) + INDEX_DEGREE for n in screen["resolution"]])
    for key in ("index_range", "index_control", "index_layers"):
        check(f"lens.{key}", value_of(lens, f"lens.{key}"))
    if not lens["index_range"][0] < lens["index_range"][1]:
        raise InputError(f"⟨lens.index_range⟩ must ascend, got {lens['index_range']}")
