"""The settings that follow from others: a complete project from a picture and what the user said.

Screen, picture and offset surface follow from the magnification; the stages from control net, rays and pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from caustic_cli.config.plans import (
    GAPS,
    LEAST_SPANS,
    LEAST_WAVES,
    TWO_SIDED_SPANS,
    Table,
    coarse_to_fine,
    creased_control,
    each_lenslet,
    on_rays,
    on_waves,
    refinement,
    refinement_spans,
    two_sided,
    wave_refinement,
)
from caustic_cli.config.settings import (
    DEFAULTS,
    Settings,
    build_lens,
    build_light,
    build_screen,
    build_source,
    elements_of,
    index_of,
    value_of,
    with_defaults,
)
from caustic_cli.config.table import check, default
from caustic_cli.errors import InputError
from caustic_cli.inverse.conditions import Ranges
from caustic_cli.inverse.designer import Options
from caustic_cli.inverse.extended import shift_of
from caustic_cli.inverse.lenslets import FROM_AFAR
from caustic_cli.inverse.parametrisation import Architecture
from caustic_cli.inverse.schedule import Stage
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.resolution import BAND, Resolution, white
from caustic_cli.scene import Offset, Scene, Screen, Source, sources
from caustic_cli.scene.elements import refuse_beside
from caustic_cli.scene.lens import array_control
from caustic_cli.scene.light import RGB
from caustic_cli.scene.sources.section import content
from caustic_cli.scene.tolerances import Tolerances

DEFAULT_RESOLUTION = 250
DEFAULT_SPANS = 128  # knot spans of the finished net; 128 halve evenly through the stages
NETWORK_CONTROL = 50  # table D.2
OVER_WIDTH, OVER_ITERATIONS = 128, 200  # of a network over a range: caustic convergence, study design, networks
RAYS_PER_PIXEL = 9.0  # 750 x 750 rays on 250 x 250 pixels, tables D.1 and D.2
DRAFT_SECONDS, FINE_SECONDS = 8.0, 60.0  # time limits below and from which another quality is the better use of the time
STEEPEST = 1.25  # least radius of a derived sphere, in half diagonals of the lens: slopes up to 1.3
WAVE_KEYS = ("control", "blur", "apron", "iterations", "tolerance")  # of a stage on rays that one on the wave image has too
PLATE, WALL = 20.0, 3.0  # width beyond which a lens is a plate, as thin as its relief and this wall allow, mm
THICK, SAG = 2.0, 0.45  # thickness over width of a lens with two free-form sides, and what of it each of them may take
BEAM = 1.2  # width of another lens or a mirror over that of a beam from the lens' edges to the picture's
OBLONG = 2.5  # ratio of the magnifications along the axes from which on another shape of lens is advised
#: Of a free gradient: range to either side of the index; degree of its splines, knot spans a pixel and the most of them; and rays a
#: pixel at most, since they cost more.
HALF_RANGE, INDEX_DEGREE, INDEX_SPANS, MOST_SPANS, RAYS_BENT = 0.05, 3, 2, 768, 16
COLOR_GLASS = "N-BK7"  # of a coloured picture, unless glass or index is said: dispersion has to be known


@dataclass(frozen=True)
class Derivation:
    """What settings are derived from that no project holds, by its path in the table: `mag` and the like; None where not given.

    mag: picture width over lens width; margin: black border, part of the picture's width in all; throw: distance of the screen;
    screen_size: of the screen, mm, (width,) or (width, height); resolution: pixels, (across,) or (across, up); quality: of the
    default stages; rays: of the last default stage.
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
    """Every setting a project needs.

    Args:
        given: what the user fixed, by options or config.
        aspect: height over width of the picture.
        by: what else was said.
        lit: parts of the picture's width and height that light is to cover.
        gaps: of the picture between its bright parts, see `Picture.gaps`.

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
        _put_in_the_middle(over, s, given, by)
    mag, margin = by.mag, default("margin") if by.margin is None else by.margin
    check("lens.size", lens["size"])
    check("screen.z", screen["z"])
    if "size" in screen:
        check("screen.size", screen["size"])
    if "size" in target:
        check("target.size", target["size"])
    check("target.flip", target["flip"])
    check("target.encoding", target["encoding"])
    _complete_source(s["source"], lens, [stage.get("source", "") for stage in s["design"].get("stages", [])])
    if over:
        _complete_over(over, s, given)
    counted = s["design"]["network"] != "none" and s["design"].get("preconditioner") == "laplacian"
    if (over or counted) and "initial" not in given.get("design", {}):
        s["design"]["initial"] = "zero-last"
    if "also" in s["source"]:
        s["source"]["also"] = [{**DEFAULTS["source"], **table} for table in s["source"]["also"]]
        for table in s["source"]["also"]:
            _complete_source(table, lens, [], "⟨source.also.type⟩")
    _complete_second(s)
    if "size" not in target or mag is not None:
        if mag is None and "size" in screen:
            fit = min(screen["size"][0], screen["size"][1] / aspect) / (1.0 + margin)
        else:
            fit = (mag or _first_magnification(s)) * lens["size"][0]
        target["size"] = [fit, fit * aspect]
    if "size" not in screen:
        screen["size"] = [(1.0 + margin) * x for x in target["size"]]
    if "resolution" not in screen:
        nx = by.resolution[0] if by.resolution else DEFAULT_RESOLUTION
        screen["resolution"] = [nx, max(2, round(nx * screen["size"][1] / screen["size"][0]))]
    _complete_farther(s)
    _complete_elements(s)
    build_screen(s)
    source = build_source(s)
    _complete_lens(lens, screen, target, source, sides=2 if "second" in s else 1)
    _complete_design(s, source, by.quality, by.rays, lit, gaps)
    return s


def _complete_source(source: dict[str, Any], lens: dict[str, Any], stages: list[str], where: str = "⟨source.type⟩") -> None:
    """What the types of source in use need and nobody said, without what none of them has: a plane wave has no intensity.

    `stages`: the types that stages name, "" for the source's own; they need their keys too.
    """
    types = [sources.type_of(source["type"], where)]
    types += [sources.type_of(type, "⟨design.stages.source⟩") for type in stages if type]
    for type in types:
        for key, value in type.defaults(lens).items():
            source.setdefault(key, value)
    for key in set(DEFAULTS["source"]).difference(sources.COMMON, *(type.keys for type in types)):
        source.pop(key)


def _put_in_the_middle(over: Ranges, s: Settings, given: Settings, by: Derivation) -> None:
    """The screen of a network that is trained over throws: at their middle, and nowhere else."""
    screen, z = s["screen"], over.middle[over.keys.index("throw")]
    z = -z if value_of(s["lens"], "lens.mirror") else z
    said = by.throw is not None or "z" in given.get("screen", {})
    if said and not math.isclose(screen["z"], z, rel_tol=1e-9):
        raise InputError(f"⟨screen.z⟩ must be the middle of ⟨design.over⟩ throw, {z:g} mm, or not be said, got {screen['z']:g} mm")
    screen["z"] = z


def _complete_over(over: Ranges, s: Settings, given: Settings) -> None:
    """What a network that is trained over ranges has beside them: its source at their middle, its outputs and its width."""
    source, design = s["source"], s["design"]
    middle = {key.removeprefix("source."): v for key, v in zip(over.keys, over.middle, strict=True) if key != "throw"}
    if middle:
        if source["type"] not in ("point", "grid") or len(source["position"]) != 1 or source.get("also"):
            key = next(iter(middle))
            raise InputError(f"⟨design.over⟩ source.{key} needs ⟨+source.type⟩ point, of one place, or grid, got {source['type']}")
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


def first_thickness(size: Sequence[float]) -> float:
    """Thickness that a lens is first solved with, mm, where none was said."""
    width = max(size)
    return width / 2.0 if width <= PLATE else WALL + width / 10.0


def _complete_lens(lens: dict[str, Any], screen: dict[str, Any], target: dict[str, Any], source: Source, sides: int) -> None:
    index, scale = index_of(lens), max(lens["size"]) / 10.0
    check("lens.index", index)
    if lens.get("gradient") == "free":
        _complete_blank(lens, screen, index)
    if "glass" not in lens:
        lens["index"] = index
    else:
        lens.setdefault("wavelength", default("lens.wavelength"))
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
        # Lenslets side by side throw their pictures onto one another, as a lens that gathers the light of their middles.
        across, along = (t / w if k == 1 else 0.0 for t, w, k in zip(target["size"], lens["size"], array, strict=True))
        vergence = 0.0
        if source.nearest < lens["z_in"]:  # divergence at the surface, 1/mm; 0 from infinity
            vergence = 1.0 / (lens["z_in"] - source.centre[2] + (lens["thickness"] - lens["z_in"]) / (1.0 if mirror else index))
        radius = Offset.for_magnification(
            (across, along), -1.0 if mirror else index, screen["z"], lens["thickness"], vergence
        ).radius
        least = STEEPEST * math.hypot(*lens["size"]) / 2.0  # what a long picture, or light from nearby, asks for may be more
        lens["radius"] = [math.copysign(max(abs(r), least), r) for r in radius]


def _first_magnification(s: Settings) -> float:
    """Of the picture, where nobody said it; where light goes on parallel or to a focus, a beam's as wide as the lens."""
    second = s.get("second", {})
    if "focus" in second:
        return abs(1.0 - s["screen"]["z"] / second["focus"][2])
    return 1.0 if second.get("collimate") else default("mag")


