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
import torch

from caustic_cli.config.default_stages import (
    GAPS,
    LEAST_SPANS,
    LEAST_WAVES,
    RAYS_PER_PIXEL,
    Table,
    coarse_to_fine,
    completed_stage,
    creased_control,
    each_lenslet,
    on_rays,
    on_waves,
    refinement,
    refinement_spans,
    stage_base,
    two_sided,
    usual_sampler,
    wave_refinement,
)
from caustic_cli.config.optional import (
    centre_screen,
    complete_blank,
    complete_elements,
    complete_index_design,
    complete_over,
    complete_second,
    complete_second_size,
    complete_two_sided,
    default_magnification,
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
from caustic_cli.inverse.designer import Options
from caustic_cli.inverse.lenslets import NEEDS_DISTANT_SOURCE
from caustic_cli.inverse.parametrisation import Architecture
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.inverse.schedule import Stage
from caustic_cli.inverse.source_limits import source_spread
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.resolution import BAND, Resolution, white
from caustic_cli.scene import Offset, Scene, Screen, Source, sources
from caustic_cli.scene.lens import array_control
from caustic_cli.scene.light import RGB
from caustic_cli.scene.sources.section import content
from caustic_cli.scene.tolerances import Tolerances

DEFAULT_RESOLUTION = 250
DEFAULT_SPANS = 128  # knot spans of the final net; divisible by 2 through the stages
NETWORK_CONTROL = 50  # table D.2
OVER_ITERATIONS = 200  # for a network over a range: caustic convergence, study design, networks
DRAFT_SECONDS, FINE_SECONDS = 8.0, 60.0  # time limits below and above which another quality uses the time better
EXTENDED = 5.0  # factor of these limits for an extended source, whose start includes a deconvolution
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
    if (over or _relative_to_initial(s["design"])) and "initial" not in given.get("design", {}):
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
    _complete_design(s, source, by.quality, by.rays, lit, gaps)
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
        complete_index_design(s, source, quality or _quality(design["time_limit"], source), rays)
        return
    plain = design["network"] == "none" and design["optimizer"] == "lbfgs"
    asked = check("design.waves", design["waves"])
    array = value_of(lens, "lens.array")
    fine_net = "control" not in lens or min(n - p for n, p in zip(lens["control"], degree, strict=True)) >= LEAST_SPANS
    fine_net = fine_net or max(array) > 1  # lenslets need a transport start
    spread = plain and fine_net and not source.sharp and not elements_of(s) and _shifts(s, source)
    shaped = (plain or _relative_to_initial(design)) and fine_net and not source.apart
    design.setdefault("start", "transport" if "second" in s or shaped else "offset")
    if design["start"] != "offset" and design["network"] != "none" and not _relative_to_initial(design):
        raise InputError(
            f"⟨design.start⟩ {design['start']} gives a surface, from which a network can start only with"
            " ⟨+design.preconditioner⟩ laplacian; use that, start offset, or network none"
        )
    if max(array) > 1 and (design["start"] == "offset" or not plain):
        raise InputError(
            "⟨lens.array⟩ needs ⟨start⟩ transport, which gives every lenslet its surface, or the lens of a file, network none and"
            " optimizer lbfgs"
        )
    if max(array) > 1 and design["start"] == "transport" and not source.distant:
        raise InputError(NEEDS_DISTANT_SOURCE)
    quality = quality or _quality(design["time_limit"], source)
    if "second" in s:
        complete_two_sided(s, source, quality, rays)
        return
    if any(table.get("free", "none") != "none" for table in elements_of(s)) and design["start"] != "transport":
        raise InputError(
            f"⟨design.start⟩ of several free surfaces must be transport, got {design['start']}; a small net or several points"
            " have no such start"
        )
    # A transport start is accurate at every scale for a point source or plane wave, if the net resolves it, and for an extended
    # source that shifts the image, apart from its blur; otherwise the stages are coarse to fine.
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
        design["stages"] = [completed_stage(stage, s, usual_sampler(source)) for stage in design["stages"]]
        if asked != "auto" and any(stage.get("waves") for stage in design["stages"]) != (asked == "on"):
            raise InputError(
                f"⟨design.waves⟩ {asked} and the given [[design.stages]] contradict each other: "
                + ("none of them has waves, such as waves = [550.0]" if asked == "on" else "one of them has waves")
            )
        return
    nx, ny = screen["resolution"]
    sampler, base = usual_sampler(source), min(4_000_000, max(40_000, int(RAYS_PER_PIXEL * nx * ny)))
    waves = _wave_stages(s, source, quality, lit)
    if moved and elements_of(s):
        stages = two_sided(tuple(lens["control"]), rays, (nx, ny), quality)
    elif moved:
        centre = source.pointlike() if spread else source
        # Diffraction smooths creases more than a coarser net, and the pixels of a tilted screen do not coincide with those that the
        # map is solved for, which shows as lines: a flame at 30 degrees has an error of 0.205 on the finer net and 0.087 without.
        aligned = source.distant and build_screen(s).upright
        creased = gaps >= GAPS and not (own or waves or spread) and aligned and max(array) == 1
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
    if design["loss"].strip() == "rms":  # eq. 5.2.1 is defined on the screen only
        stages = [stage | {"apron": 0} for stage in stages]
    design["stages"] = stages


def _relative_to_initial(design: dict[str, Any]) -> bool:
    """Whether the design uses a network whose outputs are relative to an initial surface."""
    return design["network"] != "none" and design.get("preconditioner") == "laplacian"


def _of_array(control: Sequence[int], degree: Sequence[int], array: Sequence[int]) -> list[int]:
    """The least admissible numbers of control points of a lenslet array, at least `control`; unchanged for a single lens."""
    return [array_control(n, p, k) if k > 1 else n for n, p, k in zip(control, degree, array, strict=True)]


def without_waves(s: Settings, given: bool) -> str:
    """Why `waves = "auto"` omits the wave image from complete settings although diffraction matters, and how to include it.

    given: whether the stages are user-defined.
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
    """The feature for which `waves = "auto"` never refines the wave image, and how to include it; "" if there is none."""
    design = s["design"]
    if "gradient" in s["lens"]:
        return "wave images are implemented for homogeneous lenses only"
    if elements_of(s):
        return "wave images are implemented for a single lens only"
    if s["source"]["type"] == "rays":
        return "a ray file contains no phase"
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
    """Stages that refine the wave image after the ray image, on request or where diffraction matters."""
    design, lens, screen, asked = s["design"], s["lens"], s["screen"], s["design"]["waves"]
    if asked == "on" and design["network"] != "none":
        raise InputError("⟨design.waves⟩ on needs network none: the wave image is refined by control heights")
    if asked == "on" and "gradient" in lens:
        raise InputError("⟨design.waves⟩ on needs a homogeneous lens: with a gradient index there is no wave image")
    if asked == "on" and source.rays is not None:
        raise InputError("⟨design.waves⟩ on: a ray file contains no phase, so that it has no wave image to refine")
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
    plan = wave_refinement(_wave_samples(s, seen, lit), len(own), quality, timed=asked == "auto")
    apron = math.ceil(0.04 * max(screen["resolution"]))
    return [on_waves(lens["control"], list(map(float, own)) or white(count), apron, n) for count, n in plan]


def _resolution(s: Settings, source: Source) -> Resolution:
    """The resolution limit of complete settings."""
    return Resolution.before(Scene(source, build_lens(s), build_screen(s), build_light(s)), tuple(s["target"]["size"]))


def _wave_samples(s: Settings, seen: Resolution, lit: tuple[float, float]) -> float:
    """Estimated number of samples of the field at one wavelength: space-bandwidth product of the lens and the blurred bright
    region."""
    throw, shortest = abs(s["screen"]["z"]), min(s["source"].get("wavelengths", []) or BAND[:1]) * 1e-6
    return math.prod(
        w * (part * t + 4.0 * seen.diffraction) / (shortest * throw)
        for w, t, part in zip(s["lens"]["size"], s["target"]["size"], lit, strict=True)
    )


def _quality(time_limit: float, source: Source) -> str:
    """The quality that a time limit permits at 250 x 250 pixels on two cores."""
    seconds = time_limit / (EXTENDED if source.extended else 1.0)
    return "draft" if seconds < DRAFT_SECONDS else "fine" if FINE_SECONDS <= seconds < math.inf else "standard"


def _shifts(s: Settings, source: Source) -> bool:
    """Whether the source's extent only shifts the image."""
    lens = build_lens({**s, "lens": {"control": [LEAST_SPANS] * 2, **s["lens"]}})
    return source_spread(Scene(source, lens, build_screen(s), build_light(s))) is not None


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
        InputError: there are none, a value is out of range, or the last stage does not use the lens' control net.
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
    """The stage of a table of complete settings."""
    t = stage_base(settings, "grid") | table
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
    for key in ("time_limit", "checkpoint_every"):  # which may be infinite
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
