"""Lattices of points over an aperture, by which a surface is triangulated and read again.

Over a rectangle the lattice is a grid.  Over a circle the square lattice (a, b) is mapped to the disc by the concentric map of P.
Shirley and K. Chiu (J. Graphics Tools 2(3), 1997): concentric squares become circles,

    where |a| >= |b|:  (x, y) = r a (cos t, sin t), t = pi b / (4 a);   elsewhere with x and a exchanged for y and b.

Its edges and shorter diagonals are at most STRETCH steps long.  The error of a triangle with edges up to L is at most L^2 |D2z| /
6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.reading import Reading, spline_through
from caustic_cli.export.surface import (
    MAX_POINTS,
    MAX_SAMPLES,
    STEPS_PER_SPAN,
    Sampling,
    counts_of,
    grid_within,
    sample_grid,
    samplings,
    second_derivative_bounds,
)
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.facets import DiscFacets, FacetSurface, vertex_normals
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import freeform_of
from caustic_cli.scene import Aperture, CircularAperture, FreeForm
from caustic_cli.schema import checks

STRETCH = 1.28
#: Least number of points across a disc within a tolerance; points evaluated at a time along one axis, which bounds the memory.
LEAST, AT_A_TIME = 9, 64


@dataclass(frozen=True, eq=False)
class Patch:
    """The exit surface's points (nx, ny, 3) mm and unit normals towards +z (nx, ny, 3), float64, counter-clockwise from +z."""

    points: np.ndarray
    normals: np.ndarray


class Lattice:
    """The lattice over a rectangle."""

    Facets: type[FacetSurface] = FacetSurface

    def choices(self, spaces: Sequence[SplineSpace], most: float) -> list[Sampling]:
        """Densities to choose from with at most `most` points, the smallest first."""
        return samplings(spaces, most)

    def patch(self, field: HeightField, heights: Tensor, samples: Sampling | None = None, tolerance: float | None = None) -> Patch:
        """Patch of the surface within the aperture.

        Args:
            samples: density of points, as of `sample_grid`; tolerance: largest chord error, mm, instead of samples.

        Raises:
            InputError: both are given, there are too few or too many points, or a tolerance for a round lens with creases.
        """
        if samples is not None and tolerance is not None:
            raise InputError("⟨samples⟩ and ⟨tolerance⟩ both say how fine the mesh is: give one of them")
        return self._patch(field, heights, samples, tolerance)

    def _patch(self, field: HeightField, heights: Tensor, samples: Sampling | None, tolerance: float | None) -> Patch:
        grid = sample_grid(field, heights, samples) if tolerance is None else grid_within(field, heights, tolerance)
        return Patch(*(a.reshape(*grid.shape, 3) for a in (grid.points, grid.normals)))

    def front(self, points: np.ndarray, z_in: float) -> FreeForm | None:
        """The entrance as read through vertices (nx, ny, 3) mm, from its vertex plane; None for the designed one."""
        return freeform_of(*spline_through(points[:, 0, 0], points[0, :, 1], points[..., 2] - z_in))

    def smooth(self, points: np.ndarray, entrance: FreeForm | None = None) -> Reading:
        """The surface as read from a mesh through its vertices (nx, ny, 3), mm."""
        field, heights = spline_through(points[:, 0, 0], points[0, :, 1], points[..., 2])
        return Reading("a bicubic spline through its vertices", points.shape[:2], field, heights, entrance)

    def facets(self, points: np.ndarray, normals: np.ndarray | None = None, entrance: FreeForm | None = None) -> Reading:
        """The surface as read from flat facets between points (nx, ny, 3) mm, with the normals (nx, ny, 3) given there, if any."""
        read_as = "flat facets" if normals is None else "facets with interpolated normals"
        return Reading(read_as, points.shape[:2], self.Facets(points, normals), None, entrance)


