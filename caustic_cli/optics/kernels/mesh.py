"""CPU kernel: first intersection of rays with the triangle mesh of a height field (thesis 4.3.2).

Notation
    o + t d      the ray, in mm;  z(t) its height o_z + t d_z
    x_i, y_j     grid lines: every non-empty knot span cut in n_u (n_v) equal parts
    T(x, y)      the mesh: each cell of the grid is a lower left and an upper right triangle, with vertices on the surface
    f(t)         z(t) - T at the ray's x, y: negative inside the lens

The path of a ray over the grid is a sequence of events, one for each grid line it crosses, in the order of the time
t = (line - o) / d; of equal times the lines of x come first.  Between two events it lies in one cell, on which f is linear but
for a kink at the diagonal.  A hit is the first piece with f < 0 at its beginning and f >= 0 at its end.

The mesh is water-tight in floating point: f at an event depends on the ray, the line and the edge only, in one formula, and
nothing is ever contracted into fused operations (no fastmath here), so whichever cell or knot span product asks sees the same
bits, and no change of sign falls between two of them.  The boxes take part in that: an interpolated T stays within the edge's
vertices but for the last bit, z(t) is monotone in t also after rounding, so a box (a few bits wider than its vertices) that is
passed over would have given the same sign throughout.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels.jit import njit, prange

HIT, MISSED = 0, 1
DEPTH = 32  # levels of rectangles above single knot span products


@njit()
def _time(line, o, d):
    """When a grid line is crossed.  A ray along the lines has passed those up to its own, and never meets the others."""
    if d != 0.0:
        return (line - o) / d
    return -math.inf if line <= o else math.inf


@njit()
def _part(t, o, d, line, inverse):
    """Where in the cell above `line`, from 0 to 1, the ray is at time t."""
    return min(max((o + t * d - line) * inverse, 0.0), 1.0)


@njit()
def _locate(t, closed, o, d, lines, inverse, low, high):
    """Cell low..high - 1 the ray is in at time t: lines crossed at t itself are behind it if `closed`."""
    k = low
    if high - low > 1:  # a guess, set right by the times alone
        k = int(min(max(low + (o + t * d - lines[low]) * inverse[low], low), high - 1))
        up = 0 if d < 0.0 else 1  # line k + 1 - up leads into cell k, k + up out of it
        step = 2 * up - 1
        while low <= k - step < high:
            behind = _time(lines[k + 1 - up], o, d)
            if behind < t or (closed and behind == t):
                break
            k -= step
        while low <= k + step < high:
            ahead = _time(lines[k + up], o, d)
            if ahead > t or (not closed and ahead == t):
                break
            k += step
    return k


@njit()
def _height(a, b, i, j, z):
    """T at parts a, b of cell i, j: for the ray's first point, the only one that no other cell shares."""
    if a + b <= 1.0:
        return z[i, j] + a * (z[i + 1, j] - z[i, j]) + b * (z[i, j + 1] - z[i, j])
    return z[i + 1, j + 1] + (1.0 - a) * (z[i, j + 1] - z[i + 1, j + 1]) + (1.0 - b) * (z[i + 1, j] - z[i + 1, j + 1])


@njit()
def _root(ta, fa, tb, fb):
    """The zero of the linear function through fa < 0 <= fb."""
    return min(ta + (tb - ta) * (fa / (fa - fb)), tb)


