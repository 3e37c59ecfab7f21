"""Rays through a scene, from the source to the screen: their vertices as the tracer finds them, and a plot.

Notation, N rays through E surfaces
    vertices    (N, E + 2, 3) mm in space: where a ray starts, in the plane of its source's centre, meets each surface, and ends; a
                lost ray repeats its last vertex
    status      of a ray: OK on the screen, or how it was lost, see `RayStatus`; OFF_SCREEN beside the screen

Between vertices rays are drawn straight, also in glass whose index varies.  Stray light is not drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.io.files import SOFTWARE, atomic_file
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.rays import RayState, RayStatus
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import FEW, Tracer, tracers
from caustic_cli.scene import Scene, Source

#: Most rays: more are not told apart.
MOST = 2000
#: Status of a ray that arrives in the plane of the screen, beside it.
OFF_SCREEN = 1 + max(RayStatus)
#: Names of the ways in which rays are lost, in JSON and in the legend.
WAYS = {
    RayStatus.MISSED_SURFACE: "missed_surface",
    RayStatus.TOTAL_INTERNAL_REFLECTION: "total_internal_reflection",
    RayStatus.AWAY_FROM_SCREEN: "away_from_screen",
    OFF_SCREEN: "off_screen",
}
#: Length by which light from infinity is drawn before the first surface, and a ray that leaves without an end, as a fraction of the
#: distance between the first surface and the screen.
STUB = 0.15
#: Cosine to the normal of a plane below which a ray is not continued to it.
GRAZING = 0.1
#: Ratio of their extents along x and y from which rays are seen from above instead of from the side.
FROM_ABOVE = 2.0
#: Colours of rays on the screen and of lost ones.
ARRIVED, LOST = "#3a6ea5", "#d1495b"


@dataclass(frozen=True)
class Paths:
    """Rays through a scene; see the module."""

    vertices: np.ndarray
    #: (N,) int.
    status: np.ndarray
    #: (4, 3) mm, corners of the screen in order around it.
    screen: np.ndarray

    @property
    def lost(self) -> np.ndarray:
        """(N,) whether a ray does not reach the screen."""
        return self.status != RayStatus.OK

    @property
    def figures(self) -> dict[str, object]:
        """rays: their number; lost: how many do not reach the screen; lost_by: of these, by the way."""
        by = {name: int((self.status == code).sum()) for code, name in WAYS.items()}
        return {"rays": len(self.status), "lost": int(self.lost.sum()), "lost_by": {k: n for k, n in by.items() if n}}


def check_count(count: int) -> None:
    """Refuse a number of rays that cannot be drawn.

    Raises:
        InputError: it is not 1 to MOST.
    """
    if not 1 <= count <= MOST:
        raise InputError(f"⟨rays_plot⟩ must be 1 to {MOST} rays, got {count}")


def trace_paths(
    scene: Scene, field: HeightField, heights: Tensor, count: int, seed: int = 0, requests: Requests = NO_REQUESTS
) -> Paths:
    """The paths of at most `count` rays of a scene's source, of all its wavelengths; heights: (n, m) mm.

    Raises:
        InputError: the number of rays is not 1 to MOST.
    """
    check_count(count)
    sampler = rays_of(scene, "sobol", (math.isqrt(count) + 1) ** 2, seed)  # a sampler in rows and columns may take fewer
    made = tracers(scene, field, sampler, torch.float64, FEW, requests, track=True)
    found = list(_traced(made, {EXIT: heights.detach().cpu()}, scene))
    vertices, status = (np.concatenate(part) for part in zip(*(one[:2] for one in found), strict=True))
    kept = np.unique(np.linspace(0, len(status) - 1, min(count, len(status))).round().astype(int))
    return Paths(vertices[kept], status[kept], found[0][2])


@torch.no_grad()
def _traced(made: Iterator[Tracer], parameters: dict[str, Tensor], scene: Scene) -> Iterator[tuple[np.ndarray, ...]]:
    """Vertices, statuses and corners of the screen, of each tracer."""
    for tracer in made:
        emitted, interactions = tracer.emitted.expanded(), tracer.interactions(parameters)
        receiver = Receiver.of(tracer.system, scene.screen)
        points, direction = [_points(emitted)], _vectors(emitted, emitted.direction)
        status = np.zeros(len(points[0]), np.int64)
        length = STUB * float(np.linalg.norm(np.subtract(receiver.middle, tracer.system.elements[0].pose.position)))
        points[0] = points[0] - _run_up(tracer.system.source, points[0], direction, length) * direction
        for m in interactions:
            state, before = m.state.expanded(), points[-1]
            now = np.where(status == RayStatus.OK, state.statuses().numpy(), status)
            met = _points(state)[now == RayStatus.OK]
            middle = met.mean(0) if len(met) else np.array(m.element.pose.position)
            missed = _to_plane(before, direction, middle, np.array(m.element.pose.axes[2]))
            hit = np.where((now == RayStatus.MISSED_SURFACE)[:, None], missed, _points(state))
            points.append(np.where((status == RayStatus.OK)[:, None], hit, before))
            status = now
            direction = np.where((status == RayStatus.OK)[:, None], _vectors(state, state.direction), direction)
        landed = tracer.onto(interactions[-1].state, scene.screen)
        end, beside = _in_space(receiver, landed)
        now = np.where(status == RayStatus.OK, landed.statuses().numpy(), status)
        end = np.where((now == RayStatus.AWAY_FROM_SCREEN)[:, None], points[-1] + length * direction, end)
        points.append(np.where((status == RayStatus.OK)[:, None], end, points[-1]))
        corners = np.array(receiver.corners())[[0, 1, 3, 2]]
        yield np.stack(points, 1), np.where((now == RayStatus.OK) & beside, OFF_SCREEN, now), corners


def _to_plane(points: np.ndarray, direction: np.ndarray, middle: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Where rays that miss a surface pass the plane through its middle, (N, 3) mm; the points of those that run along it."""
    slant = direction @ normal
    t = np.where(np.abs(slant) > GRAZING, (middle - points) @ normal / np.where(slant == 0.0, 1.0, slant), 0.0)
    return points + np.maximum(t, 0.0)[:, None] * direction