def _complete_second(s: Settings) -> None:
    """What makes the lens' entrance free-form; nothing at all where nobody said anything of it."""
    second = s.get("second", {})
    said = [key for key in ("file", "collimate", "focus") if second.get(key)]
    if not said:
        for key in ("z", "size"):
            if key in second:
                raise InputError(f"⟨second.{key}⟩ belongs to ⟨+second.file⟩, which is not given")
        s.pop("second", None)
        return
    if len(said) > 1:
        raise InputError(f"⟨second.{said[0]}⟩ and ⟨second.{said[1]}⟩ both say what light does behind the picture: give one of them")
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
            raise InputError(f"⟨{path}⟩ cannot be had with ⟨second.{said[0]}⟩, which needs two free-form sides of heights by lbfgs")
    if source.get("also") or source["type"] == "rays":
        raise InputError(f"⟨second.{said[0]}⟩ needs one source that is no ray file")


def _complete_farther(s: Settings) -> None:
    """Size of a second picture: that of a beam from the lens' edge through the first one's, farther on."""
    second = s.get("second", {})
    if "file" not in second:
        return
    check("second.z", second["z"])
    grown, size, lens = second["z"] / s["screen"]["z"], s["target"]["size"], s["lens"]["size"]
    second.setdefault("size", [max(0.1 * t, w + (t - w) * grown) for t, w in zip(size, lens, strict=True)])
    check("second.size", second["size"])