@njit()
def _walk(ray, first, cells, gx, gy, hx, hy, z):
    """Time of the hit inside a knot span product, infinite without; and the number of triangles on the way.

    first: the path's first time, f, parts and cell.  cells: i, i', j, j', of which the knot span product has i..i' - 1 and
    j..j' - 1.
    """
    ox, oy, oz, dx, dy, dz = ray
    i0, i1, j0, j1 = cells
    up, over = 0 if dx < 0.0 else 1, 0 if dy < 0.0 else 1  # line i + up leads out of cell i, line j + over out of cell j
    in_x, out_x = _time(gx[i0 if up else i1], ox, dx), _time(gx[i1 if up else i0], ox, dx)
    in_y, out_y = _time(gy[j0 if over else j1], oy, dy), _time(gy[j1 if over else j0], oy, dy)
    t, f, a, b, i, j = first
    if in_x <= t and in_y <= t:
        if not (out_x > t and out_y > t):
            return math.inf, 0
    elif in_x > in_y:  # enters through a line of x
        if out_y < in_x:
            return math.inf, 0
        t, i = in_x, i0 if up else i1 - 1
        j = _locate(t, False, oy, dy, gy, hy, j0, j1)
        k, a, b = i + 1 - up, 1.0 - up, _part(t, oy, dy, gy[j], hy[j])
        f = oz + t * dz - (z[k, j] + b * (z[k, j + 1] - z[k, j]))
    else:
        if out_x <= in_y:
            return math.inf, 0
        t, j = in_y, j0 if over else j1 - 1
        i = _locate(t, True, ox, dx, gx, hx, i0, i1)
        k, b, a = j + 1 - over, 1.0 - over, _part(t, ox, dx, gx[i], hx[i])
        f = oz + t * dz - (z[i, k] + a * (z[i + 1, k] - z[i, k]))
    count = 0
    tx, ty = _time(gx[i + up], ox, dx), _time(gy[j + over], oy, dy)
    while True:
        along = tx <= ty
        if along:
            tn, k, an, bn = tx, i + up, float(up), _part(tx, oy, dy, gy[j], hy[j])
            fn = oz + tn * dz - (z[k, j] + bn * (z[k, j + 1] - z[k, j]))
        else:
            tn, k, bn, an = ty, j + over, float(over), _part(ty, ox, dx, gx[i], hx[i])
            fn = oz + tn * dz - (z[i, k] + an * (z[i + 1, k] - z[i, k]))
        count += 1
        g, gn = a + b - 1.0, an + bn - 1.0  # which side of the diagonal
        if g * gn < 0.0:
            count += 1
            s = g / (g - gn)
            tm, part = min(t + s * (tn - t), tn), b + s * (bn - b)
            fm = oz + tm * dz - (z[i + 1, j] + min(max(part, 0.0), 1.0) * (z[i, j + 1] - z[i + 1, j]))
            if f < 0.0 <= fm:
                return _root(t, f, tm, fm), count
            t, f = tm, fm
        if f < 0.0 <= fn:
            return _root(t, f, tn, fn), count
        t, f, a, b = tn, fn, an, bn
        if along:
            i, a = i + 2 * up - 1, 1.0 - up
            if i < i0 or i >= i1:
                return math.inf, count
            tx = _time(gx[i + up], ox, dx)
        else:
            j, b = j + 2 * over - 1, 1.0 - over
            if j < j0 or j >= j1:
                return math.inf, count
            ty = _time(gy[j + over], oy, dy)


@njit()
def _meets(lo, hi, oz, dz, low, high):
    """Whether the ray passes the height interval of a box, borders included, between two times."""
    if not lo <= hi:
        return False
    a, b = oz + lo * dz, oz + hi * dz
    return min(a, b) <= high and max(a, b) >= low


@njit()
def _flat(ray, first, end, gx, gy, hx, hy, z, nu, nv, low, high):
    """Every knot span product's box, in the order in which a path can meet them."""
    ox, oy, oz, dx, dy, dz = ray
    rows, cols, total = low.shape[0], low.shape[1], 0
    for m in range(rows):
        i = rows - 1 - m if dx < 0.0 else m
        one, two = _time(gx[i * nu], ox, dx), _time(gx[(i + 1) * nu], ox, dx)
        lo, hi = max(first[0], min(one, two)), min(end, max(one, two))
        for k in range(cols):
            j = cols - 1 - k if dy < 0.0 else k
            one, two = _time(gy[j * nv], oy, dy), _time(gy[(j + 1) * nv], oy, dy)
            if _meets(max(lo, min(one, two)), min(hi, max(one, two)), oz, dz, low[i, j], high[i, j]):
                t, count = _walk(ray, first, (i * nu, (i + 1) * nu, j * nv, (j + 1) * nv), gx, gy, hx, hy, z)
                total += count
                if t < math.inf:
                    return t, total
    return math.inf, total


