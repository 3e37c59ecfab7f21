"""Writer of STEP files (ISO 10303-21, application protocol 214) of the solid of a lamp, exact.

The surface P = r d over stereographic coordinates (u, v) has the homogeneous coordinates

    (2 u r, 2 v r, (1 - u^2 - v^2) r, 1 + u^2 + v^2),

of degree p + 2 along u and v where r is of degree p, and as smooth as r: splines over the knots of r with multiplicities raised by
2 (Piegl and Tiller, The NURBS Book, 1997, 4.2).  Their control points are found by interpolation at the Greville abscissae, which
is exact but for rounding.  The surface is trimmed at z = 0, the circle u^2 + v^2 = 1; that edge is interpolated, as of a round lens
(`step.ring`).  A flat inner side is a plane.  Of the foot below it, the walls are the edges extruded along z, the flange is round.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli.export.lamp import flange_radius, rim_points
from caustic_cli.export.step import (
    HEAD,
    OUTLINES,
    ROUND_UNCERTAINTY,
    TAIL,
    Entities,
    Loop,
    closed,
    knot_lists,
    product,
    reals,
    ring,
    turned,
    walls,
)
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.lamp import surfaces_of
from caustic_cli.optics.lamp_side import InnerSide
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene import Aperture, CircularAperture
from caustic_cli.scene.lamp import Lamp

#: Points of a round rim at first, over 8.
ROUND = 4


def nurbs(field: PolarField, values: Tensor) -> tuple[tuple[SplineSpace, SplineSpace], np.ndarray, np.ndarray]:
    """The surface with control values (n, m) of r, mm, as NURBS over [0, 1]^2, the square of (u, v): the spaces along both, poles
    (N, M, 3) mm, and weights (N, M), positive."""
    su, sv = (_raised(space) for space in field.spaces)
    u, v = (2.0 * space.greville - 1.0 for space in (su, sv))
    r = field.spaces[0].matrix(su.greville) @ values.detach().double() @ field.spaces[1].matrix(sv.greville).T
    u, v = torch.broadcast_tensors(u[:, None], v[None, :])
    homogeneous = torch.stack([2.0 * u * r, 2.0 * v * r, (1.0 - u * u - v * v) * r, 1.0 + u * u + v * v], -1)
    along = su.interpolated(homogeneous.reshape(su.n, -1)).view(su.n, sv.n, 4).transpose(0, 1)
    control = sv.interpolated(along.reshape(sv.n, -1)).view(sv.n, su.n, 4).transpose(0, 1).numpy()
    return (su, sv), control[..., :3] / control[..., 3:], control[..., 3]


def _raised(space: SplineSpace) -> SplineSpace:
    """The space of the products of its splines with quadratic polynomials."""
    knots, times = torch.unique(space.knots, return_counts=True)
    return SplineSpace(space.degree + 2, knots.repeat_interleave(times + 2))


def write_lamp_step(path: Path, lamp: Lamp, field: PolarField, values: Tensor) -> None:
    """Write the solid atomically; values: control values of r, mm, of one surface or two, see `optics.lamp.sides`."""
    out, (outer, inner), below = Entities(), surfaces_of(lamp, field, values), -lamp.base
    splines = {side: nurbs(*side.spline) for side in (outer, inner) if side.spline is not None}
    faces, rims, openings = [], [], []
    for place in lamp.places:
        rim, hole = (_rim(out, side, side.rim, place) for side in (outer, inner))
        faces.append(out.face(_surface(out, splines[outer], place), out.bound(rim.edges)))
        if inner in splines:
            faces.append(out.face(_surface(out, splines[inner], place), out.bound(turned(hole.edges)), along=False))
        else:
            faces.append(_flat(out, inner.rim, hole, (), up=False))
        opening = hole
        if below < inner.rim:
            opening = _rim(out, inner, below, place)
            faces += walls(out, _extruded(out, opening), hole, opening, along=False)
        rims.append(rim)
        openings.append(opening)
    foot, shape = rims[0], OUTLINES[CircularAperture.name]
    if lamp.count > 1 or lamp.flange > 0:
        around: Aperture = CircularAperture((flange_radius(lamp, outer),) * 2)
        if lamp.count > 1:
            shape, around = OUTLINES[Aperture.name], Aperture(lamp.board)
        edge, foot = shape.flat(out, around, 0.0), shape.flat(out, around, below)
        faces += [_flat(out, 0.0, edge, rims), *shape.walls(out, around, edge, foot)]
    elif lamp.base > 0:
        foot = _rim(out, outer, below)
        faces += walls(out, _extruded(out, foot), rims[0], foot)
    faces.append(_flat(out, below, foot, openings, up=False))
    product(out, [closed(out, faces)], ROUND_UNCERTAINTY)
    with atomic_file(path, "ascii") as file:
        file.write(HEAD)
        file.writelines(out.lines)
        file.write(TAIL)


def _surface(out: Entities, spline: tuple[tuple[SplineSpace, SplineSpace], np.ndarray, np.ndarray], place: np.ndarray) -> str:
    """The NURBS surface of `nurbs` at a place (x, y) mm; its normal is directed away from there."""
    spaces, poles, weights = spline
    points = ",".join(f"({','.join(map(out.point, row))})" for row in poles + np.append(place, 0.0))
    return out.add(
        f"(BOUNDED_SURFACE()B_SPLINE_SURFACE({spaces[0].degree},{spaces[1].degree},({points}),.UNSPECIFIED.,.F.,.F.,.F.)"
        f"B_SPLINE_SURFACE_WITH_KNOTS({','.join(knot_lists(*(s.knots.numpy() for s in spaces)))},.UNSPECIFIED.)"
        f"GEOMETRIC_REPRESENTATION_ITEM()RATIONAL_B_SPLINE_SURFACE(({','.join(map(reals, weights))}))"
        "REPRESENTATION_ITEM('')SURFACE())"
    )


def _rim(out: Entities, side: InnerSide, z: float, place: Sequence[float] | np.ndarray = (0.0, 0.0)) -> Loop:
    """The edge of a side, or below it at z, of a lamp at a place (x, y)."""

    def on(t: np.ndarray) -> np.ndarray:
        return np.column_stack([rim_points(side, t) + place, np.full(len(t), z)])

    spans = (ROUND,) if side.spline is None else side.spline[0].shape
    return ring(out, on, 8 * max(spans))[0]


def _extruded(out: Entities, lower: Loop) -> list[str]:
    """Vertical surfaces over the curves of a ring, whose normals are directed away from the axis."""
    upwards = out.add(f"VECTOR('',{out.direction((0.0, 0.0, 1.0))},1.)")
    return [out.add(f"SURFACE_OF_LINEAR_EXTRUSION('',{curve},{upwards})") for curve in lower.curves]


def _flat(out: Entities, z: float, around: Loop, holes: Sequence[Loop], up: bool = True) -> str:
    """A plane within a loop and without others, which looks up or down."""
    plane = out.plane((0.0, 0.0, z), (0.0, 0.0, 1.0 if up else -1.0), (1.0, 0.0, 0.0))
    outside = around.edges if up else turned(around.edges)
    inside = [turned(hole.edges) if up else hole.edges for hole in holes]
    return out.face(plane, out.bound(outside), *(out.bound(edges, False) for edges in inside))
