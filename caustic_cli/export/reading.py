"""The surface that another program reconstructs from an exported file, with the numbers as they are rounded in it.

Poles and spline    exactly
points              bicubic not-a-knot spline, of lower degree for fewer than four points along an axis
heights and slopes  bicubic Hermite patches, a spline with double knots
meshes              through their vertices: the same bicubic spline over a rectangle; over a disc, facets with the vertex normals
                    that programs derive from the facets.  Beside it flat facets, as a printer without smoothing sees them

`workflow.export` traces these surfaces in place of the lens' own and compares the pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.export.surface import SurfaceGrid
from caustic_cli.loading import OnDemand
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.base import MeasuredSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Aperture, FreeForm
from caustic_cli.scene.aperture import UNBOUNDED

interpolate = OnDemand("scipy.interpolate")

#: Random points at which heights are compared.
POINTS = 100_000
SEED = 0


@dataclass(frozen=True, eq=False)
class Reading:
    """A surface as read from a file, in the coordinates of the part.

    read_as: its interpolation, as a phrase; samples: points (nx, ny) in the file; surface, heights: the exit, heights None for
    facets; entrance: of a two-sided lens, from its vertex plane, None where it is the designed one.
    """

    read_as: str
    samples: tuple[int, int]
    surface: HeightField | MeasuredSurface
    heights: Tensor | None
    entrance: FreeForm | None = None

    def largest_deviation(self, field: HeightField, heights: Tensor, aperture: Aperture = UNBOUNDED) -> float:
        """Largest deviation in height, mm, from a surface, control heights (n, m) mm, at random points of its rectangle
        within an aperture."""
        random = np.random.default_rng(SEED)
        x, y = (torch.from_numpy(random.uniform(-r, r, POINTS)) for r in field.half_size)
        inside = aperture.contains(x, y)
        x, y = x[inside], y[inside]
        own, read = field.at(heights, x, y, [(0, 0)])[0], self.surface.at(self.heights, x, y, [(0, 0)])[0]  # type: ignore[arg-type]
        return float((read - own).abs().max())


#: Surfaces as read from a file, by the JSON key of their error: "error" for the usual reader, and others beside it.
Readings = dict[str, Callable[[], Reading]]


def spline_through(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[HeightField, Tensor]:
    """The bicubic not-a-knot spline through heights (nx, ny) mm on grid lines x (nx,), y (ny,) mm, of lower degree for fewer than
    four along an axis."""
    spaces, half, net = [], [], z
    for lines in (x, y):
        degree = min(3, len(lines) - 1)
        if degree == 2:  # three points determine one parabola; SciPy accepts odd degrees only without knots
            knots = np.repeat([lines[0], lines[-1]], 3)
            found = interpolate.make_interp_spline(lines, net, 2, t=knots)
        else:
            found = interpolate.make_interp_spline(lines, net, degree)
        middle, reach = 0.5 * (lines[0] + lines[-1]), 0.5 * (lines[-1] - lines[0])
        knots = 0.5 * ((found.t - middle) / reach + 1.0)
        knots[: degree + 1], knots[-degree - 1 :] = 0.0, 1.0
        spaces.append(SplineSpace(degree, torch.from_numpy(knots)))
        half.append(float(reach))
        net = np.ascontiguousarray(found.c.T)
    return HeightField((spaces[0], spaces[1]), (half[0], half[1])), torch.from_numpy(net)


def of_points(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Reading:
    """Points z (nx, ny) mm on grid lines, read as a bicubic spline."""
    return Reading("a bicubic spline", z.shape[:2], *spline_through(x, y, z))


def of_patches(grid: SurfaceGrid, z: np.ndarray, zx: np.ndarray, zy: np.ndarray, zxy: np.ndarray) -> Reading:
    """Heights, slopes and twists (nx, ny) on a grid, read as bicubic Hermite patches."""
    spaces, weights = [], []
    for lines in (grid.u, grid.v):
        spaces.append(SplineSpace(3, torch.cat([lines.new_zeros(4), lines[1:-1].repeat_interleave(2), lines.new_ones(4)])))
        gap = lines.diff() / 3.0  # the poles beside a double knot are a third of a cell away from it, along its slope
        edge = gap.new_zeros(1)
        weights.append(torch.stack([-torch.cat([edge, gap]), torch.cat([gap, edge])], -1))  # (n, 2) before and behind a line
    (rx, ry), (a, b) = grid.field.half_size, (w.numpy() for w in weights)
    step = 2.0 * rx * a[:, :, None, None]  # (nx, 2, 1, 1), mm
    over = 2.0 * ry * b[None, None]  # (1, 1, ny, 2)
    z, zx, zy, zxy = (c[:, None, :, None] for c in (z, zx, zy, zxy))
    poles = z + step * zx + over * zy + step * over * zxy  # (nx, 2, ny, 2)
    nx, ny = grid.shape
    net = np.ascontiguousarray(poles.reshape(2 * nx, 2 * ny))
    field = HeightField((spaces[0], spaces[1]), grid.field.half_size)
    return Reading("bicubic patches", grid.shape, field, torch.from_numpy(net))


def of_poles(field: HeightField, poles: Tensor, entrance: FreeForm | None = None) -> Reading:
    """The spline with these poles (n, m), mm."""
    return Reading("the B-spline of these poles", field.shape, field, poles, entrance)
