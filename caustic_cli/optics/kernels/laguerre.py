"""Laguerre cells (power diagram) of point masses over a rectangle: adjacency from a raster, areas and borders by polygon clipping.

Notation
    y_p, psi_p    site p and its price, mm and mm^2;  phi(x) = max_p (x . y_p - psi_p), convex and piecewise linear
    cell of p     where the maximum is attained by p: a convex polygon of the source rectangle (Aurenhammer 1987)
    row           sites sit on rows y_1 = const and are sorted by y_2 in each: then both Legendre transforms split into one
                  pass along each axis, each linear in the points it reads and writes (Lucet, Numer. Algorithms 16, 1997)

Two cells are neighbours when they share a side or a corner of the raster.  A border much shorter than the raster's pitch is
missed, which adds at most a quarter of its square to either area.
"""

from __future__ import annotations

import numpy as np

from caustic_cli.optics.kernels.jit import njit
from caustic_cli.optics.kernels.threads import ALL, on_threads

BESIDE = ((0, 1), (1, 0), (1, 1), (1, -1))  # points of a raster that are compared with each
MISSED = 16  # cuts added to a cell after those of its neighbours on the raster
REACH = 4  # of a step of `climbed`, points of the raster
TASKS = 32  # parts of the sites, in each of which cells are cut by one thread


@njit(nogil=True)
def _line(y, f, n, x, value, place, hull):
    """value[r] = max_j<n (x[r] y[j] - f[j]), place[r] the index; y and x ascend, f may be infinite."""
    top = 0
    for j in range(n):
        if f[j] == np.inf:
            continue
        while top > 0:  # the lower convex hull of (y, f)
            b = hull[top - 1]
            if y[j] <= y[b]:
                if f[j] >= f[b]:
                    break
                top -= 1
                continue
            if top == 1:
                break
            a = hull[top - 2]
            if (f[b] - f[a]) * (y[j] - y[b]) < (f[j] - f[b]) * (y[b] - y[a]):
                break
            top -= 1
        if top > 0 and y[j] <= y[hull[top - 1]]:
            continue
        hull[top] = j
        top += 1
    if top == 0:
        value[:] = -np.inf
        place[:] = -1
        return
    k = 0
    for r in range(len(x)):
        while k + 1 < top and f[hull[k + 1]] - f[hull[k]] <= x[r] * (y[hull[k + 1]] - y[hull[k]]):
            k += 1
        value[r] = x[r] * y[hull[k]] - f[hull[k]]
        place[r] = hull[k]


def envelope(psi, rows, first, y2, x1, x2):
    """phi and the site that attains it on a raster.

    Args:
        psi: (N,) prices, y2: (N,) second coordinates; sites first[i]..first[i + 1] are on row rows[i], y2 ascending.
        x1 (n,), x2 (m,): the raster, ascending.

    Returns:
        phi (n, m), site (n, m) int32.
    """
    n, m, k = len(x1), len(x2), len(rows)
    phi, site = np.empty((n, m)), np.empty((n, m), np.int32)
    _envelope(ALL, False, psi, rows, first, y2, x1, x2, np.empty((m, k)), np.empty((m, k), np.int32), phi, site)
    return phi, site


