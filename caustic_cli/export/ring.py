"""A closed ring of panels (`export.panels`, whose notation is used) as one body: a closed, oriented triangle mesh.

The points of a panel are at equal angles between its mitres and at equal places along the axis.  Neighbours meet in the plane of a
mitre with edges of their own, rho(a, d) and rho'(a, -d), between which a step closes the surface.  Points of both that are closer
than JOINED are one, which keeps triangles apart in float32; where the edges cross between two points, the closer pair is joined as
well, so that no step crosses itself.  The inner sides meet in one edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.export.panels import Height, Panels, level
from caustic_cli.export.surface import Sampling, counts_of, grid_within
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Lens

#: Distance of the points of two edges, mm, up to which they are one: float32 resolves 4e-6 mm at 60 mm.
JOINED = 1e-4


@dataclass(frozen=True, eq=False)
class Ring:
    """Closed mesh: vertices (V, 3) mm in the coordinates of the first panel, faces (F, 3); counts: points of each panel across and
    along; step: greatest height between neighbours at a mitre, mm."""

    vertices: np.ndarray
    faces: np.ndarray
    counts: tuple[int, int]
    step: float

    @property
    def volume(self) -> float:
        """mm^3."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float((a * np.cross(b, c)).sum()) / 6.0


def ring_of(panels: Panels, lens: Lens, samples: Sampling | None = None, tolerance: float | None = None) -> Ring:
    """The mesh of a ring.

    Args:
        lens: of each panel, with its inner side; samples, tolerance: density of the points of a panel, as of `mesh.closed_mesh`.

    Raises:
        InputError: the relief reaches the inner side, or there are too many points.
    """
    across, along = _counts(panels, samples, tolerance)
    theta, a = np.linspace(-panels.sector, panels.sector, across), np.linspace(-panels.half, panels.half, along)
    maps = {id(side[1]): panels.distances(level(side), theta, a) for side in panels.unlike}
    outer = np.stack([maps[id(side[1])] for side in panels.sides])  # (N, across, along)
    inner = panels.distances(_inner(lens), theta, a)
    inner[0] = inner[-1] = 0.5 * (inner[0] + inner[-1])
    least = float((outer - inner).min())
    if not least > 0:
        raise InputError(f"a solid needs its exit above its entrance everywhere, got a least thickness of {least:.6g} mm")
    right, left = outer[:, -1], np.roll(outer[:, 0], -1, 0)  # both edges at the mitre behind each panel
    step, joined = float(np.abs(right - left).max()), _joined(right - left)
    middle = 0.5 * (right + left)
    outer[:, -1], outer[:, 0] = np.where(joined, middle, right), np.roll(np.where(joined, middle, left), 1, 0)
    faces = _faces(np.where(joined, 0.0, right - left), across)
    vertices = np.concatenate(
        [_placed(panels, outer, theta, a), _placed(panels, np.stack([inner[:-1]] * len(outer)), theta[:-1], a)]
    )
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    return Ring(vertices[used], faces if panels.cylinder.bent == 0 else faces[:, ::-1].copy(), (across, along), step)


def _counts(panels: Panels, samples: Sampling | None, tolerance: float | None) -> tuple[int, int]:
    """Points of each panel across and along."""
    fields = [field for field, _ in panels.unlike]
    if tolerance is not None:
        found = [grid_within(*side, tolerance).shape for side in panels.unlike]
    else:
        found = [counts_of(field.spaces, 1 if samples is None else samples) for field in fields]
    most = [max(counts) for counts in zip(*found, strict=True)]
    return most[panels.cylinder.bent], most[1 - panels.cylinder.bent]


def _inner(lens: Lens) -> Height:
    """Heights of the inner side."""
    if lens.entrance is None:
        return lambda x, y: np.full(len(x), lens.z_in)
    front = entrance_of(lens)
    return level((front.field, front.heights + lens.z_in))


