"""Difficult cases of where rays meet a surface."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import numpy as np
import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.mesh import TriangleMesh
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Lens, Points, Scene, Screen
from caustic_cli.studies.stability.case import Case
from caustic_cli.studies.stability.splines import exact, heights_of

#: The parabola z = x^2 / 2 over -1 < x < 1 mm, and its control heights: products of two knots, which are exact.
PARABOLA, CURVED = HeightField((SplineSpace.uniform(6, 2), SplineSpace.uniform(2, 1)), (1.0, 1.0)), 0.5


def parabola() -> torch.Tensor:
    """Control heights (6, 2), mm."""
    x = 2.0 * PARABOLA.spaces[0].knots - 1.0
    return (CURVED * x[1:-2] * x[2:-1])[:, None].expand(6, 2).contiguous()


def grazing(angle: float) -> tuple[float, float]:
    """Through the first wall of a valley, 0.1 mm over its bottom, to the second; naively Newton's method from the top."""
    tangent = 1.0 / math.tan(math.radians(angle))
    length = math.hypot(1.0, tangent)
    start, direction = (-0.95, 0.1 - 0.95 * tangent), (1.0 / length, tangent / length)
    with localcontext() as context:
        context.prec = 60
        x, z, dx, dz = map(Decimal, (*start, *direction))
        a, b, c = Decimal(CURVED) * dx * dx, 2 * Decimal(CURVED) * x * dx - dz, Decimal(CURVED) * x * x - z
        first = float((-b - (b * b - 4 * a * c).sqrt()) / (2 * a))
    t = (CURVED - start[1]) / direction[1]
    for _ in range(50):
        at = start[0] + t * direction[0]
        t -= (start[1] + t * direction[1] - CURVED * at * at) / (direction[1] - 2.0 * CURVED * at * direction[0])
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    rays = (start[0] * one, zero, start[1] * one), (direction[0] * one, zero, direction[1] * one)
    hit = PARABOLA.intersect(parabola(), *rays, 1.0)
    return abs(t - first), abs(float(hit.t[0]) - first) if bool(hit.valid[0]) else math.inf


def far_source(distance: float) -> tuple[float, float]:
    """Heights of the hits of rays from so far away above z = x^2 / 2; naively counted along the ray from the source, in float32."""
    lens = Lens(size=(2.0, 2.0), control=(6, 2), degree=(2, 1), index=1.5, fresnel="none")
    scene = Scene(Points(((0.0, 0.0, -distance),)), lens, Screen((10.0, 10.0)))
    rays = Tracer(System.of(scene, PARABOLA), next(rays_of(scene, "stratified", 400, 1).chunks())).start
    hit = PARABOLA.intersect(parabola(), rays.origin, rays.direction, 1.0)
    x, _, z = (o + hit.t * d for o, d in zip(rays.origin, rays.direction, strict=True))
    far, depth = np.float32(-distance), z.numpy().astype(np.float32)
    naive = np.abs((far + (depth - far)) - z.numpy()).max()
    return float(naive), float((z - CURVED * x * x)[hit.valid].abs().max()) if bool(hit.valid.any()) else math.inf


