"""Closed, oriented triangle mesh of a lens: exit surface, side walls, flat or free-form entrance; or of a mirror, with material
above its surface up to z_in.

Vertices are counter-clockwise seen from outside.  Used by the mesh formats (STL, PLY, OBJ).

The exit surface is a patch of nx x ny points, see `lattice`.  A border, for the mount, is a flange around the aperture, half as
high as the lowest point of the rim.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.bodies import Body, bodies
from caustic_cli.export.lattice import LATTICES, Patch, triangles
from caustic_cli.export.reading import Readings
from caustic_cli.export.surface import STEPS_PER_SPAN, Sampling, counts_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Lens, Scene

#: Approximate bytes of walls and entrances in a mesh file.
BESIDE = 1e6
#: Most points along an axis of the mesh of another element's sphere.
SPHERE = 401
#: Height of the flange over the least height of the rim.
FLANGE = 0.5


def closed_mesh(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: Sampling | None = None,
    tolerance: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 mm and faces (F, 3) int64 of the solid of the lens and of other elements.

    Args:
        heights: (n, m) control heights, mm.
        samples: density of points on the exit surface, as of `sample_grid`.
        tolerance: largest chord error of the triangles, mm, instead of samples.

    Raises:
        InputError: both samples and tolerance; too few or too many points; or the surface reaches the entrance.
    """
    parts = [solid_of(scene.lens, *patches(scene.lens, field, heights, samples, tolerance))]
    for body in bodies(scene):
        own = None if tolerance is not None else body_samples(body, samples)
        vertices, faces = solid_of(body.lens, *patches(body.lens, body.field, body.heights, own, tolerance))
        parts.append((body.placed(vertices), faces))
    counts = np.cumsum([0, *(len(v) for v, _ in parts)])
    return np.concatenate([v for v, _ in parts]), np.concatenate([f + k for (_, f), k in zip(parts, counts, strict=False)])


def body_samples(body: Body, samples: Sampling | None) -> Sampling | None:
    """Density of the mesh of another element: that of the exit where one of its surfaces was designed, else that of a sphere."""
    designed = any(side is not None and side.knots is not None for side in body.component.surfaces)
    counts = counts_of(body.field.spaces, STEPS_PER_SPAN)
    return samples if designed else (min(SPHERE, counts[0]), min(SPHERE, counts[1]))


def choices(scene: Scene, field: HeightField, heights: Tensor, limit: float, a_point: float) -> list[dict]:
    """Densities of files of at most `limit` bytes, the smallest first; a_point: bytes of a point with its triangles."""
    designed = 1 if scene.lens.entrance is None else 2
    beside = BESIDE
    for body in bodies(scene):
        density = body_samples(body, None)
        designed += density is None
        beside += 0 if density is None else 2 * math.prod(counts_of(body.field.spaces, density)) * a_point
    most = max(4.0, (limit - beside) / a_point / designed)
    return [{"samples": s} for s in LATTICES[scene.lens.aperture].choices(field.spaces, most)]