def _complete_elements(s: Settings) -> None:
    """Sizes of other lenses and mirrors, and what cannot be had with them."""
    tables, design = [dict(table) for table in elements_of(s)], s["design"]
    if not tables:
        s.pop("element", None)
        return
    s["element"] = {"list": tables}
    free = any(table.get("free", "none") != "none" for table in tables)
    refuse_beside(
        {
            "second.file": "second" in s,
            "design.robust": bool(design.get("robust")),
            "design.waves": design["waves"] == "on",
            "design.network": free and design["network"] != "none",
            "design.optimizer": free and design["optimizer"] != "lbfgs",
            "target.color": free and value_of(s["target"], "target.color"),
        },
    )
    lens, picture, throw = s["lens"]["size"], s["target"]["size"], abs(s["screen"]["z"])
    for table in tables:
        if "z" in table:
            along = min(1.0, max(0.0, check("element.z", table["z"]) / throw))
            size = [BEAM * (a + (b - a) * along) if along else a for a, b in zip(lens, picture, strict=True)]
            lean = [math.cos(math.radians(t)) for t in check("element.tilt", table.get("tilt", (0.0, 0.0)))]
            size = [w / c for w, c in zip(size, lean[::-1], strict=True)]
            table.setdefault("size", [max(size)] * 2 if table.get("aperture") == "circle" else size)


def _complete_blank(lens: Table, screen: Table, index: float) -> None:
    """What a flat blank has whose index is designed; its sides are the least net."""
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


def shape_words(s: Settings) -> str:
    """Which lens would follow the shape of a long picture, where this one does not."""
    (w, h), (a, b) = s["target"]["size"], s["lens"]["size"]
    if OBLONG > h * a / (w * b) > 1.0 / OBLONG:
        return ""
    width = math.sqrt(a * b * w / h)
    return (
        f"the picture is magnified {w / a:.3g} times along x and {h / b:.3g} times along y; a lens of its own shape needs less"
        f" depth: ⟨+lens.size⟩ {width:.3g}x{width * h / w:.3g}"
    )


