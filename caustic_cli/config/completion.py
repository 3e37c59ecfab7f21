"""Completion of settings: a complete project from a picture and the user's settings.

Screen, picture and base surface follow from the magnification, the stages from control net, rays and pixels.  Optional features are
completed in `optional`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
    complete_blank,
    complete_elements,
    complete_index_design,
    complete_network,
    complete_second,
    complete_second_size,
    complete_two_sided,
    default_magnification,
    middle_distance,
    middle_source,
)
from caustic_cli.config.settings import (
    Given,
    Settings,
    build_lens,
    build_light,
    build_screen,
    build_source,
    elements_of,
    index_of,
    tables_of,
    value_of,
)
from caustic_cli.config.table import (
    DesignSettings,
    LensSettings,
    Parameters,
    ScreenSettings,
    SourceSettings,
    StageSettings,
    TargetSettings,
    check,
    check_all,
    default,
)
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


def complete(
    given: Given, aspect: float, by: Parameters | None = None, lit: tuple[float, float] = (1.0, 1.0), gaps: float = 0.0
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
    s, by = Settings.of(given), by or Parameters()
    if s.target.sheet:
        aspect, lit = _aspect_of_a_sheet(s, aspect), (1.0, 1.0)
    s = _in_colour(s) if s.target.color else s
    over = Ranges.parse(s.design.over)
    s = s.changed(screen=_placed(s, by, aspect, "z" in given.get("screen", {}), over))
    check("target.flip", s.target.flip)
    check("target.encoding", s.target.encoding)
    s = s.changed(source=complete_source(s.source, s.lens, [stage.get("source", "") for stage in s.design.stages]))
    if over:
        at = middle_source(over, s.source, "position" in given.get("source", {}))
        s = s.changed(source=at, design=complete_network(s.design))
    if over or _relative_to_initial(s.design):
        s = s.changed(design=s.design if "initial" in given.get("design", {}) else s.design.changed(initial="zero-last"))
    s = s.changed(second=complete_second(s))
    s = s.changed(target=complete_target(s, by, aspect))
    s = s.changed(screen=complete_screen(s.screen, s.target, by))
    s = s.changed(second=complete_second_size(s))
    s = s.changed(elements=complete_elements(s))
    build_screen(s.screen)
    source = build_source(s.source)
    s = s.changed(lens=complete_lens(s, source))
    return _complete_design(s, source, by.quality, by.rays, lit, gaps)


def _aspect_of_a_sheet(s: Settings, aspect: float) -> float:
    """Height over width of each picture of a contact sheet."""
    array = check("lens.array", s.lens.array)
    if max(array) == 1 or s.target.color:
        raise InputError("⟨target.sheet⟩ needs ⟨+lens.array⟩, and a picture without colours")
    return aspect * array[0] / array[1]


def _in_colour(s: Settings) -> Settings:
    """Settings with the wavelengths of a coloured picture, and a glass whose dispersion is known."""
    if s.source.also:
        raise InputError("[[source]] of a coloured picture must be one, whose three wavelengths are its colours")
    lens = s.lens if "index" in s.lens else s.lens.filled(glass=COLOR_GLASS)
    return s.changed(source=s.source.filled(wavelengths=RGB), lens=lens)


def _placed(s: Settings, by: Parameters, aspect: float, placed: bool, over: Ranges | None) -> ScreenSettings:
    """The screen at its distance, with the size and the pixels that are given; placed: whether its distance is given as such."""
    screen, side = s.screen, -1.0 if s.lens.mirror else 1.0
    if by.throw is not None:
        screen = screen.changed(z=side * by.throw)
    elif not placed:
        screen = screen.changed(z=side * screen.z)
    if by.screen_size is not None:
        width = by.screen_size[0]
        screen = screen.changed(size=(width, by.screen_size[1] if len(by.screen_size) == 2 else width * aspect))
    if by.resolution is not None:
        screen = screen.without("resolution")
        if len(by.resolution) == 2:
            screen = screen.changed(resolution=by.resolution)
    if over and "throw" in over.keys:
        screen = screen.changed(z=middle_distance(over, screen.z, side, by.throw is not None or placed))
    check("lens.size", s.lens.size)
    if check("screen.z", screen.z) == 0:
        raise InputError("⟨screen.z⟩ must lie behind the lens, or before a mirror, got 0 mm")
    for section in (screen, s.target):
        if "size" in section:
            check(f"{section.section}.size", section["size"])
    return screen


def complete_source(
    source: SourceSettings, lens: LensSettings, stages: Sequence[str] = (), where: str = "⟨source.type⟩"
) -> SourceSettings:
    """The section with the keys of the source types in use, and without defaults that none of them uses.

    stages: the source types of the stages, "" for the source's own; their keys are needed, too.
    """
    if "also" in source:
        source = source.changed(also=[complete_source(table, lens, where="⟨source.also.type⟩") for table in source.also])
    types = [sources.type_of(source.type, where)]
    types += [sources.type_of(type, "⟨design.stages.source⟩") for type in stages if type]
    for type in types:
        source = source.filled(**type.defaults(lens))
    return source.without(*{*SourceSettings.of({})}.difference(sources.COMMON, *(type.keys for type in types)))


def complete_target(s: Settings, by: Parameters, aspect: float) -> TargetSettings:
    """The target with its size on the screen."""
    if "size" in s.target and "mag" not in by:
        return s.target
    if "size" in s.screen and "mag" not in by:
        width = min(s.screen.size[0], s.screen.size[1] / aspect) / (1.0 + by.margin)
    else:
        width = (by.mag if "mag" in by else default_magnification(s)) * s.lens.size[0]
    return s.target.changed(size=(width, width * aspect))


def complete_screen(screen: ScreenSettings, target: TargetSettings, by: Parameters) -> ScreenSettings:
    """The screen with its size, of the picture and a margin, and its pixels."""
    screen = screen.filled(size=[(1.0 + by.margin) * x for x in target.size])
    across = by.resolution[0] if by.resolution else DEFAULT_RESOLUTION
    return screen.filled(resolution=(across, max(2, round(across * screen.size[1] / screen.size[0]))))


def first_thickness(size: Sequence[float]) -> float:
    """Default thickness of a lens, mm."""
    width = max(size)
    return width / 2.0 if width <= PLATE else WALL + width / 10.0


def complete_lens(s: Settings, source: Source) -> LensSettings:
    """The lens with its base surface, which spreads the light over the picture, and room for the heights."""
    index, scale, sides = index_of(s.lens), max(s.lens.size) / 10.0, 1 if s.second is None else 2
    check("lens.index", index)
    lens = complete_blank(s.lens, s.screen, index) if s.lens.gradient == "free" else s.lens
    lens = lens.filled(index=index) if lens.glass is None else lens.filled(wavelength=lens.wavelength)
    free = "thickness" not in lens
    lens = lens.filled(thickness=THICK * max(lens.size) if sides == 2 else first_thickness(lens.size))
    lens = lens.filled(height_range=(-scale, scale) if sides == 1 else [c * SAG * lens.thickness for c in (-1.0, 1.0)])
    if sides == 2:
        lens = lens.filled(radius=(math.inf, math.inf))
    array, z = check("lens.array", lens.array), s.screen.z
    lowest, highest = (lens.thickness + height for height in lens.height_range)
    if lens.mirror and z >= lowest:
        raise InputError(f"⟨screen.z⟩ must lie before the mirror, which begins at {lowest:.4g} mm, got {z:g} mm")
    if not lens.mirror and z <= highest:
        raise InputError(f"⟨screen.z⟩ must lie behind the lens, which is up to {highest:.4g} mm thick, got {z:g} mm")
    if "radius" not in lens:
        # The pictures of lenslets are superimposed: the light through their centres converges like that of a focusing lens.
        across, along = (t / w if k == 1 else 0.0 for t, w, k in zip(s.target.size, lens.size, array, strict=True))
        vergence = 0.0
        if source.nearest < lens.z_in:  # vergence at the surface, 1/mm; 0 for a source at infinity
            vergence = 1.0 / (lens.z_in - source.centre[2] + (lens.thickness - lens.z_in) / (1.0 if lens.mirror else index))
        radius = Offset.for_magnification((across, along), -1.0 if lens.mirror else index, z, lens.thickness, vergence).radius
        least = STEEPEST * math.hypot(*lens.size) / 2.0  # an oblong picture or a near source may ask for a smaller radius
        lens = lens.changed(radius=[math.copysign(max(abs(r), least), r) for r in radius])
    return lens.changed(thickness=lens.thickness + _missing_room(lens)) if free and sides == 1 else lens


def _missing_room(lens: LensSettings) -> float:
    """Increase of the thickness, mm, with which the base surface keeps the least thickness; 0 if the heights have room already.

    A strongly converging lens, for a close source for instance, is thinnest at its corners.
    """
    x, y = (np.array([0.0, width / 2.0]) for width in lens.size)
    lowest = lens.thickness + float(Offset(0.0, lens.radius).sag(x[:, None], y[None, :]).min())
    short = lens.z_in + lens.min_thickness - lowest
    return short if short >= lens.height_range[1] else 0.0


def shape_words(s: Settings) -> str:
    """A recommendation of a lens shape for an oblong picture; "" if the magnifications are similar."""
    (w, h), (a, b) = s.target.size, s.lens.size
    if OBLONG > h * a / (w * b) > 1.0 / OBLONG:
        return ""
    width = math.sqrt(a * b * w / h)
    return (
        f"the picture is magnified {w / a:.3g} times along x and {h / b:.3g} times along y; a lens of its own shape needs less"
        f" depth: ⟨+lens.size⟩ {width:.3g}x{width * h / w:.3g}"
    )


def _complete_design(
    full: Settings, source: Source, quality: str | None, rays: int | None, lit: tuple[float, float], gaps: float
) -> Settings:
    s = tables_of(full)
    _complete_tables(s, source, quality, rays, lit, gaps)
    design = s["design"] | {"stages": [StageSettings(stage) for stage in s["design"]["stages"]]}
    return full.changed(lens=LensSettings(s["lens"]), design=DesignSettings(design))


def _complete_tables(
    s: Given, source: Source, quality: str | None, rays: int | None, lit: tuple[float, float], gaps: float
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
        aligned = source.distant and build_screen(Settings.of(s).screen).upright
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


def _relative_to_initial(design: Mapping[str, Any]) -> bool:
    """Whether the design uses a network whose outputs are relative to an initial surface."""
    return design["network"] != "none" and design.get("preconditioner") == "laplacian"


def _of_array(control: Sequence[int], degree: Sequence[int], array: Sequence[int]) -> list[int]:
    """The least admissible numbers of control points of a lenslet array, at least `control`; unchanged for a single lens."""
    return [array_control(n, p, k) if k > 1 else n for n, p, k in zip(control, degree, array, strict=True)]


def without_waves(full: Settings, given: bool) -> str:
    """Why `waves = "auto"` omits the wave image from complete settings although diffraction matters, and how to include it.

    given: whether the stages are user-defined.
    """
    s = tables_of(full)
    if any(stage.waves for stage in full.design.stages):
        return ""
    if given:
        return "none of the given [[design.stages]] has waves; one with waves = [550.0] refines it at that wavelength"
    if (seen := _resolution(s, build_source(full.source))).source > seen.pixel:
        return "that of a source whose blur is wider than a pixel takes many times as long; ⟨waves⟩ on refines it all the same"
    return _not_by_default(s) or f"{LEAST_WAVES} iterations on it would take longer than this quality's time; ⟨waves⟩ on takes it"


def _not_by_default(s: Given) -> str:
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
    if build_screen(Settings.of(s).screen).curved:
        return "a curved screen has no wave image"
    if max(value_of(s["lens"], "lens.array")) > 1:
        return "light of lenslets side by side interferes in fine fringes, which rays alone pass over; ⟨waves⟩ on refines it"
    if any(s["screen"].get("tilt", ())):
        return "on a tilted screen it takes many transforms for each wavelength; ⟨waves⟩ on refines it all the same"
    return ""


def _wave_stages(s: Given, source: Source, quality: str, lit: tuple[float, float]) -> list[Table]:
    """Stages that refine the wave image after the ray image, on request or where diffraction matters."""
    design, lens, screen, asked = s["design"], s["lens"], s["screen"], s["design"]["waves"]
    if asked == "on" and design["network"] != "none":
        raise InputError("⟨design.waves⟩ on needs network none: the wave image is refined by control heights")
    if asked == "on" and "gradient" in lens:
        raise InputError("⟨design.waves⟩ on needs a homogeneous lens: with a gradient index there is no wave image")
    if asked == "on" and source.rays is not None:
        raise InputError("⟨design.waves⟩ on: a ray file contains no phase, so that it has no wave image to refine")
    if asked == "on" and build_screen(Settings.of(s).screen).curved:
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


def _resolution(s: Given, source: Source) -> Resolution:
    """The resolution limit of complete settings."""
    full = Settings.of(s)
    scene = Scene(source, build_lens(full.lens), build_screen(full.screen), build_light(full))
    return Resolution.before(scene, full.target.size)


def _wave_samples(s: Given, seen: Resolution, lit: tuple[float, float]) -> float:
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


def _shifts(s: Given, source: Source) -> bool:
    """Whether the source's extent only shifts the image."""
    full = Settings.of(s)
    lens = build_lens(full.lens.filled(control=[LEAST_SPANS] * 2))
    return source_spread(Scene(source, lens, build_screen(full.screen), build_light(full))) is not None


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
    stages = [stage_of(table, settings) for table in settings.design.stages]
    if not stages:
        raise InputError("[[design.stages]] at least one stage is needed")
    if stages[-1].control != settings.lens.control:
        raise InputError(
            f"[[design.stages]] the last stage's control {list(stages[-1].control)} must be the lens' own,"
            f" {list(settings.lens.control)}"
        )
    return stages