@njit()
def _descend(ray, first, end, gx, gy, hx, hy, z, nu, nv, rows, cols, tree, levels, nodes, times):
    """From all knot span products down to single ones, in four at a time, those that the path meets first on top."""
    ox, oy, oz, dx, dy, dz = ray
    top, total = 1, 0
    nodes[0, 0], nodes[0, 1], nodes[0, 2] = len(levels) - 1, 0, 0
    times[0, 0], times[0, 1] = first[0], end
    while top:
        top -= 1
        level, i, j, lo, hi = nodes[top, 0], nodes[top, 1], nodes[top, 2], times[top, 0], times[top, 1]
        if level == 0:
            t, count = _walk(ray, first, (i * nu, (i + 1) * nu, j * nv, (j + 1) * nv), gx, gy, hx, hy, z)
            total += count
            if t < math.inf:
                return t, total
            continue
        level -= 1
        middle_x, middle_y = ((2 * i + 1) << level) * nu, ((2 * j + 1) << level) * nv
        near_x, near_y, tx, ty = 2 * i, 2 * j, math.inf, math.inf
        if middle_x < rows * nu:
            tx = _time(gx[middle_x], ox, dx)
            near_x += 1 if dx < 0.0 else 0
        if middle_y < cols * nv:
            ty = _time(gy[middle_y], oy, dy)
            near_y += 1 if dy < 0.0 else 0
        for k in range(3, -1, -1):
            far_x, far_y = k & 1, k >> 1
            a = max(lo, tx if far_x else lo, ty if far_y else lo)
            b = min(hi, hi if far_x else tx, hi if far_y else ty)
            if a <= b:
                m, n = near_x ^ far_x, near_y ^ far_y
                at = levels[level, 0] + m * levels[level, 1] + n
                if _meets(a, b, oz, dz, tree[at, 0], tree[at, 1]):
                    nodes[top, 0], nodes[top, 1], nodes[top, 2] = level, m, n
                    times[top, 0], times[top, 1] = a, b
                    top += 1
    return math.inf, total


@njit()
def _inward(o, d, last, width):
    """A ray along the aperture's far border belongs to the cells along it."""
    return np.nextafter(last, last - width) if d == 0.0 and o == last else o


@njit(parallel=True)
def intersect(x, y, z, dx, dy, dz, gx, hx, gy, hy, n_u, n_v, vertices, low, high, tree, levels, recursive, blocks):
    """Times t (N,) of the rays' hits, infinite without; status (N,) int8; triangles tested (N,) int32.

    A ray that begins outside the aperture enters where its path does.  One that begins or enters above the surface, or leaves
    the aperture below it, misses.

    x, y, z, dx, dy, dz: (N,) float64, any length of direction.  gx, hx, gy, hy: grid lines, mm, and one over the widths of the
    cells above them.  vertices (a n_u + 1, b n_v + 1).  low, high (a, b): of the boxes, which must hold the vertices.  tree,
    levels: of larger boxes, `optics.mesh.pyramid_of`.
    """
    rows, cols, root = low.shape[0], low.shape[1], len(tree) - 1
    count = len(x)
    t, status, tested = np.full(count, math.inf), np.full(count, np.int8(MISSED)), np.zeros(count, dtype=np.int32)
    for block in prange(blocks):
        nodes, times = np.empty((3 * DEPTH + 1, 3), dtype=np.int64), np.empty((3 * DEPTH + 1, 2))
        for n in range(block * count // blocks, (block + 1) * count // blocks):
            ox, oy = _inward(x[n], dx[n], gx[-1], hx[-1]), _inward(y[n], dy[n], gy[-1], hy[-1])
            ray = (ox, oy, z[n], dx[n], dy[n], dz[n])
            if not math.isfinite(ox + oy + z[n] + dx[n] + dy[n] + dz[n]):
                continue
            left, right = _time(gx[0], ox, dx[n]), _time(gx[-1], ox, dx[n])
            lower, upper = _time(gy[0], oy, dy[n]), _time(gy[-1], oy, dy[n])
            start, end = max(min(left, right), min(lower, upper), 0.0), min(max(left, right), max(lower, upper))
            if not end > start:
                continue
            if end < math.inf and not _meets(start, end, z[n], dz[n], tree[root, 0], tree[root, 1]):
                continue
            i, j = _locate(start, True, ox, dx[n], gx, hx, 0, rows * n_u), _locate(start, True, oy, dy[n], gy, hy, 0, cols * n_v)
            a, b = _part(start, ox, dx[n], gx[i], hx[i]), _part(start, oy, dy[n], gy[j], hy[j])
            f = z[n] + start * dz[n] - _height(a, b, i, j, vertices)
            hit = math.inf
            if f == 0.0:
                hit, tested[n] = start, 1
            elif f < 0.0 and end == math.inf:  # the path is a point
                tested[n] = 1
                if dz[n] > 0.0:
                    hit = start - f / dz[n]
            elif f < 0.0 and recursive:
                hit, tested[n] = _descend(
                    ray, (start, f, a, b, i, j), end, gx, gy, hx, hy, vertices, n_u, n_v, rows, cols, tree, levels, nodes, times
                )
            elif f < 0.0:
                hit, tested[n] = _flat(ray, (start, f, a, b, i, j), end, gx, gy, hx, hy, vertices, n_u, n_v, low, high)
            if hit < math.inf:
                t[n], status[n] = hit, HIT
    return t, status, tested