def _complete_design(
    s: Settings, source: Source, quality: str | None, rays: int | None, lit: tuple[float, float], gaps: float
) -> None:
    lens, screen, design, given = s["lens"], s["screen"], s["design"], quality
    degree = check("lens.degree", lens["degree"])
    if "stages" in design and (given or rays):
        raise InputError(
            "⟨quality⟩ and ⟨rays⟩ shape the default stages, but the configuration brings [[design.stages]]"
            " of its own: change them there"
        )
    if lens.get("gradient") == "free":
        _complete_index_design(s, source, quality or _quality(design["time_limit"]), rays)
        return
    plain = design["network"] == "none" and design["optimizer"] == "lbfgs"
    asked = check("design.waves", design["waves"])
    array = value_of(lens, "lens.array")
    fine_net = "control" not in lens or min(n - p for n, p in zip(lens["control"], degree, strict=True)) >= LEAST_SPANS
    fine_net = fine_net or max(array) > 1  # whose lenslets have to be solved for
    spread = plain and fine_net and not source.sharp and not elements_of(s) and _shifts(s, source)
    counted = plain or (design["network"] != "none" and design.get("preconditioner") == "laplacian")  # from any first surface
    design.setdefault("start", "transport" if "second" in s or (counted and fine_net and not source.apart) else "offset")
    if design["start"] != "offset" and design["network"] != "none" and design.get("preconditioner") != "laplacian":
        raise InputError(
            f"⟨design.start⟩ {design['start']} gives a surface, which a network can begin from only with"
            " ⟨+design.preconditioner⟩ laplacian; use that, start offset, or network none"
        )
    if max(array) > 1 and (design["start"] == "offset" or not plain):
        raise InputError(
            "⟨lens.array⟩ needs ⟨start⟩ transport, which gives every lenslet its surface, or the lens of a file, network none and"
            " optimizer lbfgs"
        )
    if max(array) > 1 and design["start"] == "transport" and not source.distant:
        raise InputError(FROM_AFAR)
    quality = quality or _quality(design["time_limit"])
    if "second" in s:
        _complete_two_sided(s, source, quality, rays)
        return
    if any(table.get("free", "none") != "none" for table in elements_of(s)) and design["start"] != "transport":
        raise InputError(
            f"⟨design.start⟩ of several free surfaces must be transport, got {design['start']}; a small net or several points"
            " have no such start"
        )
    # Sharp light's transport is right at every scale at once, if the net can hold it, and so is that of a source that shifts the
    # image, for the light behind its blur; otherwise from coarse to fine.
    moved = plain and fine_net and design["start"] != "offset" and (source.sharp or spread or max(array) > 1)
    own = "control" in lens
    if not own:
        spans = refinement_spans(max(screen["resolution"]), quality) if moved else DEFAULT_SPANS
        of_network = [DEFAULT_SPANS + p for p in degree] if value_of(design, "design.over") else [NETWORK_CONTROL] * 2
        lens["control"] = [spans + p for p in degree] if design["network"] == "none" else of_network
        lens["control"] = _of_array(lens["control"], degree, array)
    elif (fits := _of_array(lens["control"], degree, array)) != list(lens["control"]):
        raise InputError(
            "⟨lens.control⟩ of an array must be lenslets times (spans + degree - 1) and one more along each axis, such as"
            f" {fits[0]} x {fits[1]}, got {lens['control'][0]} x {lens['control'][1]}"
        )
    design.setdefault("preconditioner", "laplacian" if plain else "none")
    if "stages" in design:
        design["stages"] = [_complete_stage(stage, s, _sampler(source)) for stage in design["stages"]]
        if asked != "auto" and any(stage.get("waves") for stage in design["stages"]) != (asked == "on"):
            raise InputError(
                f"⟨design.waves⟩ {asked} and the given [[design.stages]] contradict each other: "
                + ("none of them has waves, such as waves = [550.0]" if asked == "on" else "one of them has waves")
            )
        return
    nx, ny = screen["resolution"]
    sampler, base = _sampler(source), min(4_000_000, max(40_000, int(RAYS_PER_PIXEL * nx * ny)))
    waves = _wave_stages(s, source, quality, lit)
    if moved and elements_of(s):
        stages = two_sided(tuple(lens["control"]), rays, (nx, ny), quality)
    elif moved:
        centre = source.pointlike() if spread else source
        # Diffraction rounds creases by more than a fine net would.
        creased = gaps >= GAPS and not (own or waves or spread) and source.distant and max(array) == 1
        if creased:
            lens["control"] = [creased_control(max(nx, ny), p, quality) for p in degree]
        stages = refinement(tuple(lens["control"]), rays, (nx, ny), quality, not centre.collimated, spread, creased)
        if value_of(s["target"], "target.sheet"):
            stages = each_lenslet(stages, math.prod(array), (nx, ny))
    elif value_of(design, "design.over"):
        last = refinement(tuple(lens["control"]), rays or base, (nx, ny), quality)[-1]
        stages = [last | {"iterations": OVER_ITERATIONS, "tolerance": 0.0}]
    elif plain and "knots_u" not in lens:
        stages = coarse_to_fine(tuple(lens["control"]), degree, rays or base, (nx, ny), quality, sampler=sampler)
    else:
        stages = [
            on_rays(
                lens["control"],
                rays or base,
                sampler,
                apron=math.ceil(0.04 * max(nx, ny)),
                iterations=default("design.stages.iterations"),
                tolerance=2e-3 if plain else 0.0,
            )
        ]
    stages += waves
    if design["loss"].strip() == "rms":  # eq. 5.2.1 knows the screen alone
        stages = [stage | {"apron": 0} for stage in stages]
    design["stages"] = stages


