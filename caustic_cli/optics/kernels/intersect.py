"""CPU kernels: ray-surface intersection with a height field, ray by ray (thesis 4.3.2).

Notation, in (u, v, z)-space (eq. 4.3.2)
    f(t) = o_z + t d_z - Z(o_u + t d_u, o_v + t d_v), negative below the surface
    c    = f'(t) = d_z - Z_u d_u - Z_v d_v, at the hit the cosine of incidence times |N|
    L    bound of |Z_u| |d_u| + |Z_v| |d_v| from the derivative's control net: d_z - L <= c <= d_z + L

A ray with L < d_z intersects the surface once: Newton's method, safeguarded by bisection of a bracket.  For any other ray the first
root is isolated beforehand.  `batches` processes the regular rays of a bundle together, and differentiates.
"""

from __future__ import annotations

import numpy as np

from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.spline import jet, place
from caustic_cli.optics.kernels.threads import on_threads
from caustic_cli.optics.tolerances import FEW_ULP, FINEST, MOST_PROBES, MOST_STEPS

HIT, MISSED, UNRESOLVED = 0, 1, 2
#: Half width of the first search interval around the intersection with a mesh, relative to the path through the box.
NEAR = 1e-3


@njit(inline="always", **FAST)
def value_at(c, u, v, pieces):
    """Z, Z_u, Z_v at (u, v)."""
    i, j, xi, eta = place(u, v, pieces)
    z, z_xi, z_eta, _, _, _ = jet(c, i, j, xi, eta)
    return z, z_xi * pieces.over_u[i], z_eta * pieces.over_v[j]


@njit(inline="always", **FAST)
def _leaves(o, d):
    """The t at which a coordinate leaves [0, 1]."""
    if d > 0.0:
        return (1.0 - o) / d
    return o / -d if d < 0.0 else np.inf


@njit(**FAST)
def _first_bracket(low, high, f_low, ray, slope, c, pieces):
    """(a, b, found): f(a) < 0 <= f(b) around the first root in [low, high], or none (found 0), or undecided (2).

    No root lies between a and b if the two lines that bound f, with slope d_z + L from a and d_z - L from b, stay below 0.
    """
    ou, ov, oz, du, dv, dz = ray
    rise, fall = dz + slope, dz - slope
    least = FINEST * (high - low)
    a, f_a, step = low, f_low, high - low
    for _ in range(MOST_PROBES):
        b = min(a + step, high)
        z, _, _ = value_at(c, ou + b * du, ov + b * dv, pieces)
        f_b = oz + b * dz - z
        if f_b < 0.0:
            across = (f_b - f_a - fall * (b - a)) / (rise - fall)
            if step <= least or f_a + rise * across < 0.0:
                if b >= high:
                    return a, b, 0
                a, f_a, step = b, f_b, 2.0 * step
                continue
        elif step <= least:
            return a, b, 1
        step = max(0.5 * (b - a), 0.999 * least)
    return a, high, 2


@njit(**FAST)
def _bracket_around(start, low, high, ray, c, pieces):
    """(a, b, found): the narrowest of ever wider intervals around `start` with f(a) < 0 <= f(b), inside [low, high]."""
    ou, ov, oz, du, dv, dz = ray
    reach = NEAR * (high - low)
    while True:
        a, b = max(low, start - reach), min(high, start + reach)
        z_a, _, _ = value_at(c, ou + a * du, ov + a * dv, pieces)
        z_b, _, _ = value_at(c, ou + b * du, ov + b * dv, pieces)
        if oz + a * dz < z_a and oz + b * dz >= z_b:
            return a, b, 1
        if a <= low and b >= high:
            return a, b, 0
        reach *= 4.0