def readings(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: Sampling | None = None,
    tolerance: float | None = None,
    rounded: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> Readings:
    """The surface as read from a mesh through its vertices, and as flat facets; rounded: the points (nx, ny, 3) as written."""
    *fronts, exit = patches(scene.lens, field, heights, samples, tolerance)
    points, lattice = rounded(exit.points), LATTICES[scene.lens.aperture]
    front = lattice.front(rounded(fronts[0].points), scene.lens.z_in) if fronts else None
    return {"error": lambda: lattice.smooth(points, front), "facet_error": lambda: lattice.facets(points, entrance=front)}


def patches(
    lens: Lens,
    field: HeightField,
    heights: Tensor,
    samples: Sampling | None = None,
    tolerance: float | None = None,
) -> tuple[Patch, ...]:
    """Patches of the free-form sides of a solid, the exit last, with equal numbers of points; arguments as in `closed_mesh`."""
    patch, surfaces = LATTICES[lens.aperture].patch, [(field, heights)]
    if lens.entrance is not None:
        entrance = entrance_of(lens)
        surfaces.insert(0, (entrance.field, entrance.heights + lens.z_in))
    found = [patch(*surface, samples, tolerance) for surface in surfaces]
    shapes = {p.points.shape[:2] for p in found}
    if len(shapes) > 1:
        found = [patch(*surface, (max(nx for nx, _ in shapes), max(ny for _, ny in shapes))) for surface in surfaces]
    return tuple(found)


def solid_of(lens: Lens, *sides: Patch) -> tuple[np.ndarray, np.ndarray]:
    """Closed mesh of a solid with these free-form sides: vertices and faces."""
    return solid(sides[0].points, lens) if len(sides) == 1 else _between(*(side.points for side in sides), lens)


def _between(low: np.ndarray, high: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Closed mesh between two patches (nx, ny, 3) over the same points of the aperture.

    Raises:
        InputError: they intersect, or the lens has a border, which requires a flat entrance.
    """
    if lens.border > 0:
        raise InputError("⟨lens.border⟩ requires a flat entrance, and both sides of this lens are free-form")
    least = float((high[..., 2] - low[..., 2]).min())
    if not least > 0:
        raise InputError(f"a solid needs its exit above its entrance everywhere, got a least thickness of {least:.6g} mm")
    nx, ny = high.shape[:2]
    top, below = rim_of(nx, ny), nx * ny + rim_of(nx, ny)
    entrance = nx * ny + triangles(low)[:, ::-1]
    return np.concatenate([high.reshape(-1, 3), low.reshape(-1, 3)]), np.concatenate([triangles(high), walls(top, below), entrance])


def rim_of(nx: int, ny: int) -> np.ndarray:
    """Indices of the border points of a patch, counter-clockwise from +z: (2 (nx + ny) - 4,)."""
    number = np.arange(nx * ny).reshape(nx, ny)
    return np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])


def walls(top: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Triangles between two loops of point indices (k,), each counter-clockwise from +z, oriented outwards: (2 k, 3)."""
    after, after_below = np.roll(top, -1), np.roll(below, -1)
    return np.concatenate([np.stack([below, after_below, after], -1), np.stack([below, after, top], -1)])


def solid(points: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Closed triangle mesh of the lens under points (nx, ny, 3): vertices (V, 3) float64 mm, faces (F, 3) int64.

    Loops with as many points as the rim follow it outwards and down, connected by strips; a triangle fan closes the entrance.  So
    every edge belongs to exactly two triangles.

    Raises:
        InputError: the surface reaches the entrance.
    """
    up = np.array([1.0, 1.0, lens.cut_from])  # a mirror is built upside down; the order of its vertices keeps the orientation
    vertices, faces = _under(points * up, lens, lens.cut_from * lens.z_in)
    return vertices * up + 0.0, faces[:, :: lens.cut_from].copy()


def _under(points: np.ndarray, lens: Lens, z_in: float) -> tuple[np.ndarray, np.ndarray]:
    """`solid` under points above z_in, mm."""
    refuse_open(float(points[..., 2].min()), z_in)
    nx, ny = points.shape[:2]
    numbers, vertices = rim_of(nx, ny), [points.reshape(-1, 3)]
    rim, faces, count = vertices[0][numbers], [triangles(points)], nx * ny
    loops = [_at(rim, lens, 0.0, z_in)]
    if lens.border > 0:
        high = flange_height(rim, z_in)
        loops = [_at(rim, lens, 0.0, high), _at(rim, lens, lens.border, high), _at(rim, lens, lens.border, z_in)]
    for loop in loops:
        below = count + np.arange(len(rim))
        faces.append(walls(numbers, below))
        vertices.append(loop)
        numbers, count = below, count + len(rim)
    faces.append(np.stack([np.full_like(numbers, count), np.roll(numbers, -1), numbers], -1))
    vertices.append(np.array([[0.0, 0.0, z_in]]))
    return np.concatenate(vertices), np.concatenate(faces)


def flange_height(rim: np.ndarray, z_in: float) -> float:
    """z of the upper face of a border, mm, for rim points (k, 3): below all rays that leave the exit."""
    return z_in + FLANGE * (float(rim[:, 2].min()) - z_in)


def _at(rim: np.ndarray, lens: Lens, wider: float, z: float) -> np.ndarray:
    """The rim (k, 3), moved outwards by `wider` mm and to height z."""
    scale = [(r + wider) / r for r in lens.half_size]
    return np.stack([rim[:, 0] * scale[0], rim[:, 1] * scale[1], np.full(len(rim), z)], -1)


def refuse_open(least: float, z_in: float) -> None:
    """Refuse a lens whose least height, mm, is not above the entrance.

    Raises:
        InputError: it is not a solid.
    """
    if not least > z_in:
        raise InputError(
            f"a solid needs its exit surface above the entrance at z_in = {z_in:g} mm everywhere,"
            f" got a least height of {least:.6g} mm; design with a larger min_thickness"
        )