def _complete_two_sided(s: Settings, source: Source, quality: str, rays: int | None) -> None:
    """How a lens with two free-form sides is designed."""
    lens, screen, design = s["lens"], s["screen"], s["design"]
    if design["start"] != "transport":
        raise InputError(f"⟨design.start⟩ of two free-form sides must be transport, got {design['start']}")
    if design["waves"] == "on":
        raise InputError("⟨design.waves⟩ on: two free-form sides are refined by rays alone")
    if "control" not in lens:
        lens["control"] = [min(TWO_SIDED_SPANS, refinement_spans(max(screen["resolution"]), quality)) + p for p in lens["degree"]]
    design.setdefault("preconditioner", "laplacian")
    if "stages" not in design:
        design["stages"] = two_sided(tuple(lens["control"]), rays, tuple(screen["resolution"]), quality)
        return
    design["stages"] = [_complete_stage(stage, s, _sampler(source)) for stage in design["stages"]]
    if any(stage.get(key) for stage in design["stages"] for key in ("waves", "spread")):
        raise InputError("[[design.stages]] of two free-form sides are on the rays of the whole source, without waves or spread")


def _of_array(control: Sequence[int], degree: Sequence[int], array: Sequence[int]) -> list[int]:
    """The least control points, so many or more, that an array of lenslets can have; of one lens, these."""
    return [array_control(n, p, k) if k > 1 else n for n, p, k in zip(control, degree, array, strict=True)]


def _complete_index_design(s: Settings, source: Source, quality: str, rays: int | None) -> None:
    """How a free gradient is found: L-BFGS from transport, on rays."""
    lens, screen, design = s["lens"], s["screen"], s["design"]
    if not source.collimated:
        raise InputError(f"⟨lens.gradient⟩ free is designed for light of ⟨source.type⟩ plane, got {s['source']['type']}")
    if max(value_of(lens, "lens.array")) > 1:
        raise InputError("⟨lens.array⟩ cannot be had with a free gradient, whose sides are flat")
    if value_of(s["target"], "target.color"):
        raise InputError("⟨target.color⟩ is not for a free gradient, whose index is designed at one wavelength")
    for key, only in (("network", "none"), ("optimizer", "lbfgs"), ("loss", default("design.loss"))):
        if design[key] != only:
            raise InputError(f"⟨design.{key}⟩ of a free gradient must be {only}, got {design[key]}")
    if check("design.waves", design["waves"]) == "on":
        raise InputError("⟨design.waves⟩ on needs a lens of one index, of which the wave image is taken")
    design["start"] = "offset"
    design.setdefault("preconditioner", "laplacian")
    if "stages" not in design:
        last = refinement(tuple(lens["control"]), rays, tuple(screen["resolution"]), quality)[-1]
        design["stages"] = [last | {"rays": rays or min(last["rays"], RAYS_BENT * math.prod(screen["resolution"]))}]


