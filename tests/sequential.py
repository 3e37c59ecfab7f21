"""Sequential ray tracing once more, by other means: NumPy, global coordinates, normals of unit length, bisection.

Nothing here is shared with the package.  A surface is a function of points in its own frame; rays are marched onto it by a sign
change and bisection, and refracted by the law for tangential components.
"""

from __future__ import annotations

import numpy as np


def rotation(tilt) -> np.ndarray:
    """Right-handed turns about x, then about y, degrees: columns are the turned axes."""
    a, b = np.radians(tilt)
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return about_y @ about_x


def meet(o, d, surface, position, tilt, far=20.0):
    """Points (N, 3) where rays (N, 3) cross z = surface(x, y) of a frame, and unit normals there, by bisection over [0, far] mm."""
    turn = rotation(tilt)
    lo, ld = (o - position) @ turn, d @ turn

    def above(t):
        p = lo + t[:, None] * ld
        return p[:, 2] - surface(p[:, 0], p[:, 1])

    low, high = np.zeros(len(o)), np.full(len(o), far)
    begin = np.sign(above(low + 1e-9))
    assert (np.sign(above(high)) != begin).all()
    for _ in range(200):
        middle = 0.5 * (low + high)
        before = np.sign(above(middle)) == begin
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    p, h = lo + high[:, None] * ld, 1e-5
    x, y = p[:, 0], p[:, 1]
    zx = (8 * (surface(x + h, y) - surface(x - h, y)) - surface(x + 2 * h, y) + surface(x - 2 * h, y)) / (12 * h)
    zy = (8 * (surface(x, y + h) - surface(x, y - h)) - surface(x, y + 2 * h) + surface(x, y - 2 * h)) / (12 * h)
    normal = np.stack([-zx, -zy, np.ones_like(zx)], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return p @ turn.T + position, normal @ turn.T, high


def refract(d, normal, n_in, n_out):
    """Snell's law: n times the tangential component is kept."""
    along = np.sum(d * normal, 1, keepdims=True)
    tangential = (d - along * normal) * (n_in / n_out)
    rest = 1.0 - np.sum(tangential**2, 1, keepdims=True)
    assert (rest > 0).all()
    return tangential + np.sign(along) * np.sqrt(rest) * normal


def reflect(d, normal):
    """The normal component changes its sign."""
    return d - 2.0 * np.sum(d * normal, 1, keepdims=True) * normal


def walk(o, d, elements):
    """Rays behind all elements, and their optical path lengths.

    elements: (surface, position, tilt, "reflect") or (surface, position, tilt, n_in, n_out).
    """
    path, index = np.zeros(len(o)), 1.0
    for surface, position, tilt, *what in elements:
        o, normal, t = meet(o, d, surface, np.asarray(position, float), tilt)
        path = path + index * t
        if what == ["reflect"]:
            d = reflect(d, normal)
        else:
            d, index = refract(d, normal, *what), what[1]
    return o, d, path


def onto(o, d, position, tilt=(0.0, 0.0)):
    """Coordinates (N, 2) on a plane's own axes, from its middle."""
    turn = rotation(tilt)
    t = ((np.asarray(position, float) - o) @ turn[:, 2]) / (d @ turn[:, 2])
    p = o + t[:, None] * d - position
    return np.stack([p @ turn[:, 0], p @ turn[:, 1]], 1)
