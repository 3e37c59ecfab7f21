"""Rays that arrive behind other lenses and mirrors at given points in given directions, as straight lines behind the lens.

A ray that leaves the lens at (x, y) of a plane across the axis with tangents (q_x, q_y) arrives, traced through the elements
behind the lens, at u = (X, Y, s_x, s_y): coordinates at the z of a point, and slopes, along the folded axis.  (x, y, q_x, q_y)
follow from u by Newton's method, beginning with the first order at the axis, with finite-difference derivatives.  These are those
of a symplectic map, and so never singular.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import AIR, directions
from caustic_cli.inverse.relay import UNSEEN, RelayedScreen, trace_through
from caustic_cli.optics.frames import AxisSegment
from caustic_cli.optics.system import System
from caustic_cli.scene import Scene

#: Finite-difference steps of coordinates, mm, and tangents; most iterations, and their tolerance, mm and slope.
STEPS, NEWTON, LEFT = (1e-4, 1e-4, 1e-6, 1e-6), 8, (1e-6, 1e-9)


def lines_behind(scene: Scene, points: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The straight lines behind the lens of the rays that arrive at points (3, ...), mm, with slopes (2, ...), both along the
    folded axis: a point on each, (3, ...) mm, at the distance of the screen as if there were no elements, and its slopes.

    Raises:
        InputError: the axial ray does not arrive, or most of these rays cannot.
    """
    if not scene.behind:
        return points, slopes
    vertex = scene.lens.offset.thickness
    system = RelayedScreen(scene, vertex).system
    z, goal = points[2].ravel(), np.concatenate([points[:2].reshape(2, -1), slopes.reshape(2, -1)])
    steps = np.concatenate([np.zeros((4, 1)), np.diag(STEPS)], 1)[:, :, None]  # (4, 5, 1)
    axial = _arriving(system, vertex, steps, np.full(1, scene.screen.z))
    if not np.isfinite(axial).all():
        raise InputError(UNSEEN)
    found = np.linalg.solve(_jacobian(axial)[0], (goal - axial[:, 0]))
    for _ in range(NEWTON):
        arriving = _arriving(system, vertex, found[:, None] + steps, z)  # (4, 5, N)
        off = goal - arriving[:, 0]
        known = np.isfinite(arriving).all((0, 1))
        found[:, known] += np.linalg.solve(_jacobian(arriving[..., known]), off[:, known].T[..., None])[..., 0].T
        if known.mean() < 0.5:
            raise InputError("[[element]] light of most of the picture would have to come from beside the other elements")
        if (np.abs(off[:, known]).max(1) <= np.repeat(LEFT, 2)).all():
            break
    ahead = scene.screen.z - vertex
    lines = np.stack([*(found[:2] + ahead * found[2:]), np.full(found.shape[1], scene.screen.z)])
    return lines.reshape(points.shape), found[2:].reshape(slopes.shape)


def undeviated_ray(scene: Scene) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Where light of the source's centre through the middle of the lens, which does not deviate it, meets the plane at the screen's
    z of the folded axis, mm, and its direction there, of any length.

    Raises:
        InputError: it does not arrive.
    """
    vertex = scene.lens.z_in
    found = directions(replace(scene, lens=replace(scene.lens, **AIR)), np.array([[0.0], [0.0], [vertex]]))[0]
    x, y = (AIR["index"] * float(c) for c in found[:2, 0])
    along = math.sqrt(1.0 - x * x - y * y)
    p, q, ahead = x / along, y / along, scene.screen.z - vertex
    if not scene.behind:
        return (ahead * p, ahead * q), (p, q, 1.0)
    leaving, system = np.array([0.0, 0.0, p, q])[:, None, None], RelayedScreen(scene, vertex).system
    at_x, at_y, p, q = (float(c) for c in _arriving(system, vertex, leaving, np.full(1, scene.screen.z)).ravel())
    if not math.isfinite(at_x + at_y + p + q):
        raise InputError(UNSEEN)
    return (at_x, at_y), (p, q, 1.0)


def _arriving(system: System, vertex: float, leaving: np.ndarray, z: np.ndarray) -> np.ndarray:
    """u (4, 5, N) at heights z (N,) of the folded axis, mm, of rays that leave the plane at `vertex` mm by (x, y, q_x, q_y), of the
    same shape; NaN for those that do not arrive."""
    x, y, p, q = leaving
    length = np.sqrt(1.0 + p * p + q * q)
    state = trace_through(system, (x, y, np.full(x.shape, vertex)), (p / length, q / length, 1.0 / length))
    ends, ways = (np.stack([c.double().numpy() for c in state.full(v)]) for v in (state.origin, state.direction))
    ends[2] += np.asarray(state.datum)
    leg = system.leg or AxisSegment()
    frame = np.array(leg.frame)
    a, b = frame @ (ends - np.array(leg.origin)[:, None]), frame @ ways
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where((b[2] > 0) & (state.expanded().power.numpy() > 0), b[:2] / b[2], np.nan)
    landed = a[:2] + (np.broadcast_to(z, x.shape).ravel() - a[2]) * s
    return np.concatenate([landed, s]).reshape(4, *x.shape)


def _jacobian(arriving: np.ndarray) -> np.ndarray:
    """Derivatives (N, 4, 4) of u by what leaves, from values (4, 5, N)."""
    return np.moveaxis((arriving[:, 1:] - arriving[:, :1]) / np.array(STEPS)[:, None], 2, 0)