def without_waves(s: Settings, given: bool) -> str:
    """Why `waves = "auto"` leaves the wave image out of complete settings although diffraction matters, and what puts it in.

    given: whether the stages are the user's own.
    """
    design = s["design"]
    if any(stage.get("waves") for stage in design["stages"]):
        return ""
    if given:
        return "none of the given [[design.stages]] has waves; one with waves = [550.0] refines it at that wavelength"
    if (seen := _resolution(s, build_source(s))).source > seen.pixel:
        return "that of a source whose blur is wider than a pixel takes many times as long; ⟨waves⟩ on refines it all the same"
    return _not_by_default(s) or f"{LEAST_WAVES} iterations on it would take longer than this quality's time; ⟨waves⟩ on takes it"


def _not_by_default(s: Settings) -> str:
    """What `waves = "auto"` does not refine the wave image with, however long that takes, and what puts it in."""
    design = s["design"]
    if "gradient" in s["lens"]:
        return "the wave image is taken of lenses of one index"
    if elements_of(s):
        return "the wave image is taken of a lens by itself"
    if s["source"]["type"] == "rays":
        return "a ray file says nothing of its light's phase"
    if s["source"].get("also"):
        return "light of several sources is refined by rays alone"
    if design["network"] != "none":
        return "a network is trained on rays alone; ⟨network⟩ none refines it"
    if design["optimizer"] != "lbfgs":
        return f"{design['optimizer']} was asked for, and the wave image takes lbfgs; ⟨waves⟩ on adds stages that use it"
    if build_screen(s).curved:
        return "a curved screen has no wave image"
    if max(value_of(s["lens"], "lens.array")) > 1:
        return "light of lenslets side by side interferes in fine fringes, which rays alone pass over; ⟨waves⟩ on refines it"
    if any(s["screen"].get("tilt", ())):
        return "on a tilted screen it takes many transforms for each wavelength; ⟨waves⟩ on refines it all the same"
    return ""


def _wave_stages(s: Settings, source: Source, quality: str, lit: tuple[float, float]) -> list[Table]:
    """What refines the wave image after the ray image, where that is asked for or called for."""
    design, lens, screen, asked = s["design"], s["lens"], s["screen"], s["design"]["waves"]
    if asked == "on" and design["network"] != "none":
        raise InputError("⟨design.waves⟩ on needs network none: the wave image refines the heights themselves")
    if asked == "on" and "gradient" in lens:
        raise InputError("⟨design.waves⟩ on needs a lens of one index, of which the wave image is taken")
    if asked == "on" and source.rays is not None:
        raise InputError("⟨design.waves⟩ on: a ray file says nothing of its light's phase, so that it has no wave image to refine")
    if asked == "on" and build_screen(s).curved:
        raise InputError("⟨design.waves⟩ on needs a plane screen: a curved one has no wave image to refine")
    if asked == "on" and len(source.members) > 1:
        raise InputError("⟨design.waves⟩ on needs one source: light of several is refined by rays alone")
    if asked == "off" or (asked == "auto" and _not_by_default(s)):
        return []
    seen = _resolution(s, source)
    if asked == "auto" and (seen.source > seen.pixel or not seen.matters):
        return []
    own = s["source"].get("wavelengths", [])
    plan = wave_refinement(_wave_samples(s, seen, lit), len(own), quality, hurry=asked == "auto")
    apron = math.ceil(0.04 * max(screen["resolution"]))
    return [on_waves(lens["control"], list(map(float, own)) or white(count), apron, n) for count, n in plan]


def _resolution(s: Settings, source: Source) -> Resolution:
    """What complete settings let light show."""
    return Resolution.before(Scene(source, build_lens(s), build_screen(s), build_light(s)), tuple(s["target"]["size"]))


def _wave_samples(s: Settings, seen: Resolution, lit: tuple[float, float]) -> float:
    """About how many samples the field of one wavelength needs: the bright part and its blur on each side, times the lens."""
    throw, shortest = abs(s["screen"]["z"]), min(s["source"].get("wavelengths", []) or BAND[:1]) * 1e-6
    return math.prod(
        w * (part * t + 4.0 * seen.diffraction) / (shortest * throw)
        for w, t, part in zip(s["lens"]["size"], s["target"]["size"], lit, strict=True)
    )


def _quality(time_limit: float) -> str:
    """What a time limit leaves room for at 250 x 250 pixels on two cores."""
    return "draft" if time_limit < DRAFT_SECONDS else "fine" if FINE_SECONDS <= time_limit < math.inf else "standard"