def _joined(apart: np.ndarray) -> np.ndarray:
    """Whether the points of two edges with differences (N, m), mm, are one."""
    near = np.abs(apart) <= JOINED
    crosses = (apart[:, 1:] * apart[:, :-1] < 0) & ~near[:, 1:] & ~near[:, :-1]
    later = np.abs(apart[:, 1:]) < np.abs(apart[:, :-1])
    near[:, 1:] |= crosses & later
    near[:, :-1] |= crosses & ~later
    return near


def _placed(panels: Panels, rho: np.ndarray, theta: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Points (N n m, 3), mm, at distances (N, n, m) of the panels, angles (n,) from their vertices and places (m,)."""
    cylinder = panels.cylinder
    turn = np.array([panels.angle(k) for k in range(len(rho))])[:, None, None] + theta[None, :, None]
    across, up = rho * np.sin(turn), rho * np.cos(turn) + cylinder.axis
    along = np.broadcast_to(a, rho.shape)
    return np.stack([*cylinder.lens_xy(along, across), up], -1).reshape(-1, 3)


def _faces(apart: np.ndarray, across: int) -> np.ndarray:
    """Triangles (F, 3) of a ring, oriented outwards for b x a = +z.

    apart: how much higher each panel ends than the next begins, (N, m), 0 where their points are one.  Points of the outer side are
    numbered first, (panel, across, along), then those of the inner side without each panel's last.
    """
    count, along = apart.shape
    outer = np.arange(count * across * along).reshape(count, across, along)
    inner = outer.size + np.arange(count * (across - 1) * along).reshape(count, across - 1, along)
    inner = np.concatenate([inner, np.roll(inner[:, :1], -1, 0)], 1)
    right = outer[:, -1]
    left = np.where(apart == 0.0, right, np.roll(outer[:, 0], -1, 0))
    outer[:, 0] = np.roll(left, 1, 0)
    found = [
        *_quads(outer[:, :-1, :-1], outer[:, 1:, :-1], outer[:, 1:, 1:], outer[:, :-1, 1:]),
        *_quads(inner[:, :-1, 1:], inner[:, 1:, 1:], inner[:, 1:, :-1], inner[:, :-1, :-1]),
        *_quads(right[:, :-1], left[:, :-1], left[:, 1:], right[:, 1:]),  # the steps at the mitres
        *_end(outer[..., 0], inner[..., 0], apart[:, 0] > 0),
        *(f[..., ::-1] for f in _end(outer[..., -1], inner[..., -1], apart[:, -1] > 0)),
    ]
    faces = np.concatenate([f.reshape(-1, 3) for f in found])
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


def _end(outer: np.ndarray, inner: np.ndarray, falls: np.ndarray) -> list[np.ndarray]:
    """Triangles of the end at the first place between points (N, n) of both sides; falls: whether a panel ends higher than the next
    begins.  Both points and the inner one lie on a line, so that the lower is a corner of the triangle beside the line."""
    right, left, seam = outer[:, -1], np.roll(outer[:, 0], -1, 0), inner[:, -1]
    before, behind = inner[:, -2], np.roll(outer[:, 1], -1, 0)
    one = (np.stack(t, -1) for t in ((right, before, left), (left, before, seam), (behind, left, seam)))
    other = (np.stack(t, -1) for t in ((right, before, seam), (behind, left, right), (behind, right, seam)))
    return [
        np.stack([outer[:, 2:], outer[:, 1:-1], inner[:, 1:-1]], -1),
        np.stack([outer[:, 1:-1], inner[:, :-2], inner[:, 1:-1]], -1),
        *(np.where(falls[:, None], a, b) for a, b in zip(one, other, strict=True)),
    ]


def _quads(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both triangles of quadrilaterals."""
    return np.stack([a, b, c], -1), np.stack([a, c, d], -1)


def figures(panels: Panels, ring: Ring) -> dict:
    """Of a ring, for JSON."""
    return {
        "panels": len(panels.sides),
        "panel_degrees": 2.0 * math.degrees(panels.sector),
        "panel_points": list(ring.counts),
        "triangles": len(ring.faces),
        "step_mm": ring.step,
        "volume_mm3": ring.volume,
        "outer_radius_mm": panels.high,
    }