def _run_up(source: Source, points: np.ndarray, direction: np.ndarray, length: float) -> np.ndarray | float:
    """Distance of points (N, 3) mm on rays from where these start, (N, 1) mm: the plane of the source's centre, or, of light from
    infinity, `length`."""
    if source.distant:
        return length
    return np.maximum(points[:, 2:] - source.centre[2], 0.0) / direction[:, 2:]


def _vectors(state: RayState, vector: Sequence) -> np.ndarray:
    """A vector of a ray state, (N, 3)."""
    return np.stack([c.double().cpu().numpy() for c in state.full(tuple(vector))], 1)


def _points(state: RayState) -> np.ndarray:
    """The origins of rays in space, (N, 3) mm."""
    return _vectors(state, state.origin) + np.array([0.0, 0.0, state.datum])


def _in_space(receiver: Receiver, landed: RayState) -> tuple[np.ndarray, np.ndarray]:
    """Landing points in space, (N, 3) mm, and whether they lie beside the pixels, (N,)."""
    xy = _vectors(landed, landed.origin)[:, :2] - receiver.at
    low = np.array(receiver.low)
    high = low + np.multiply(receiver.pixel, receiver.resolution)
    local = np.column_stack([xy, receiver.shape.at(*xy.T)[0]])
    return np.array(receiver.middle) + local @ np.array(receiver.axes), ((xy < low) | (xy > high)).any(1)


def seen_across(paths: Paths) -> int:
    """The axis, 0 for x or 1 for y, that is drawn over z: y, unless rays and screen extend `FROM_ABOVE` times as far along x, as
    where a mirror folds them that way."""
    spans = np.ptp(np.concatenate([paths.vertices.reshape(-1, 3), paths.screen]), axis=0)
    return int(spans[0] < FROM_ABOVE * spans[1])


def _opacity(rays: int) -> float:
    """Opacity of each of so many lines of one colour: where many lie over each other it shows how many."""
    return float(np.clip(45.0 / max(rays, 1), 0.04, 0.9))


def write_plot(path: Path, paths: Paths) -> None:
    """Write a PNG: the side view of all (`seen_across`), that of the surfaces, and all in three dimensions, with landing points."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415
    from mpl_toolkits.mplot3d.art3d import Line3DCollection  # noqa: PLC0415

    figure = Figure(figsize=(14.4, 7.2), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    whole, near = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    space = figure.add_subplot(grid[:, 1], projection="3d")
    f = paths.figures
    surfaces = paths.vertices[np.isin(paths.status, (RayStatus.OK, OFF_SCREEN))][:, 1:-1].reshape(-1, 3)
    edge, across = np.concatenate([paths.screen, paths.screen[:1]]), seen_across(paths)
    for lost, colour, label in ((False, ARRIVED, "on the screen"), (True, LOST, "lost")):
        rays = paths.vertices[paths.lost == lost]
        style = {"colors": colour, "linewidths": 0.7, "alpha": _opacity(len(rays))}
        for axis in (whole, near):
            axis.add_collection(LineCollection(list(rays[:, :, [2, across]]), **style))
        if len(rays):
            space.add_collection3d(Line3DCollection(list(rays[:, :, [2, 0, 1]]), **style))
            landed = rays[np.isin(paths.status[paths.lost == lost], (RayStatus.OK, OFF_SCREEN)), -1]
            space.scatter(*landed[:, [2, 0, 1]].T, s=4, color=colour, linewidths=0, depthshade=False)
        whole.plot([], [], color=colour, label=f"{label}: {len(rays)}")
    for axis in (whole, near):
        axis.plot(surfaces[:, 2], surfaces[:, across], ".", color="0.25", markersize=2)
        axis.plot(edge[:, 2], edge[:, across], color="black", linewidth=2)
        axis.set(xlabel="z (mm)", ylabel=f"{'xy'[across]} (mm)")
    whole.autoscale_view()
    whole.set_title(("view from above", "side view")[across], loc="left")
    whole.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    meets = surfaces if len(surfaces) else paths.vertices[:, 1]
    low, high = meets.min(0), meets.max(0)
    room = 0.15 * (high - low) + 0.1 * (high - low).max() + 1e-3
    near.set_title("at the surfaces, to scale", loc="left")
    near.set(xlim=(low[2] - room[2], high[2] + room[2]), ylim=(low[across] - room[across], high[across] + room[across]))
    near.set_aspect("equal", adjustable="datalim")
    space.plot(edge[:, 2], edge[:, 0], edge[:, 1], color="black", linewidth=1.5)
    space.scatter(surfaces[:, 2], surfaces[:, 0], surfaces[:, 1], s=1, color="0.25")
    every = np.concatenate([paths.vertices.reshape(-1, 3), edge])
    low, high = every.min(0), every.max(0)
    space.set(xlim=(low[2], high[2]), ylim=(low[0], high[0]), zlim=(low[1], high[1]))
    space.set(ylabel="x (mm)", zlabel="y (mm)", title=f"{f['rays']} rays, {f['lost']} lost")
    space.set_xlabel("z (mm)", labelpad=18.0)
    space.set_box_aspect((2.0, 1.0, 1.0))
    with atomic_file(path) as file:
        figure.savefig(file, format="png", metadata={"Software": SOFTWARE})