def _sampler(source: Source) -> str:
    """A tensor product of rays makes a plane wave cheap; others are intersected one by one."""
    return "lines" if source.collimated else "stratified"


def _shifts(s: Settings, source: Source) -> bool:
    """Whether all that a source's extent does is to shift the image."""
    lens = build_lens({**s, "lens": {"control": [LEAST_SPANS] * 2, **s["lens"]}})
    return shift_of(Scene(source, lens, build_screen(s), build_light(s))) is not None


def _complete_stage(table: dict[str, Any], s: Settings, sampler: str) -> dict[str, Any]:
    base = _stage_base(s, sampler)
    return {**({k: base[k] for k in WAVE_KEYS} if table.get("waves") else base), **table}


def _stage_base(s: Settings, sampler: str) -> Table:
    """What a stage of the user's own says where it says nothing."""
    nx, ny = s["screen"]["resolution"]
    return on_rays(
        s["lens"]["control"],
        int(RAYS_PER_PIXEL * nx * ny),
        sampler,
        iterations=default("design.stages.iterations"),
        tolerance=default("design.stages.tolerance"),
    )


def filter_from(kind: str, size, screen: Screen, per_mm2: float | None = None, per_pixel2: float | None = None) -> Filter:
    """A reconstruction filter; the Gaussian's alpha in 1/mm^2 or 1/pixel^2 (default 1 per pixel^2)."""
    if per_mm2 is not None and per_pixel2 is not None:
        raise InputError("alpha_per_mm2 and alpha_per_pixel2 say the same thing twice: give one of them")
    if kind == "bincount":
        size = (1, 1)
    alpha = (0.0, 0.0)
    if kind == "gaussian":
        if per_mm2 is not None:
            alpha = per_mm2 * screen.pixel[0] * screen.pixel[0], per_mm2 * screen.pixel[1] * screen.pixel[1]
        else:
            alpha = (1.0 if per_pixel2 is None else per_pixel2,) * 2
    return Filter(kind, tuple(size), alpha)


def build_stages(settings: Settings) -> list[Stage]:
    """The stages of complete settings.

    Raises:
        InputError: there are none, a value is out of range, or the last stage is not on the lens' own control net.
    """
    stages = [stage_of(table, settings) for table in settings["design"].get("stages", [])]
    if not stages:
        raise InputError("[[design.stages]] at least one stage is needed")
    if list(stages[-1].control) != list(settings["lens"]["control"]):
        raise InputError(
            f"[[design.stages]] the last stage's control {list(stages[-1].control)} must be the lens' own,"
            f" {settings['lens']['control']}"
        )
    return stages


def stage_of(table: Table, settings: Settings) -> Stage:
    """The stage that a table of complete settings describes."""
    t = _stage_base(settings, "grid") | table
    filter = filter_from(
        t["reconstruction"], t["filter_size"], build_screen(settings), t.get("alpha_per_mm2"), t.get("alpha_per_pixel2")
    )
    source = build_source(settings, type=t["source"]) if "source" in t else None
    return Stage(
        tuple(t["control"]),
        t["rays"],
        t["sampler"],
        filter,
        t["blur"],
        t["apron"],
        t["iterations"],
        t["tolerance"],
        source,
        t["oversample"],
        tuple(t.get("waves", ())),
        value_of(t, "design.stages.spread"),
        value_of(t, "design.stages.lenslets"),
    )


def build_options(settings: Settings) -> Options:
    """The design options of complete settings."""
    d = settings["design"]
    for key in ("dtype", "seed", "iterations"):
        check(f"design.{key}", d[key])
    for key in ("time_limit", "checkpoint_every"):  # which may be without end
        if not d[key] > 0:
            raise InputError(f"⟨design.{key}⟩ must be greater than 0 s, got {d[key]:g}")
    return Options(
        d["loss"],
        d["optimizer"],
        d["lr"],
        d["network"],
        d["initial"],
        d["preconditioner"],
        d["filter_target"],
        d["seed"],
        getattr(torch, d["dtype"]),
        d["max_slope"],
        d["min_radius"],
        d["waves"] == "on",
        content(d, "robust", Tolerances),
        Architecture(*(value_of(d, f"design.{key}") for key in ("network_layers", "network_width", "activation"))),
        Ranges.parse(value_of(d, "design.over")),
    )