@njit(**FAST)
def _root(ray, start, limits, slope, c, pieces):
    """(t, status) of the first intersection.  limits: least and largest height; start: estimate of t, negative if unknown."""
    ou, ov, oz, du, dv, dz = ray
    z_low, z_high = limits
    if not (ou >= 0.0 and ou <= 1.0 and ov >= 0.0 and ov <= 1.0 and dz > 0.0):
        return 0.0, MISSED
    side = min(_leaves(ou, du), _leaves(ov, dv))
    low, high = max(0.0, (z_low - oz) / dz), min(side, (z_high - oz) / dz)
    closed = high < side  # the top of the hull lies inside the aperture: f >= 0 there
    if low > high:
        return 0.0, MISSED
    safe, f_low = slope < dz, -1.0
    opened = not (safe and start < 0.0 and low > 0.0)  # otherwise f <= 0 at low: looked at if the iteration comes there
    if opened:
        z, _, _ = value_at(c, ou + low * du, ov + low * dv, pieces)
        f_low = oz + low * dz - z
        if f_low >= 0.0:  # on the hull's floor, which the surface then touches; or the ray begins above the surface
            return low, HIT if low > 0.0 or f_low == 0.0 else MISSED
    if start >= 0.0:
        low, high, found = _bracket_around(min(max(start, low), high), low, high, ray, c, pieces)
        if found == 0:
            return 0.0, MISSED
        closed = True
    elif not safe:
        low, high, found = _first_bracket(low, high, f_low, ray, slope, c, pieces)
        if found != 1:
            return 0.0, MISSED if found == 0 else UNRESOLVED
        closed = True
    t = start if start >= 0.0 else (0.5 * (z_low + z_high) - oz) / dz
    t = min(max(t, low), high)
    size = max(abs(z_low), abs(z_high))
    size = max(size, abs(oz))
    close, narrow = FEW_ULP * size, FEW_ULP * max(high, size)
    for _ in range(MOST_STEPS):
        z, zu, zv = value_at(c, ou + t * du, ov + t * dv, pieces)
        f = oz + t * dz - z
        if f < 0.0:
            low, opened = t, True
        else:
            high, closed = t, True
        step = f / (dz - zu * du - zv * dv)
        if (abs(f) <= close and abs(step) <= narrow) or high - low <= narrow:
            if not closed and high - t <= narrow and f < -close:
                return 0.0, MISSED
            return t, HIT
        t -= step
        if t >= high and not closed:  # does the surface reach that far at all?
            z, _, _ = value_at(c, ou + high * du, ov + high * dv, pieces)
            if oz + high * dz - z < 0.0:
                return 0.0, MISSED
            closed = True
        if t <= low and not opened:  # does the surface touch the hull's floor there?
            z, _, _ = value_at(c, ou + low * du, ov + low * dv, pieces)
            if oz + low * dz - z >= 0.0:
                return low, HIT
            opened = True
        if not (t > low and t < high):
            t = 0.5 * (low + high)
    return t, UNRESOLVED


@njit(entry=True, **FAST)
def intersect_again(block, rays, side, limits, slopes, round_, step, halvings, most, c, pieces, t, blocks):
    """Next intersections of rays (N,) that start on the surface, into t (N,), 0 for none: the search of `reintersection.reference`.

    side: 1 above the surface, -1 under it; limits: least and largest control height; slopes: bounds of |Z_u| and |Z_v|; round_:
    the surface ends at the circle inscribed in its aperture; step, halvings, most: least step (mm), bisections of the last one and
    most steps.
    """
    if on_threads(block, blocks, (rays, side, limits, slopes, round_, step, halvings, most, c, pieces, t, blocks)):
        return
    ou, ov, oz, du, dv, dz = rays
    count, highest = len(ou), limits[1] if side > 0.0 else -limits[0]
    for k in range(block * count // blocks, (block + 1) * count // blocks):
        t[k] = 0.0
        rise = side * dz[k] - slopes[0] * abs(du[k]) - slopes[1] * abs(dv[k])
        if rise > 0.0:  # the ray rises faster than the surface can
            continue
        before, after, f = 0.0, 1e-3 * step, 0.0
        for probe in range(most):
            u, v, z = ou[k] + after * du[k], ov[k] + after * dv[k], oz[k] + after * dz[k]
            across = (u - 0.5) ** 2 + (v - 0.5) ** 2 if round_ else max(abs(u - 0.5), abs(v - 0.5)) ** 2
            if not across <= 0.25 or (side * dz[k] > 0.0 and side * z > highest):
                break
            f = side * (z - value_at(c, u, v, pieces)[0])
            if f <= 0.0:
                if probe > 0:
                    t[k] = after
                break
            before, after = after, after + max(f / -rise, step)
        if t[k] > 0.0:
            for _ in range(halvings):
                middle = 0.5 * (before + after)
                z = value_at(c, ou[k] + middle * du[k], ov[k] + middle * dv[k], pieces)[0]
                if side * (oz[k] + middle * dz[k] - z) > 0.0:
                    before = middle
                else:
                    after = middle
            t[k] = after
