"""Completion of optional features: light of the sun, networks trained over ranges, two free-form sides, other elements.

Each function completes its own part of the settings, if present, for `completion`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from caustic_cli.config.settings import FIRST, Settings, build_component, build_source
from caustic_cli.errors import InputError, alternatives
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.loading import OnDemand
from caustic_cli.scene import Lens, Offset, Scene, Screen, Source, sources
from caustic_cli.scene.interaction import interaction_of
from caustic_cli.scene.traits import TRAITS
from caustic_cli.schema.table import (
    DesignSettings,
    ElementSettings,
    Parameters,
    RoomSettings,
    ScreenSettings,
    SecondSettings,
    SourceSettings,
    check,
    default,
)

rooms, sunlights = OnDemand("caustic_cli.scene.room"), OnDemand("caustic_cli.scene.sunlight")
room_screens, lens_space = OnDemand("caustic_cli.scene.room_screen"), OnDemand("caustic_cli.inverse.lens_space")

#: Decimals of the angles that follow from a time, degrees, and how far a project's own may be from them.
ANGLE_DECIMALS, SAME_ANGLE = 4, 0.01
OVER_WIDTH = 128  # width of a dense network over a range: caustic convergence, study design, networks
#: Size of elements and thickness of a lens that one ray passes, mm.
POINT, THIN = (1e-3, 1e-3), 1e-3
#: Least reach of a slope on the screen, in parts of its distance, by which light is sent to the picture.
LEAST_REACH = 0.02
#: Parts of the way from the size of a beam to that of an undeflected one that are tried where a lens would have no edge.
SMALLER = tuple(k / 50 for k in range(51))
BEAM = 1.2  # width of a further lens or mirror over that of a beam from the lens' edges to those of the picture


def sunlight(room: RoomSettings) -> tuple[Any, datetime]:
    """The light of the sun in a window, `scene.sunlight.Sunlight`, and the time for which a lens is designed.

    Raises:
        InputError: a setting is missing or out of range.
    """
    if room.place is None or room.time is None:
        raise InputError(
            "[room] needs ⟨+room.place⟩, a place on earth and a time: without the sun, ⟨room.faces⟩ and ⟨room.slope⟩ have no use"
        )
    pane, place = rooms.Room(room.faces, room.slope), check("room.place", room.place)
    return sunlights.Sunlight(pane, place), sunlights.moment(room.time.partition("/")[0])


def complete_sunlight(source: SourceSettings, room: RoomSettings | None, array: tuple[int, int] = (1, 1)) -> SourceSettings:
    """The source with the direction of the sun's light, and with the sun's width if it has one, where they are not given; for an
    interval of time one for each lenslet of an array, in their order.

    Raises:
        InputError: there is no sunlight at that time, the source cannot be the sun, or has another direction.
    """
    if room is None:
        return source
    type = sources.type_of(source.type)
    if "tilt" not in type.keys:
        raise InputError(
            f"⟨room.place⟩ needs ⟨source⟩ {alternatives(sources.used_by('tilt'))}, whose light has a direction, got {type.name}"
        )
    light, _ = sunlight(room)
    times = sunlights.instants(room.time, math.prod(array))
    if len(times) == 1:
        return _of_sun(source, type, light, times[0])
    if source.also and len(source.also) != len(times) - 1:
        raise InputError(f"[[source]]: the sun of {len(times)} lenslets has as many [[source]], got {len(source.also) + 1}")
    first = source.without("also")
    each = [first, *(source.also or [first.without(*FIRST)] * (len(times) - 1))]
    lit = [_of_sun(one, type, light, time) for one, time in zip(each, in_reading_order(times, array), strict=True)]
    return lit[0].changed(also=lit[1:])


def in_reading_order(times: Sequence[datetime], array: tuple[int, int]) -> list[datetime]:
    """The time of each lenslet, j fastest, of times that are in the order in which the pictures of a sheet are read, row by row."""
    n, m = array
    return [times[(m - 1 - j) * n + i] for i in range(n) for j in range(m)]


def _of_sun(source: SourceSettings, type: Any, light: Any, time: datetime) -> SourceSettings:
    """A source with the direction and the width of the sun at a time, where they are not given.

    Raises:
        InputError: there is no sunlight, or the source has another direction.
    """
    light.check(time)
    tilt = [round(angle, ANGLE_DECIMALS) for angle in light.tilt(time)]
    given = check("source.tilt", source.tilt) if "tilt" in source else tilt
    if max(abs(a - b) for a, b in zip(given, tilt, strict=True)) > SAME_ANGLE:
        raise InputError(
            f"⟨source.tilt⟩ is {given[0]:g},{given[1]:g}, but the light of the sun at ⟨room.time⟩ has {tilt[0]:g},{tilt[1]:g}"
            " degrees: remove the tilt, or the time and the place of the sun"
        )
    width = {"angle": round(light.sun(time).diameter, ANGLE_DECIMALS)} if "angle" in type.keys else {}
    return source.filled(tilt=tilt, **width)


def lit_by_sun(room: RoomSettings | None, by: Parameters) -> RoomSettings | None:
    """The room, None where it has no sun and only gives the screen its place."""
    dark = room is not None and room.place is None and room.time is None and by.screen_place is not None
    return None if dark else room


def stand(s: Settings, by: Parameters, room: RoomSettings | None, given: Mapping[str, Any]) -> ScreenSettings:
    """The screen in its place in the room; without one, square to light that is tilted and centred on it, where its own tilt and
    shift are not given.  Two free-form sides turn the light onto the axis instead: the screen stands as without tilt.

    room, given: the sections [room] and [screen] as given.

    Raises:
        InputError: the place is not reached by the light, or the screen has two.
    """
    interaction, source = interaction_of(s.lens.mirror), build_source(s.source)
    if by.screen_place is None or s.screen.far:
        if not source.lean or s.second is not None:
            return s.screen
        (x, y), tilt = _among(s, source, s.elements, s.screen.z, s.screen.far) if s.elements else _straight_on(s, source)
        return s.screen.filled(tilt=tilt, shift=[x, y])
    twice = ["⟨throw⟩"] * (by.throw is not None) + [f"⟨screen.{key}⟩" for key in ("z", "tilt", "shift") if key in given]
    if twice or s.elements:
        why = f"{twice[0]} would be another" if twice else "⟨element⟩ has the screen on its own axis"
        raise InputError(f"⟨screen_place⟩ gives the screen its distance, tilt and shift: {why}")
    x, y, z = source.axis if source.distant else (-c / math.hypot(*source.centre) for c in source.centre)
    pane = rooms.Room() if room is None else rooms.Room(room.faces, room.slope)
    place = room_screens.placed(by.screen_place, pane, interaction.sent((x, y, z)), interaction.side)
    return s.screen.changed(z=place.z, tilt=place.tilt, shift=place.shift)


def _straight_on(s: Settings, source: Source) -> tuple[tuple[float, float], list[float]]:
    """Where light along a source's axis through the middle of the lens meets the plane of the screen if no surface has slopes, mm
    from the axis, and the tilt of a screen square to it, degrees."""
    x, y, _ = (abs(s.screen.z) / source.axis[2] * c + 0.0 for c in source.axis)
    return (x, y), [interaction_of(s.lens.mirror).side * angle + 0.0 for angle in source.tilt]


def _among(
    s: Settings, source: Source, elements: Sequence[ElementSettings], z: float, far: bool = False
) -> tuple[tuple[float, float], list[float]]:
    """The same through other elements, at a distance z along the folded axis, mm; far: in the focal plane of a lens of the focal
    length z behind them, to whose middle the light goes, wherever it leaves them.

    Raises:
        InputError: an element is invalid, or the light does not arrive.
    """
    beside = [element.changed(size=list(POINT)) for element in elements]
    scene = Scene(
        source,
        Lens(s.lens.size, s.lens.z_in, offset=Offset(s.lens.z_in + THIN)),
        Screen(s.lens.size, z),
        elements=tuple(build_component(element, s.lens.wavelength) for element in beside),
    )
    place, direction = lens_space.undeviated_ray(scene)
    if far:
        place = z * direction[0] / direction[2], z * direction[1] / direction[2]
    return place, [round(angle, ANGLE_DECIMALS) for angle in rooms.tilt_of(direction)]


def middle_distance(over: Ranges, z: float, side: float, given: bool) -> float:
    """Distance of the screen of a network that is trained over throws, mm: the middle of their range.

    side: -1 for a mirror's screen, else 1; given: whether another distance `z` was.

    Raises:
        InputError: it was.
    """
    middle = side * over.middle[over.keys.index("throw")]
    if given and not math.isclose(z, middle, rel_tol=1e-9):
        raise InputError(f"⟨screen.z⟩ must be the middle of ⟨design.over⟩ throw, {middle:g} mm, or not be given, got {z:g} mm")
    return middle


def middle_source(over: Ranges, source: SourceSettings, given: bool) -> SourceSettings:
    """The source of a network that is trained over its positions, at their middle; given: whether a position was.

    Raises:
        InputError: another position was, or the source does not support ranges.
    """
    middle = {key.removeprefix("source."): v for key, v in zip(over.keys, over.middle, strict=True) if key != "throw"}
    if middle:
        over.refuse(build_source(source))
    if not middle or source.position is None:  # a user-defined source type may have none
        return source
    before = source.position[0]
    place = [middle.get(axis, c) for axis, c in zip("xyz", before, strict=True)]
    if given and not all(math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9) for a, b in zip(place, before, strict=True)):
        raise InputError(
            "⟨source.position⟩ must have the middle of ⟨design.over⟩ where that names it,"
            f" {','.join(f'{c:g}' for c in place)}, got {','.join(f'{c:g}' for c in before)}"
        )
    return source.changed(position=[place])


def complete_network(design: DesignSettings) -> DesignSettings:
    """The design of a network that is trained over ranges, with its preconditioner and width."""
    if design.network != "none":
        design = design.filled(preconditioner="laplacian")
    return design.filled(network_width=OVER_WIDTH) if design.network == "dense" else design


def default_magnification(s: Settings) -> float:
    """Default magnification of the picture; for collimated or focused light that of a beam as wide as the lens."""
    second = s.second or SecondSettings()
    if second.focus is not None and second.focus[2] != 0:
        return abs(1.0 - s.screen.z / second.focus[2])
    return 1.0 if second.collimate else default("mag")


def complete_second(s: Settings) -> SecondSettings | None:
    """The [second] section, which makes the entrance free-form; None for an empty one."""
    if all(s.chosen(path) is None for path in TRAITS["two sides"].settings):
        return None
    second = s.second or SecondSettings()
    if "focus" not in second:
        return second
    places = list(map(list, second["focus"]))
    return second.changed(focus=check("second.focus", places[0] if len(places) == 1 else places))


def complete_second_size(s: Settings) -> SecondSettings | None:
    """Default size of a second picture: that of a beam from the lens' edge through that of the first picture."""
    second = s.second
    if second is None or "file" not in second:
        return second
    grown = check("second.z", second.z) / s.screen.z
    size = [max(0.1 * t, w + (t - w) * grown) for t, w in zip(s.target.size, s.lens.size, strict=True)]
    second = second.filled(size=size)
    check("second.size", second.size)
    return second


