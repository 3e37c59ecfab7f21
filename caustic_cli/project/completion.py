"""Completion of settings: a complete project from a picture and the user's settings.

Screen, picture and base surface follow from the magnification, the stages from control net, rays and pixels.  Optional features are
completed in `optional`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caustic_cli.config.design import relative_to_initial
from caustic_cli.config.exclusions import refuse_contradictions
from caustic_cli.config.lamp import complete_lamp
from caustic_cli.config.optional import (
    complete_elements,
    complete_network,
    complete_second,
    complete_second_size,
    complete_sunlight,
    default_magnification,
    lit_by_sun,
    middle_distance,
    middle_source,
    stand,
)
from caustic_cli.config.settings import Given, Settings, build_base, build_screen, build_source, index_of
from caustic_cli.errors import InputError
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.kinds import complete_design, kind_of
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.project.colours import with_glass
from caustic_cli.scene import Offset, Source, sources
from caustic_cli.scene.interaction import Interior, interaction_of
from caustic_cli.scene.screen import FOCAL
from caustic_cli.schema.table import LensSettings, Parameters, ScreenSettings, SourceSettings, TargetSettings, check

DEFAULT_RESOLUTION = 250
FAR = "far"  # the place of a screen in the far field
STEEPEST = 1.25  # least radius of a derived sphere in half diagonals of the lens: slopes up to 1.3
OBLONG = 2.5  # anamorphic ratio of the magnifications from which on another lens shape is recommended


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
    if "lamp" in given:
        return complete_lamp(given, by or {}, aspect)
    s, by = Settings.of(given), by or Parameters()
    room, s = s.room, s.changed(room=lit_by_sun(s.room, by))
    s = s.changed(source=complete_sunlight(s.source, s.room, check("lens.array", s.lens.array)))
    refuse_contradictions(s)
    if s.target.sheet:
        aspect, lit = _aspect_of_a_sheet(s, aspect), (1.0, 1.0)
    s = with_glass(s)
    over = Ranges.parse(s.design.over)
    s = s.changed(screen=_placed(s, by, aspect, "z" in given.get("screen", {}), over))
    _check_sizes(s)
    check("target.flip", s.target.flip)
    check("target.encoding", s.target.encoding)
    s = s.changed(source=complete_source(s.source, s.lens, [stage.get("source", "") for stage in s.design.stages]))
    if over:
        at = middle_source(over, s.source, "position" in given.get("source", {}))
        s = s.changed(source=at, design=complete_network(s.design))
    if over or relative_to_initial(s.design):
        s = s.changed(design=s.design if "initial" in given.get("design", {}) else s.design.changed(initial="zero-last"))
    s = s.changed(second=complete_second(s))
    s = s.changed(screen=stand(s, by, room, given.get("screen", {})))
    s = s.changed(target=complete_target(s, by, aspect))
    s = s.changed(screen=complete_screen(s.screen, s.target, by))
    s = s.changed(second=complete_second_size(s))
    s = s.changed(elements=complete_elements(s))
    build_screen(s.screen)
    source = build_source(s.source, lens=s.lens)
    s = s.changed(lens=complete_lens(s, source))
    return complete_design(Defaults(s, source, by.quality, by.rays, lit, gaps))


def _aspect_of_a_sheet(s: Settings, aspect: float) -> float:
    """Height over width of each picture of a contact sheet."""
    array = check("lens.array", s.lens.array)
    return aspect * array[0] / array[1]


def _placed(s: Settings, by: Parameters, aspect: float, placed: bool, over: Ranges | None) -> ScreenSettings:
    """The screen at its distance, with the size and the pixels that are given; placed: whether its distance is given as such."""
    screen, side = s.screen, interaction_of(s.lens.mirror).side
    if math.isinf(by.throw or 0.0) or by.screen_place == FAR or (screen.far and by.throw is None and not placed):
        screen = screen.changed(z=side * FOCAL, far=True)
    elif by.throw is not None:
        if screen.far:
            raise InputError(f"a size in mrad or degrees is one in the far field, ⟨+throw⟩ inf, got {by.throw:g} mm")
        screen = screen.changed(z=side * by.throw)
    elif not placed:
        screen = screen.changed(z=side * screen.z)
    screen = _sized(screen, by, aspect)
    if over and "throw" in over.keys:
        screen = screen.changed(z=middle_distance(over, screen.z, side, by.throw is not None or placed))
    return screen


def _sized(screen: ScreenSettings, by: Parameters, aspect: float) -> ScreenSettings:
    """The screen with the size and the pixels that are given."""
    if by.screen_size is not None:
        width, height = (*by.screen_size, by.screen_size[0] * aspect)[:2]
        screen = screen.changed(size=(width, height))
    if by.resolution is not None:
        screen = screen.without("resolution")
        if len(by.resolution) == 2:
            screen = screen.changed(resolution=by.resolution)
    return screen


def _check_sizes(s: Settings) -> None:
    """Check the sizes that are given, and the distance of the screen."""
    check("lens.size", s.lens.size)
    if check("screen.z", s.screen.z) == 0:
        raise InputError("⟨screen.z⟩ must lie behind the lens, or before a mirror, got 0 mm")
    for section in (s.screen, s.target):
        if "size" in section:
            check(f"{section.section}.size", section["size"])


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
    width, height = (w / k for w, k in zip(lens.size, lens.array, strict=True)) if source.each else lens.size
    for type in types:
        source = source.filled(**type.defaults(lens.changed(size=(width, height))))
    return source.without(*{*SourceSettings.of({})}.difference(sources.COMMON, *(type.keys for type in types)))


def complete_target(s: Settings, by: Parameters, aspect: float) -> TargetSettings:
    """The target with its size on the screen."""
    if by.picture_size is not None:
        if "mag" in by:
            raise InputError("⟨picture_size⟩ and ⟨mag⟩ both give the picture's size: give one of them")
        width, height = (*by.picture_size, by.picture_size[0] * aspect)[:2]
        return s.target.changed(size=(width, height))
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


def complete_lens(s: Settings, source: Source) -> LensSettings:
    """The lens with its base surface, which spreads the light over the picture, and room for the heights."""
    index, kind, adaptable = index_of(s.lens), kind_of(s), "thickness" not in s.lens
    check("lens.index", index)
    lens = kind.blank(s.lens, s.screen, index)
    lens = lens.filled(index=index) if lens.glass is None else lens.filled(wavelength=lens.wavelength)
    array, z = check("lens.array", lens.array), s.screen.z
    lowest, highest = (lens.thickness + height for height in lens.height_range)
    interaction = interaction_of(lens.mirror)
    interaction.check_room(z, lowest, highest)
    if not {"radius", "base_file"} & {*lens}:
        # The pictures of lenslets are superimposed: the light through their centres converges like that of a focusing lens.
        way = -1.0 if lens.crossing else 1.0
        across, along = (way * t / w if k == 1 else 0.0 for t, w, k in zip(s.target.size, lens.size, array, strict=True))
        if s.screen.far:  # without deflection all light lands at its centre, not straight ahead
            across, along = across + 1.0, along + 1.0
        vergence = 0.0
        if source.nearest < lens.z_in and not source.by_lenslet:  # vergence at the surface, 1/mm; 0 for a source at infinity
            inside = interaction.interior(Interior(index)).index
            vergence = 1.0 / (lens.z_in - source.centre[2] + (lens.thickness - lens.z_in) / inside)
        radius = Offset.for_magnification((across, along), interaction.effective_index(index), z, lens.thickness, vergence).radius
        least = STEEPEST * math.hypot(*lens.size) / 2.0  # an oblong picture or a near source may ask for a smaller radius
        lens = lens.changed(radius=[math.copysign(max(abs(r), least), r) for r in radius])
    return lens.changed(thickness=lens.thickness + _missing_room(lens)) if adaptable and kind.adapts else lens


def _missing_room(lens: LensSettings) -> float:
    """Increase of the thickness, mm, with which the base surface keeps the least thickness; 0 if the heights have room already.

    A strongly converging lens, for a close source for instance, is thinnest at its corners; a wall is equally thick everywhere.
    """
    x, y = (np.array([0.0, width / 2.0]) for width in lens.size)
    sag = build_base(lens).sag(x[:, None], y[None, :]) if lens.entrance == "flat" else np.zeros(1)
    lowest = lens.thickness + float(sag.min())
    short = interaction_of(lens.mirror).base(lens.z_in) + lens.min_thickness - lowest
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