@njit(entry=True, nogil=True)
def _envelope(i, across, psi, rows, first, y2, x1, x2, part, who, phi, site):
    """Row i, or then the strip i across all rows, of `envelope`."""
    n, m, k = len(x1), len(x2), len(rows)
    if i == ALL:
        on_threads(ALL, k, (False, psi, rows, first, y2, x1, x2, part, who, phi, site))
        on_threads(ALL, (m + 15) // 16, (True, psi, rows, first, y2, x1, x2, part, who, phi, site))
        return
    if across:
        value, place, hull = np.empty((16, n)), np.empty((16, n), np.int32), np.empty(k, np.int32)
        low, high = 16 * i, min(16 * i + 16, m)
        for r in range(low, high):
            _line(rows, part[r], k, x1, value[r - low], place[r - low], hull)
        for j in range(n):
            for r in range(low, high):
                phi[j, r], site[j, r] = value[r - low, j], who[r, place[r - low, j]]
        return
    a, b = first[i], first[i + 1]
    value, place, hull = np.empty((1, m)), np.empty((1, m), np.int32), np.empty(b - a, np.int32)
    _line(y2[a:b], psi[a:b], b - a, x2, value[0], place[0], hull)
    for r in range(m):
        part[r, i], who[r, i] = -value[0, r], a + place[0, r]


def prices(phi, rows, first, y2, x1, x2):
    """The Legendre transform back: psi_p = max over the raster of x . y_p - phi(x), (N,), and where: index i m + j, (N,)."""
    m, k = len(x2), len(rows)
    psi, at = np.empty(len(y2)), np.empty(len(y2), np.int64)
    _prices(ALL, False, phi, rows, first, y2, x1, x2, np.empty((k, m)), np.empty((k, m), np.int32), psi, at)
    return psi, at


@njit(entry=True, nogil=True)
def _prices(i, across, phi, rows, first, y2, x1, x2, part, which, psi, at):
    """Column i of the raster, or then the row i of sites, of `prices`."""
    n, m, k = len(x1), len(x2), len(rows)
    if i == ALL:
        on_threads(ALL, m, (False, phi, rows, first, y2, x1, x2, part, which, psi, at))
        on_threads(ALL, k, (True, phi, rows, first, y2, x1, x2, part, which, psi, at))
        return
    if across:
        a, b = first[i], first[i + 1]
        value, place, hull = np.empty(b - a), np.empty(b - a, np.int32), np.empty(m, np.int32)
        _line(x2, part[i], m, y2[a:b], value, place, hull)
        for p in range(a, b):
            psi[p], at[p] = value[p - a], which[i, place[p - a]] * m + place[p - a]
        return
    value, place, hull = np.empty(k), np.empty(k, np.int32), np.empty(n, np.int32)
    _line(x1, phi[:, i].copy(), n, rows, value, place, hull)
    for j in range(k):
        part[j, i], which[j, i] = -value[j], place[j]


def walked(y1, y2, psi, first, other, begin, x1, x2):
    """phi and site on a raster, as of `envelope`, of sites anywhere, by walks from neighbour to neighbour.

    Args:
        y1, y2, psi: (N,) coordinates and prices; the neighbours of p are other[first[p]..first[p + 1]].
        begin: a site that has neighbours.
    """
    phi, site = np.empty((len(x1), len(x2))), np.empty((len(x1), len(x2)), np.int32)
    _walked(ALL, y1, y2, psi, first, other, begin, x1, x2, phi, site)
    return phi, site


@njit(entry=True, nogil=True)
def _walked(i, y1, y2, psi, first, other, begin, x1, x2, phi, site):
    """Row i of `walked`."""
    if on_threads(i, len(x1), (y1, y2, psi, first, other, begin, x1, x2, phi, site)):
        return
    p = begin
    for j in range(len(x2)):
        best, there = x1[i] * y1[p] + x2[j] * y2[p] - psi[p], p
        while True:
            for e in range(first[p], first[p + 1]):
                q = other[e]
                value = x1[i] * y1[q] + x2[j] * y2[q] - psi[q]
                if value > best:
                    best, there = value, q
            if there == p:
                break
            p = there
        phi[i, j], site[i, j] = best, p


@njit(entry=True, nogil=True)
def linked(first, other, sites):
    """As of `borders`, of the first `sites` of those whose neighbours are given as for `walked`."""
    head, degree = np.full(sites, -1, np.int32), np.zeros(sites, np.int32)
    link, end = np.empty(len(other), np.int32), np.empty(len(other), np.int32)
    count = 0
    for p in range(sites):
        for e in range(first[p], first[p + 1]):
            q = other[e]
            if p < q < sites:
                end[count], link[count], head[p] = q, head[p], count
                end[count + 1], link[count + 1], head[q] = p, head[q], count + 1
                degree[p] += 1
                degree[q] += 1
                count += 2
    return head, link[:count], end[:count], degree


def climbed(phi, y1, y2, x1, x2, begin):
    """psi_p and where, as of `prices`, by climbing x . y_p - phi(x), which is concave, from a point of the raster near it.

    Args:
        begin: (N,) indices i m + j.
    """
    psi, at = np.empty(len(y1)), begin.copy()
    _climbed(ALL, phi, y1, y2, x1, x2, psi, at)
    return psi, at


@njit(entry=True, nogil=True)
def _climbed(task, phi, y1, y2, x1, x2, psi, at):
    """`climbed` for one of TASKS parts of the sites."""
    if on_threads(task, TASKS, (phi, y1, y2, x1, x2, psi, at)):
        return
    n, m = phi.shape
    for p in range(task * len(psi) // TASKS, (task + 1) * len(psi) // TASKS):
        best, there, middle = -np.inf, at[p], np.int64(-1)
        while there != middle:
            middle = there
            i, j = middle // m, middle % m
            for k in range(max(i - REACH, 0), min(i + REACH + 1, n)):
                for r in range(max(j - REACH, 0), min(j + REACH + 1, m)):
                    value = x1[k] * y1[p] + x2[r] * y2[p] - phi[k, r]
                    if value > best:
                        best, there = value, k * m + r
        psi[p], at[p] = best, there


@njit(entry=True, nogil=True)
def averages(i, phi, site, y1, y2, weights, step, low, out):
    """Weighted averages of phi and its gradient over squares of a raster, at every `step`-th of its points.

    Args:
        i: a row of the averages, or ALL.
        phi, site: of `envelope`; y1, y2: (N,) coordinates of the sites.
        weights: (k,) along either axis; low: of the first square, along the first axis; it begins with the second.
        out: (3, n, m) to be filled.
    """
    n, m = out.shape[1:]
    if on_threads(i, n, (phi, site, y1, y2, weights, step, low, out)):
        return
    count = len(weights)
    sums = np.zeros((3, step * (m - 1) + count))
    for k in range(count):
        w, r = weights[k], low + step * i + k
        for q in range(sums.shape[1]):
            p = site[r, q]
            sums[0, q] += w * phi[r, q]
            sums[1, q] += w * y1[p]
            sums[2, q] += w * y2[p]
    for c in range(3):
        for j in range(m):
            mean = 0.0
            for k in range(count):
                mean += weights[k] * sums[c, step * j + k]
            out[c, i, j] = mean


@njit(nogil=True)
def _join(p, q, head, link, end, degree, count):
    """Note the border of p and q, unless it is known; half-borders 2 e and 2 e + 1 belong to the two sides."""
    a, b = (p, q) if degree[p] <= degree[q] else (q, p)
    e = head[a]
    while e >= 0:
        if end[e] == b:
            return count
        e = link[e]
    end[count], link[count], head[p] = q, head[p], count
    end[count + 1], link[count + 1], head[q] = p, head[q], count + 1
    degree[p] += 1
    degree[q] += 1
    return count + 2


@njit(entry=True, nogil=True)
def borders(site, sites):
    """Neighbours in a raster of cells, as linked lists of half-borders; site: -1 outside the source.

    Returns:
        head (N,): a site's first half-border or -1; link: the next one; end: the site on its other side; degree (N,).
    """
    n, m = site.shape
    head, degree = np.full(sites, -1, np.int32), np.zeros(sites, np.int32)
    room = 16 * sites + 64
    link, end = np.empty(room, np.int32), np.empty(room, np.int32)
    count = np.int64(0)  # of a type: for a constant `_join` would be compiled once more
    for i in range(n):
        for j in range(m):
            p = site[i, j]
            if p < 0:
                continue
            for k in range(4):
                i1, j1 = i + BESIDE[k][0], j + BESIDE[k][1]
                if i1 < n and 0 <= j1 < m and site[i1, j1] >= 0 and site[i1, j1] != p and count + 8 < room:
                    count = _join(p, site[i1, j1], head, link, end, degree, count)
    return head, link[:count], end[:count], degree


@njit(nogil=True)
def _clip(px, py, owner, n, ax, ay, c, q, qx, qy, qowner):
    """The part of a convex polygon where ax x + ay y <= c; side k runs from vertex k to k + 1 and has an owner."""
    out = 0
    for k in range(n):
        k1 = k + 1 if k + 1 < n else 0
        d0, d1 = ax * px[k] + ay * py[k] - c, ax * px[k1] + ay * py[k1] - c
        if d0 <= 0.0:
            qx[out], qy[out], qowner[out] = px[k], py[k], owner[k]
            out += 1
        if (d0 <= 0.0) != (d1 <= 0.0):
            t = d0 / (d0 - d1)
            qx[out], qy[out] = px[k] + t * (px[k1] - px[k]), py[k] + t * (py[k1] - py[k])
            qowner[out] = q if d0 <= 0.0 else owner[k]
            out += 1
    return out


@njit(nogil=True)
def _area(px, py, n):
    """Area of a convex polygon of n vertices, counterclockwise."""
    area = 0.0
    for k in range(1, n - 1):
        area += 0.5 * ((px[k] - px[0]) * (py[k + 1] - py[0]) - (px[k + 1] - px[0]) * (py[k] - py[0]))
    return area


@njit(nogil=True)
def density(f, x, y, a, b):
    """Bilinear value at (x, y) of the cell values f over [-a, a] x [-b, b]."""
    n, m = f.shape
    u = min(max((x + a) * (0.5 * n / a) - 0.5, 0.0), n - 1.0)
    v = min(max((y + b) * (0.5 * m / b) - 0.5, 0.0), m - 1.0)
    i, j = min(int(u), max(n - 2, 0)), min(int(v), max(m - 2, 0))
    i1, j1 = min(i + 1, n - 1), min(j + 1, m - 1)
    u, v = u - i, v - j
    return (f[i, j] * (1 - u) + f[i1, j] * u) * (1 - v) + (f[i, j1] * (1 - u) + f[i1, j1] * u) * v


def sampled(f, x1, x2, a, b):
    """Bilinear values of f on a raster, (n, m); (1, 1) where f is one constant."""
    return f.copy() if f.size == 1 else _sampled(f, x1, x2, a, b)


@njit(entry=True, nogil=True)
def _sampled(f, x1, x2, a, b):
    out = np.empty((len(x1), len(x2)))
    for i in range(len(x1)):
        for j in range(len(x2)):
            out[i, j] = density(f, x1[i], x2[j], a, b)
    return out


def _means(site, values, sites):
    """Mean of raster values in each cell, (N,)."""
    if values.size == 1:
        return np.full(sites, values[0, 0])
    of = site.ravel() + 1  # the first is outside
    total, count = np.bincount(of, values.ravel(), sites + 1), np.bincount(of, minlength=sites + 1)
    return total[1:] / np.maximum(count[1:], 1)


def cells(psi, y1, y2, site, seen, head, link, end, degree, f, values, a, b, sides):
    """Mass of every cell and d(mass) across every border.

    Args:
        site: on a raster; seen: the same, -1 outside the source; head, link, end, degree: of `borders` of `seen`.
        sides: of a convex source, (k, 3) unit outer normals and distances from the origin, none for the whole rectangle.

    Returns:
        mass (N,): source light in the cell, its area times the mean over its raster points of `values`, the source f sampled;
        weight (half-borders,): f times the border's length over the sites' distance, the derivative of the mass by the
        difference of the two prices (Kitagawa, Merigot & Thibert, J. Eur. Math. Soc. 21, 2019, theorem 1.3).
    """
    mass, weight, level = np.zeros(len(psi)), np.zeros(len(end)), _means(seen, values, len(psi))
    _cells(ALL, psi, y1, y2, site, head, link, end, degree, f, level, a, b, sides, mass, weight)
    return mass, weight


@njit(entry=True, nogil=True)
def _cells(task, psi, y1, y2, site, head, link, end, degree, f, level, a, b, sides, mass, weight):
    """`cells` for one of TASKS parts of the sites."""
    if on_threads(task, TASKS, (psi, y1, y2, site, head, link, end, degree, f, level, a, b, sides, mass, weight)):
        return
    low, high = task * len(psi) // TASKS, (task + 1) * len(psi) // TASKS
    room, flat = 0, f.size == 1
    rn, rm = site.shape
    for p in range(low, high):
        room = max(room, degree[p])
    room = 2 * room + 12 + MISSED + len(sides)
    px, py, qx, qy = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
    po, qo = np.empty(room, np.int32), np.empty(room, np.int32)
    for p in range(low, high):
        if head[p] < 0 and len(psi) > 1:
            continue
        px[0], px[1], px[2], px[3] = -a, a, a, -a
        py[0], py[1], py[2], py[3] = -b, -b, b, b
        po[:4] = -1
        n, e = np.int64(4), head[p]  # of types, as -1 below: for constants `_clip` would be compiled twice more
        while e >= 0 and n > 0:
            q = end[e]
            n = _clip(px, py, po, n, y1[q] - y1[p], y2[q] - y2[p], psi[q] - psi[p], e, qx, qy, qo)
            px, py, po, qx, qy, qo = qx, qy, qo, px, py, po
            e = link[e]
        for e in range(len(sides)):
            ax, ay, c = sides[e, 0], sides[e, 1], sides[e, 2]
            outside = False
            for k in range(n):
                outside = outside or ax * px[k] + ay * py[k] > c
            if outside:
                n = _clip(px, py, po, n, ax, ay, c, np.int32(-1), qx, qy, qo)
                px, py, po, qx, qy, qo = qx, qy, qo, px, py, po
        k, missed = 0, 0
        while k < n and missed < MISSED:  # a vertex that the raster gives to someone else: cut there too
            i = min(max(int((px[k] + a) * (0.5 * rn / a)), 0), rn - 1)
            j = min(max(int((py[k] + b) * (0.5 * rm / b)), 0), rm - 1)
            q, k = site[i, j], k + 1
            ax, ay, c = y1[q] - y1[p], y2[q] - y2[p], psi[q] - psi[p]
            if q != p and ax * px[k - 1] + ay * py[k - 1] - c > 1e-9 * abs(c):
                n = _clip(px, py, po, n, ax, ay, c, np.int32(-1), qx, qy, qo)
                px, py, po, qx, qy, qo = qx, qy, qo, px, py, po
                k, missed = 0, missed + 1
        area = _area(px, py, n)
        if not area > 0.0:
            continue
        light = level[p]
        if not light > 0.0:  # too narrow for the raster
            light = density(f, np.mean(px[:n]), np.mean(py[:n]), a, b)
        mass[p] = area * light
        for k in range(n):
            if po[k] >= 0:
                k1 = k + 1 if k + 1 < n else 0
                q = end[po[k]]
                length = np.hypot(px[k1] - px[k], py[k1] - py[k])
                g = f[0, 0] if flat else density(f, 0.5 * (px[k] + px[k1]), 0.5 * (py[k] + py[k1]), a, b)
                weight[po[k]] = g * length / np.hypot(y1[q] - y1[p], y2[q] - y2[p])