class DiscLattice(Lattice):
    """The lattice over a circle, (n, n) points."""

    Facets = DiscFacets

    def choices(self, spaces: Sequence[SplineSpace], most: float) -> list[Sampling]:
        """As of a lattice."""
        found = [max(counts_of(spaces, s)) for s in samplings(spaces, math.inf)]
        across = [n for n in found if n * n <= most] or [max(2, math.isqrt(int(most)))]
        return [(n, n) for n in across]

    def _patch(self, field: HeightField, heights: Tensor, samples: Sampling | None, tolerance: float | None) -> Patch:
        n = self._across(field, heights, samples, tolerance)
        line = torch.linspace(-1.0, 1.0, n, dtype=torch.float64)
        line = 0.5 * (line - line.flip(0))  # symmetric to the last bit
        a, b = torch.meshgrid(line, line, indexing="ij")
        wide = a.abs() >= b.abs()
        r, other = torch.where(wide, a, b), torch.where(wide, b, a)
        angle = 0.25 * math.pi * other / torch.where(r == 0, torch.ones_like(r), r)
        near, far = r * torch.cos(angle), r * torch.sin(angle)
        x, y = (torch.where(wide, p, q) * field.half_size[0] for p, q in ((near, far), (far, near)))
        points, normals = [], []
        for i in range(0, n, AT_A_TIME):
            at = x[i : i + AT_A_TIME].reshape(-1), y[i : i + AT_A_TIME].reshape(-1)
            z, zx, zy = field.at(heights, *at)
            points.append(torch.stack([*at, z], -1))
            normals.append(torch.nn.functional.normalize(torch.stack([-zx, -zy, torch.ones_like(z)], -1), dim=-1))
        return Patch(*(torch.cat(parts).view(n, n, 3).numpy() for parts in (points, normals)))

    def _across(self, field: HeightField, heights: Tensor, samples: Sampling | None, tolerance: float | None) -> int:
        """Number of points along a diameter."""
        if tolerance is None:
            counts = counts_of(field.spaces, STEPS_PER_SPAN if samples is None else samples)
            n, asked = max(checks.pair("⟨samples⟩", counts, lambda w, k: checks.whole(w, k, 2, MAX_SAMPLES))), "⟨samples⟩"
        else:
            checks.number("⟨tolerance⟩", tolerance, 0.0, open_low=True)
            n, asked = self._across_within(field, heights, tolerance), f"⟨tolerance⟩ {tolerance:g}"
        if n > min(MAX_SAMPLES, math.isqrt(MAX_POINTS)):
            raise InputError(f"{asked} must give at most {math.isqrt(MAX_POINTS)} points across a round lens, got {n}")
        return n

    def _across_within(self, field: HeightField, heights: Tensor, tolerance: float) -> int:
        """The same, for a tolerance, mm."""
        if (
            any(int(torch.unique(s.knots[1:-1], return_counts=True)[1].max()) > s.degree for s in field.spaces)
            or min(s.degree for s in field.spaces) < 2
        ):
            raise InputError("⟨tolerance⟩ of a round mesh needs a surface without kinks; give ⟨samples⟩")
        xx, xy, yy = second_derivative_bounds(field, heights)
        curvature = (max(xx, yy) + xy) * STRETCH**2 / 6.0
        return max(LEAST, math.ceil(2.0 * max(field.half_size) * math.sqrt(curvature / tolerance)) + 1)

    def front(self, points: np.ndarray, z_in: float) -> FreeForm | None:
        """As of a lattice: no spline passes through its vertices."""
        return None

    def smooth(self, points: np.ndarray, entrance: FreeForm | None = None) -> Reading:
        """As of a lattice."""
        surface = DiscFacets(points, vertex_normals(points, triangles(points)))
        return Reading("facets with smoothed normals", points.shape[:2], surface, None, entrance)


#: Lattices by the name of the aperture.
LATTICES = {Aperture.name: Lattice(), CircularAperture.name: DiscLattice()}


def triangles(points: np.ndarray) -> np.ndarray:
    """Two triangles for every cell of points (nx, ny, 3), in row-major numbering, split along the shorter diagonal: (2 (nx-1)
    (ny-1), 3).

    For equal diagonals, as over a rectangle, along that from low to high x and y.
    """
    nx, ny = points.shape[:2]
    number, flat = np.arange(nx * ny).reshape(nx, ny), points[..., :2]
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]  # corners of every cell, from +z
    up, down = (
        ((flat[one] - flat[two]) ** 2).sum(-1) for one, two in ((np.s_[1:, 1:], np.s_[:-1, :-1]), (np.s_[1:, :-1], np.s_[:-1, 1:]))
    )
    falling = (down < (1.0 - 1e-9) * up)[..., None]
    first = np.where(falling, np.stack([a, b, d], -1), np.stack([a, b, c], -1))
    second = np.where(falling, np.stack([b, c, d], -1), np.stack([a, c, d], -1))
    return np.stack([first, second], 2).reshape(-1, 3)
