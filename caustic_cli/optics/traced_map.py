"""The map from the lens to the screen by neighbouring rays, for scenes in which it does not follow from the exit's slopes alone: in
tilted light, behind a curved entrance, in a medium whose index varies, among other elements.

Notation
    s, X    where the ray through a point of a grid on the pupil leaves the exit, and lands on the screen, mm
    J       Jacobian of X, or of s, by the point of the pupil, (2, 2), by differences of neighbours
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission.coherent import central_mode
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Aperture, Scene

#: Points of the grid along each axis, and of that for ghosts, of which there is one for every pair of surfaces.
POINTS, GHOSTS = 128, 64
#: Tangent of the rays for the distance, from the middle of the exit.
TANGENT = 1e-4


def is_known(scene: Scene, field: HeightField) -> bool:
    """Whether all surfaces but the exit have heights, as those of a scene have not that is still to be designed."""
    return set(System.of(scene, field).shapes) == {EXIT}


@torch.no_grad()
def local_magnification(scene: Scene, field: HeightField, heights: Tensor) -> float | None:
    """Square root of the mean areal magnification |det dX/ds|; None without light."""
    traced = _tracer(scene, field, heights, POINTS)
    at = {EXIT: heights.detach().double()}
    left, landed = traced.ends(at)[0].state.expanded(), traced.land(at, scene.screen)[0].expanded()
    lit = _lit(landed.power > 0, POINTS)
    left_area, area = (
        float(torch.linalg.det(_jacobian(scene, state.full(state.origin)[:2], POINTS)).abs()[lit].sum()) for state in (left, landed)
    )
    return math.sqrt(area / left_area) if left_area > 0.0 else None


@torch.no_grad()
def ghost_error(scene: Scene, field: HeightField, heights: Tensor) -> float:
    """Estimate of the relative RMS that the ghosts add to the image, of rays that carry their power.

    Power p of a ghost in a cell of area a of the image contributes p^2 / a to the integral of the squared irradiance of that ghost.
    A cell is at least as wide along every axis as that of a lens that is imaged onto a pixel.  The relative RMS of all is at most
    the sum of those of each, which it is where they overlap.
    """
    traced = _tracer(scene, field, heights, GHOSTS, Requests.to("ghosts"))
    direct, *ghosts = traced({EXIT: heights.detach().double()})
    receiver, screen = Receiver.of(traced.system, scene.screen), scene.screen
    least = math.sqrt(math.prod(w / (2.0 * r) for w, r in zip(screen.pixel, scene.pupil.half_size, strict=True)))
    cell = math.prod(2.0 * r / GHOSTS for r in scene.pupil.half_size)

    def landed(state: RayState) -> tuple[Tensor, Tensor, Tensor]:
        """J, power and whether light lands on the screen, of cells."""
        ray = traced.onto(state, screen).expanded()
        x, y = ray.full(ray.origin)[:2]
        on = ray.power > 0
        for c, low, size in zip((x, y), receiver.low, screen.size, strict=True):
            on = on & (c >= low) & (c <= low + size)
        return _jacobian(scene, (x, y), GHOSTS), ray.power.view(GHOSTS, GHOSTS)[:-1, :-1] * cell, _lit(on, GHOSTS)

    _, power, on = landed(direct)
    whole, added = float(power[on].sum()), 0.0
    for state in ghosts:
        by, power, on = landed(state)
        if bool(on.any()):
            stretches = torch.linalg.svdvals(by[on]).clamp_min(least)
            added += math.sqrt(float((power[on].square() / (stretches.prod(-1) * cell)).sum()))
    return math.sqrt(math.prod(screen.size)) * added / whole if whole > 0.0 else 0.0


@torch.no_grad()
def distance(scene: Scene) -> float | None:
    """Displacement on the screen by the tangent of a ray from the middle of the exit, mm: without elements behind the lens the
    distance of the screen; None where the light of the axis does not arrive."""
    bare = replace(scene, elements=tuple(replace(e, free="none", surfaces=(None, None)) for e in scene.elements))
    whole = System.of(bare)
    after = [e.name for e in whole.elements].index(EXIT) + 1
    behind = tuple(replace(e, aperture=Aperture()) for e in whole.elements[after:])
    system = replace(whole, elements=behind, lit=whole.pupil)
    p, q, x = *(TANGENT * torch.eye(3, dtype=torch.float64)[1:]), torch.zeros(3, dtype=torch.float64)
    along = 1.0 / torch.sqrt(1.0 + p * p + q * q)
    start = RayState((x, x, torch.full_like(x, scene.lens.offset.thickness)), (p * along, q * along, along), torch.ones_like(x))
    ray = Tracer(system, start).land({}, scene.screen)[0].expanded()
    if not bool((ray.power > 0).all()):
        return None
    at = torch.stack(ray.full(ray.origin)[:2])
    (a, b), (c, d) = ((at[:, 1:] - at[:, :1]) / TANGENT).tolist()
    return math.sqrt(abs(a * d - b * c))


def _tracer(scene: Scene, field: HeightField, heights: Tensor, points: int, requests: Requests = NO_REQUESTS) -> Tracer:
    """Rays of the source's centre through the points of a grid on the pupil, u first."""
    system = System.of(scene, field)
    line = (torch.arange(points, dtype=torch.float64, device=heights.device) + 0.5) / points
    u, v = (c.reshape(-1) for c in torch.meshgrid(line, line, indexing="ij"))
    return Tracer(system, central_mode(scene).through(u, v, system.object_space.index_at(None)), requests=requests)


def _jacobian(scene: Scene, at: Sequence[Tensor], points: int) -> Tensor:
    """J of points of the grid in the cells between them, (points - 1, points - 1, 2, 2)."""
    x = torch.stack([c.view(points, points) for c in at], -1)
    by = torch.stack([x[1:, :-1] - x[:-1, :-1], x[:-1, 1:] - x[:-1, :-1]], -1)
    return by * (0.5 * points / x.new_tensor(scene.pupil.half_size))


def _lit(lit: Tensor, points: int) -> Tensor:
    """Cells at three corners of which there is light."""
    lit = lit.view(points, points)
    return lit[:-1, :-1] & lit[1:, :-1] & lit[:-1, 1:]