def mesh_vertices(parts: int) -> tuple[float, float]:
    """Rays in all directions through the vertices of a triangle mesh: the height of the hit is that of the vertex."""
    field = HeightField((SplineSpace.uniform(7, 3), SplineSpace.uniform(6, 2)), (1.0, 1.0))
    mesh = TriangleMesh(field, 2.0 + 0.3 * heights_of(42, 5).view(7, 6), parts, parts)
    x, y = (np.concatenate([(b[:-1, None] + np.diff(b)[:, None] * np.arange(parts) / parts).ravel(), b[-1:]]) for b in mesh._breaks)
    z = mesh._vertices[1:-1, 1:-1]
    vertices = np.stack(np.broadcast_arrays(x[1:-1, None], y[None, 1:-1], z), -1).reshape(-1, 3)
    slopes = 0.05 * np.random.default_rng(3).standard_normal((len(vertices), 2))
    direction = np.concatenate([slopes, np.ones((len(vertices), 1))], 1)
    start = vertices - vertices[:, 2:] * direction  # at z = 0, so that t is the height of the hit
    t, status, _ = mesh.intersect(*(torch.from_numpy(np.ascontiguousarray(c)) for c in (*start.T, *direction.T)))
    ours = np.where(status.numpy() == 0, np.abs(t.numpy() - vertices[:, 2]), np.inf).max()
    p = np.stack(np.broadcast_arrays(x[:, None], y[None, :], mesh._vertices), -1).astype(np.float32)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[:-1, 1:], p[1:, 1:]
    triangles = np.concatenate([np.stack(t, -2).reshape(-1, 3, 3) for t in ((a, b, c), (d, c, b))])
    slips = not all(meets(triangles, *ray) for ray in zip(start.astype(np.float32), direction.astype(np.float32), strict=True))
    return math.inf if slips else 0.0, float(ours)


def meets(triangles: np.ndarray, start: np.ndarray, direction: np.ndarray) -> bool:
    """Whether a ray meets one of these triangles (N, 3, 3), by the test of Moeller and Trumbore."""
    e1, e2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p, s = np.cross(direction[None], e2), start[None] - triangles[:, 0]
    inverse = np.float32(1.0) / (e1 * p).sum(1)
    u, v = (s * p).sum(1) * inverse, (direction * np.cross(s, e1)).sum(1) * inverse
    return bool(((u >= 0) & (v >= 0) & (u + v <= 1)).any())


def thick_glass(thickness: float) -> tuple[float, float]:
    """Slope of a relief of 1e-3 mm on glass of this thickness, mm; naively by differences of heights in float32."""
    field = HeightField((SplineSpace.uniform(12, 3), SplineSpace.uniform(2, 1)), (0.5, 0.5))
    grain = 2.0**-30  # such heights are exact also on thick glass
    relief = (1e-3 * heights_of(12, 3) / grain).round() * grain
    net = (relief + thickness)[:, None].expand(12, 2).contiguous()
    u = torch.linspace(0.0, 1.0, 33, dtype=torch.float64)[1:-1]
    zero, one = torch.zeros_like(u), torch.ones_like(u)
    truth = np.array([exact(field.spaces[0], float(a), relief)[1] for a in u])
    hit = field.intersect(net, (u - 0.5, zero, zero), (zero, zero, one), 1.0)
    step = 1e-3
    above, below = (field.at(net, u - 0.5 + s * step, zero)[0].float() for s in (1.0, -1.0))
    naive = ((above - below).double() / (2.0 * step)).numpy()
    worst = np.abs(truth).max()
    found = hit.gx.numpy()
    assert bool(hit.valid.all())
    return float(np.abs(naive - truth).max() / worst), float(np.abs(found - truth).max() / worst)


CASES = (
    # four roundings of t and of the heights (FEW_ULP), over a slope across the surface of a third at least
    Case(
        "grazing rays of 75 to 89°",
        "way to the first of two hits, mm",
        "Newton finds the second",
        1e-14,
        grazing,
        (75.0, 85.0, 89.0),
    ),
    # a few roundings of heights and ways of 1 mm, whatever the distance
    Case(
        "hits of light from 1e3 to 1e6 mm away", "height of the hit, mm", "float32 from the source", 1e-14, far_source, (1e3, 1e6)
    ),
    # a few roundings of 2 mm
    Case("rays through vertices of a mesh", "height of the hit, mm", "rays slip through", 1e-14, mesh_vertices, (3, 7)),
    # heights so close to their mean lose it without rounding; some ten roundings follow, whatever the thickness
    Case(
        "relief of 1e-3 mm on 1 to 1,000 m of glass",
        "slope, relative",
        "heights in float32 are equal",
        1e-14,
        thick_glass,
        (1e3, 1e6),
    ),
)