def stage_of(table: Mapping[str, Any], settings: Settings) -> Stage:
    """The stage of a table of complete settings."""
    t = StageSettings(stage_base(tables_of(settings), "grid"), table)
    filter = filter_from(t.reconstruction, t.filter_size, build_screen(settings.screen), t.alpha_per_mm2, t.alpha_per_pixel2)
    return Stage(
        t.control,
        t.rays,
        t.sampler,
        filter,
        t.blur,
        t.apron,
        t.iterations,
        t.tolerance,
        None if t.source is None else build_source(settings.source, type=t.source),
        t.oversample,
        t.waves or (),
        t.spread,
        t.lenslets,
    )


def build_options(settings: Settings) -> Options:
    """The design options of complete settings."""
    d = settings.design
    check_all("design", d, "dtype", "seed", "iterations")
    for key in ("time_limit", "checkpoint_every"):  # which may be infinite
        if not d[key] > 0:
            raise InputError(f"⟨design.{key}⟩ must be greater than 0 s, got {d[key]:g}")
    return Options(
        d.loss,
        d.optimizer,
        d.lr,
        d.network,
        d.initial,
        d.preconditioner,
        d.filter_target,
        d.seed,
        getattr(torch, d.dtype),
        d.max_slope,
        d.min_radius,
        d.waves == "on",
        content(d, "robust", Tolerances),
        Architecture(d.network_layers, d.network_width, d.activation),
        Ranges.parse(d.over),
    )