def complete_elements(s: Settings) -> tuple[ElementSettings, ...]:
    """Other lenses and mirrors with their default sizes, and checks of unsupported combinations."""
    source = build_source(s.source)
    return tuple(_complete_element(element, s, source, s.elements[:k]) for k, element in enumerate(s.elements))


def _complete_element(element: ElementSettings, s: Settings, source: Source, before: Sequence[ElementSettings]) -> ElementSettings:
    if "z" not in element or "size" in element:
        return element
    behind = check("element.z", element.z) > 0.0
    place = min(element.z, abs(s.screen.z))  # what stands beyond the screen is refused later
    straight = place / abs(s.screen.z) if behind else 0.0
    undeflected = [a + (b - a) * straight for a, b in zip(s.lens.size, s.target.size, strict=True)]
    beam = _beam(s, place, undeflected) if behind else undeflected
    size = [BEAM * width for width in beam] if behind else beam
    if behind and source.lean:  # the light leaves the axis, on which the element stands
        size = [w + 2.0 * abs(c) for w, c in zip(size, _among(s, source, before, element.z)[0], strict=True)]
    lean = [math.cos(math.radians(t)) for t in check("element.tilt", element.tilt or (0.0, 0.0))]
    size = [w / c for w, c in zip(size, lean[::-1], strict=True)]
    size = [max(size)] * 2 if element.aperture == "circle" else size
    least = max(a / b for a, b in zip(undeflected, beam, strict=True))
    sizes = ([(1.0 + part * (least - 1.0)) * width for width in size] for part in SMALLER)
    return element.changed(size=next((smaller for smaller in sizes if _is_possible(element, smaller, s)), size))


