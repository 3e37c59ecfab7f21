"""What has to be held of a part: for each of its free-form sides, and of those of elements beside it, what moves light by a pixel.

Light moves on the screen by D times an error s of the slope of a side, which is traced: D is the root mean square distance of the
same rays with the side as it is and with a ramp on it, along the worse of x and y, per slope of the ramp (|n - 1| T of an exit that
sends light over the throw T, other elements included).  It is to stay below a pixel p: a bump of width w (half a period) and height
a of a sinusoid has slopes up to pi a / w, so a <= w p / (pi D).  In a varying index an error of |n - 1| a over the thickness is the
same error of the optical path.  Roughness is to scatter less than SCATTERED of the light (`optics.scattering`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.media import medium_of
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.scattering import deviation_of
from caustic_cli.optics.surfaces.fixed import Fixed
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import ENTRANCE, EXIT, Element, System
from caustic_cli.scene import Scene
from caustic_cli.scene.elements import SIDES, surface_name
from caustic_cli.studies.manufacture import apart, landings, shape_of

#: Widths of bumps for which heights are given, in parts of the side's width.
BUMPS = (0.02, 0.05, 0.1, 0.2, 0.5)
#: Fraction of light that may be scattered.
SCATTERED = 0.01
#: Slope of the ramp, and decentre, mm, of finite differences.
STEP = 1e-4
#: Largest decentre that is a limit, mm.
FARTHEST = 1e3


@dataclass(frozen=True)
class Side:
    """A free-form side: number of its element in the system, its words, and control heights (n, m) above its vertex plane, mm."""

    number: int
    words: str
    field: HeightField
    heights: Tensor


def sides_of(scene: Scene, field: HeightField, heights: Tensor) -> list[Side]:
    """The free-form sides of a scene, the exit, of these heights, first."""
    words = {EXIT: "exit side", ENTRANCE: "entrance side"}
    for k, element in enumerate(scene.elements):
        words |= {surface_name(k, side): f"{side} of the {element.kind} at z = {element.z:g} mm" for side in SIDES}
    found = []
    for k, element in enumerate(System.of(scene, field).elements):
        surface = element.surface
        if element.name == EXIT:
            found.insert(0, Side(k, words[EXIT], field, heights))
        elif isinstance(surface, Fixed):
            found.append(Side(k, words[element.name], surface.field, surface.heights))
    return found


def limits(scene: Scene, field: HeightField, heights: Tensor, seed: int = 0) -> dict[str, Any]:
    """What has to be held, for JSON.

    Keys: slope of the exit, by which the light moves by a pixel; bumps_um, heights by widths, mm; roughness_nm; in a varying index
    index_bumps, errors of the index by widths, mm; beside, the other free-form sides, each with side, its words, slope, bumps_um,
    decentre_mm relative to the exit, by which the light moves by a pixel, None for more than FARTHEST, and maximum_slope and
    smallest_concave_radius_mm of `manufacture`.

    Raises:
        InputError: no light arrives.
    """
    lens, pixel = scene.lens, min(scene.screen.pixel)
    system = System.of(scene, field)
    own, *others = sides_of(scene, field, heights)
    before = landings(scene, system, heights, seed)

    def allowed(moved: Iterable[list[RayState]]) -> float:
        farthest = max(apart(before, after) for after in moved)
        return pixel * STEP / farthest if farthest > 0 else math.inf

    def with_side(changed: Iterable[System]) -> float:
        return allowed(landings(scene, one, heights, seed) for one in changed)

    found = _bumps(field, allowed(landings(scene, system, ramped, seed) for ramped in _ramps(own)))
    bend = abs(lens.effective_index - 1.0)
    found["roughness_nm"] = 1e6 * deviation_of(SCATTERED, bend, scene.light.mean)
    if medium_of(lens).varies:
        through = 1e3 * (lens.offset.thickness - lens.z_in)
        found["index_bumps"] = {width: bend * height / through for width, height in found["bumps_um"].items()}
    found["beside"] = []
    for side in others:
        decentre = with_side(_decentred(system, side))
        element = system.elements[side.number]
        shape = shape_of(side.field, side.heights, element.aperture, _cut_from(system, side.number))
        shown = {key: shape[key] for key in ("maximum_slope", "smallest_concave_radius_mm")}
        one = {"side": side.words, "decentre_mm": decentre if decentre < FARTHEST else None}
        found["beside"].append(one | _bumps(side.field, with_side(_with_ramps(system, side))) | shown)
    return found


def _bumps(field: HeightField, slope: float) -> dict[str, Any]:
    """An error of the slope, and the bumps that have it."""
    if not math.isfinite(slope):
        raise InputError("no light arrives behind this lens, so that nothing can be said of how it has to be made")
    widths = [float(f"{part * 2.0 * max(field.half_size):.3g}") for part in BUMPS]
    return {"slope": slope, "bumps_um": {width: 1e3 * width * slope / math.pi for width in widths}}


def _ramps(side: Side) -> Iterator[Tensor]:
    """Heights (n, m), mm, of a side with a ramp along x, and along y."""
    x, y = side.field.control_xy()
    yield side.heights + STEP * x[:, None]
    yield side.heights + STEP * y


def _with_ramps(system: System, side: Side) -> Iterator[System]:
    for heights in _ramps(side):
        yield _with(system, side, surface=Fixed(side.field, heights))


def _decentred(system: System, side: Side) -> Iterator[System]:
    pose = system.elements[side.number].pose
    for axis in pose.axes[:2]:
        x, y, z = (p + STEP * a for p, a in zip(pose.position, axis, strict=True))
        yield _with(system, side, pose=replace(pose, position=(x, y, z)))


def _with(system: System, side: Side, **changes: Any) -> System:
    """The system with this side changed."""
    elements: list[Element] = list(system.elements)
    elements[side.number] = replace(elements[side.number], **changes)
    return replace(system, elements=tuple(elements))


def _cut_from(system: System, number: int) -> int:
    """The side from which a tool machines an element's surface: 1 from +z of its frame, or -1."""
    before, behind = system.media()[number : number + 2]
    outside = behind.index < before.index and not system.elements[number].reflects
    return int(system.sides()[number]) * (1 if outside else -1)