def _beam(s: Settings, place: float, undeflected: Sequence[float]) -> list[float]:
    """Widths at a distance `place` along the folded axis, mm, of a beam from the lens' edges to those of the picture, and no less
    than those of an `undeflected` one.

    Paraxially: a ray leaves the lens at x with the slope q = (X - A x) / B, by which it arrives at X (ABCD matrices of thin
    lenses).
    """
    lenses = sorted(
        (element.z, build_component(element.changed(size=list(POINT)), s.lens.wavelength).power)
        for element in s.elements
        if "z" in element and 0.0 < element.z < abs(s.screen.z)
    )

    def matrix(end: float) -> tuple[float, float, float, float]:
        a, b, c, d, at = 1.0, 0.0, 0.0, 1.0, 0.0
        for z, power in (one for one in lenses if one[0] < end):
            a, b = a + (z - at) * c, b + (z - at) * d
            c, d, at = c - power * a, d - power * b, z
        return a + (end - at) * c, b + (end - at) * d, c, d

    a, b, _, _ = matrix(place)
    whole = matrix(abs(s.screen.z))
    to_x, to_q = (abs(s.screen.z) * m for m in whole[2:]) if s.screen.far else whole[:2]
    if abs(to_q) <= LEAST_REACH * abs(s.screen.z):  # the lens is imaged onto the screen
        return [*undeflected]
    sides = [
        [abs(a * lens + b * (side * picture - to_x * lens) / to_q) for side in (1.0, -1.0)]
        for lens, picture in zip(s.lens.size, s.target.size, strict=True)
    ]
    return [round(max(width, *found), 6) for width, found in zip(undeflected, sides, strict=True)]


def _is_possible(element: ElementSettings, size: list[float], s: Settings) -> bool:
    """Whether an element can have this size: the surfaces of a lens may cross at its rim."""
    try:
        build_component(element.changed(size=size), s.lens.wavelength)
    except InputError:
        return False
    return True
