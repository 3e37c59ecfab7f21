"""CPU kernels: ray intersections and their adjoint, in batches of rays that hit the same polynomial piece of the height field.

    z = sum_ab c[i, j, a, b] xi^a eta^b    in the knot-span product (i, j), as in `spline`

Processed individually, every ray loads the (p + 1)(q + 1) coefficients of its span product.  LANES rays of one span product share
them: the inner loop of Horner's scheme then runs over the rays, without branches, and is vectorised.  To find such rays

    order   sorts all rays once, by their starting points;
    _group  sorts a tile of them, as often as necessary, by their intersections.

Newton's method runs in all lanes of a batch at once.  A step goes from t to t' = t - f / c, and with

    H_uu, H_uv, H_vv   bounds of |Z_uu|, |Z_uv|, |Z_vv| in the span product, from the coefficients
    B = H_uu d_u^2 + 2 H_uv |d_u d_v| + H_vv d_v^2 >= |f''|    (f as in `intersect`)

Taylor's theorem gives |t' - t*| <= B (t - t*)^2 / 2c for the root t*.  A step that is known to end within a rounding of t* is thus
the last one, without another evaluation of f; by the same bounds the slopes at t serve for t'.  The first steps use terms up to
second order only.

Special cases are passed ray by ray to `intersect._root`: rays that start outside or above, that may intersect the surface more than
once (L >= d_z), that leave the aperture, or that do not converge.  The result depends on the rays, the heights and the number of
blocks only; the composition of batches changes an intersection by a rounding at most.

At the root, f(t; P, o, d) = 0 gives, with the displacement m = do + t dd of the point at fixed t and the change dZ of the surface
there,

    dt = (dZ + Z_x m_x + Z_y m_y - m_z) / c,    dZ_x = (dZ)_x + Z_xx (m_x + d_x dt) + Z_xy (m_y + d_y dt),

whatever method found t.  In reverse mode, for a loss L with derivatives L_t, L_gx, L_gy by distance and slopes,

    X = Z_xx L_gx + Z_xy L_gy,  Y = Z_xy L_gx + Z_yy L_gy,    L_Z = (L_t + X d_x + Y d_y) / c,
    L_o = (X + L_Z Z_x, Y + L_Z Z_y, -L_Z),    L_d = t L_o.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic

from caustic_cli.optics.kernels.intersect import HIT, MISSED, _leaves, _root, value_at
from caustic_cli.optics.kernels.jit import FAST, SUMS, njit
from caustic_cli.optics.kernels.spline import jet, piece, place, push_powers
from caustic_cli.optics.kernels.threads import on_threads
from caustic_cli.optics.tolerances import FEW_ULP, LEAST_COSINE

#: Rays of a batch: enough to fill the vectors several times over, few enough for sums over them to stay in registers.
LANES = 32
#: Rays sorted at a time, in the next cache; and the largest box of span products that they may hit.
TILE, BOX = 4096, 16_384
#: Least numbers for batches to pay off despite empty lanes: rays times coefficients in a tile, and rays per span product on
#: average.
FEWEST, CROWD = 64, 8
#: Rays times (p + q + 2) below which a batch's sums take longer than the rays' own, one by one.
ALONE = 64
#: Largest numbers of moves to another span product, of steps with second-order terms, and of steps with all terms.
TURNS, FIRST_STEPS, STEPS = 4, 2, 5
#: Margin around a span product, in its widths, within which its polynomial is evaluated; margin at the border in which `_root`
#: decides.
BEYOND, MARGIN = 0.02, 1e-12
#: An unsigned index is never taken to count from the end.
UINT = np.uintp

# Where the rows of a batch's scratch begin, LANES numbers each: the rays, where they are in the span product, Horner's scheme,
# Newton's step; in the adjoint slopes, and derivatives by distance, slopes, height and start.
OU, OV, OZ, DU, DV, DZ, T, XI, ETA, ROW, SLOPE, HALF, Z, Z_XI, Z_ETA, H_XI, MIXED, H_ETA, G_U, G_V, BUSY, DONE = range(
    0, 22 * LANES, LANES
)
GX, GY, BY_T, BY_U, BY_V, BY_Z, BY_X, BY_Y = range(22 * LANES, 30 * LANES, LANES)
ROWS = 30
# Sizes of the scratch of Horner's scheme and of powers.
JET, POWERS = 11 * LANES, 3 * LANES


@intrinsic
def _stack(typing_context, size):
    """Pointer to `size` numbers on the stack.  No array can lie there as well, so that sums over them stay in registers."""
    if not isinstance(size, types.IntegerLiteral):
        return None

    def generate(context, builder, signature, arguments):
        return cgutils.alloca_once(builder, ir.DoubleType(), size=size.literal_value)

    return types.CPointer(types.float64)(size), generate


@njit(entry=True, **FAST)
def order(u, v, bu, bv):
    """Rays (N,) in order of the span products where they start, and how many of these there are."""
    count, wide = len(u), len(bv) - 1
    at, ends = np.empty(count, np.int32), np.zeros((len(bu) - 1) * wide + 1, np.int32)
    for k in range(count):
        at[k] = piece(u[k], bu) * wide + piece(v[k], bv)
        ends[at[k] + 1] += 1
    used = 0
    for k in range(1, len(ends)):
        used += ends[k] > 0
        ends[k] += ends[k - 1]
    out = np.empty(count, np.int32)
    for k in range(count):
        out[ends[at[k]]] = k
        ends[at[k]] += 1
    return out, used


@njit(**FAST)
def _group(some, count, key, low, high, ends, out):
    """The first `count` of `some` in order of their keys, which lie from `low` to `high`, into `out`."""
    ends[: high - low + 2] = 0
    for k in range(count):
        ends[key[some[k]] - low + 1] += 1
    for k in range(1, high - low + 2):
        ends[k] += ends[k - 1]
    for k in range(count):
        at = key[some[k]] - low
        out[ends[at]] = some[k]
        ends[at] += 1


@njit(**FAST)
def _bounds(c, i, j):
    """Bounds of |z_xi xi|, |z_xi eta| and |z_eta eta| in a span product."""
    p, q = c.shape[2], c.shape[3]
    xx, xy, yy, power_a = 0.0, 0.0, 0.0, 1.0
    for a in range(p):
        power = power_a
        for b in range(q):
            size = abs(c[i, j, a, b]) * power
            xx += 4.0 * a * (a - 1) * size
            xy += 4.0 * a * b * size
            yy += 4.0 * b * (b - 1) * size
            power *= 0.5
        power_a *= 0.5
    return xx, xy, yy


@njit(**FAST)
def _jets(w, c, i, j, curved):
    """`spline.jet` in all lanes, from XI and ETA to Z, Z_XI and Z_ETA, or unless `curved` is None to H_XI, MIXED and H_ETA, the
    first and last of which are halves."""
    p, q = c.shape[2], c.shape[3]
    s = carray(_stack(JET), (JET,))
    for k in range(LANES):
        s[k], s[LANES + k] = w[XI + k], w[ETA + k]
        s[5 * LANES + k], s[6 * LANES + k], s[7 * LANES + k] = 0.0, 0.0, 0.0
        s[8 * LANES + k], s[9 * LANES + k], s[10 * LANES + k] = 0.0, 0.0, 0.0
    for a in range(p - 1, -1, -1):
        top = c[i, j, a, q - 1]
        for k in range(LANES):
            s[2 * LANES + k], s[3 * LANES + k], s[4 * LANES + k] = top, 0.0, 0.0
        for b in range(q - 2, -1, -1):
            one = c[i, j, a, b]
            for k in range(LANES):
                eta, row, slope = s[LANES + k], s[2 * LANES + k], s[3 * LANES + k]
                if curved is not None:
                    s[4 * LANES + k] = s[4 * LANES + k] * eta + slope
                s[3 * LANES + k] = slope * eta + row
                s[2 * LANES + k] = row * eta + one
        for k in range(LANES):
            xi, z, z_xi, z_eta = s[k], s[5 * LANES + k], s[6 * LANES + k], s[8 * LANES + k]
            if curved is not None:
                s[7 * LANES + k] = s[7 * LANES + k] * xi + z_xi
                s[9 * LANES + k] = s[9 * LANES + k] * xi + z_eta
                s[10 * LANES + k] = s[10 * LANES + k] * xi + s[4 * LANES + k]
            s[6 * LANES + k] = z_xi * xi + z
            s[5 * LANES + k] = z * xi + s[2 * LANES + k]
            s[8 * LANES + k] = z_eta * xi + s[3 * LANES + k]
    for k in range(LANES):
        if curved is None:
            w[Z + k], w[Z_XI + k], w[Z_ETA + k] = s[5 * LANES + k], s[6 * LANES + k], s[8 * LANES + k]
        else:
            w[H_XI + k], w[MIXED + k], w[H_ETA + k] = s[7 * LANES + k], s[9 * LANES + k], s[10 * LANES + k]


@njit(**FAST)
def _settle(w, size, c, i, j, bounds, pieces):
    """Newton's iteration in all lanes, from T; DONE where it has converged in this span product.

    bounds: of the span product, as of `_bounds`.  Returns in how many lanes it has not.
    """
    bu, mu, wu, bv, mv, wv, scale_x, scale_y = pieces
    mi, wi, mj, wj = mu[i], wu[i], mv[j], wv[j]
    p, q = c.shape[2], c.shape[3]
    xx, xy, yy = bounds[0] * wi * wi, bounds[1] * wi * wj, bounds[2] * wj * wj
    c0, c1, c2, c3 = c[i, j, 0, 0], c[i, j, 1, 0], c[i, j, 0, 1], c[i, j, 1, 1]
    c4, c5 = c[i, j, 2, 0] if p > 2 else 0.0, c[i, j, 0, 2] if q > 2 else 0.0
    for _ in range(FIRST_STEPS):
        for k in range(LANES):
            t, du, dv, dz = w[T + k], w[DU + k], w[DV + k], w[DZ + k]
            xi, eta = (w[OU + k] + t * du - mi) * wi, (w[OV + k] + t * dv - mj) * wj
            z = c0 + xi * (c1 + xi * c4 + eta * c3) + eta * (c2 + eta * c5)
            slope = dz - (c1 + 2.0 * xi * c4 + eta * c3) * (wi * du) - (c2 + 2.0 * eta * c5 + xi * c3) * (wj * dv)
            w[T + k] = t - (w[OZ + k] + t * dz - z) / max(slope, 0.5 * dz)
    for k in range(LANES):
        w[BUSY + k], w[DONE + k] = 1.0, 0.0
    for _ in range(STEPS):
        for k in range(LANES):
            t = w[T + k]
            xi, eta = (w[OU + k] + t * w[DU + k] - mi) * wi, (w[OV + k] + t * w[DV + k] - mj) * wj
            w[BUSY + k] = w[BUSY + k] if max(abs(xi), abs(eta)) <= 0.5 + BEYOND else 0.0
            w[XI + k], w[ETA + k] = xi, eta
        _jets(w, c, i, j, None)
        left = 0
        for k in range(LANES):
            t, du, dv, dz, busy = w[T + k], w[DU + k], w[DV + k], w[DZ + k], w[BUSY + k] > 0.0
            zu, zv = w[Z_XI + k] * wi, w[Z_ETA + k] * wj
            slope = dz - zu * du - zv * dv
            step = (w[OZ + k] + t * dz - w[Z + k]) / slope
            u, v = abs(du), abs(dv)
            narrow, size_ = FEW_ULP * max(size, t), abs(step)
            curvature = xx * u * u + 2.0 * xy * u * v + yy * v * v
            turn = max((xx * u + xy * v) * scale_x, (xy * u + yy * v) * scale_y)
            near = (size_ <= narrow) | ((step * step * curvature <= 0.5 * narrow * slope) & (size_ * turn <= FEW_ULP))
            done = busy and near and slope > 0.0
            w[T + k] = t - step if busy else t
            w[G_U + k] = zu if busy else w[G_U + k]
            w[G_V + k] = zv if busy else w[G_V + k]
            w[DONE + k] = 1.0 if done else w[DONE + k]
            w[BUSY + k] = 1.0 if busy and not done else 0.0
            left += 1 if busy and not done else 0
        if left == 0:
            break
    left, low_u, high_u, low_v, high_v = 0, bu[i], bu[i + 1], bv[j], bv[j + 1]
    for k in range(LANES):
        t = w[T + k]
        u, v = w[OU + k] + t * w[DU + k], w[OV + k] + t * w[DV + k]
        within = (u >= low_u) & (u < high_u) & (v >= low_v) & (v < high_v) & (t > MARGIN * size)
        within &= (min(u, v) > MARGIN) & (max(u, v) < 1.0 - MARGIN) & (w[DONE + k] > 0.0)
        w[DONE + k] = 1.0 if within else 0.0
        left += 0 if within else 1
    return left


class Hits(NamedTuple):
    """First intersections of rays (N,): status, distances (-1 for none), dz/dx and dz/dy there.

    met (N,): the rays in the order of processing; where (N,): their intersections' span products in row-major order, -1 for none.
    """

    status: np.ndarray
    reach: np.ndarray
    gx: np.ndarray
    gy: np.ndarray
    met: np.ndarray
    where: np.ndarray

    @classmethod
    def of(cls, count: int) -> Hits:
        """To be overwritten, of that many rays."""
        return cls(np.empty(count, np.int8), *(np.empty(count) for _ in range(3)), *(np.empty(count, np.int32) for _ in range(2)))


@njit(inline="always", **FAST)
def _guess(ou, ov, oz, du, dv, dz, middle, thick, c, pieces):
    """Initial estimate of an intersection: with the plane in the middle of the hull, or if that is too rough, with planes below
    it."""
    wu, wv = pieces.over_u, pieces.over_v
    t = max((middle - oz) / dz, 0.0)
    i, j = piece(ou + t * du, pieces.breaks_u), piece(ov + t * dv, pieces.breaks_v)
    if thick * abs(du) * wu[i] < 0.1 * dz and thick * abs(dv) * wv[j] < 0.1 * dz:
        return t, i, j
    most = min(_leaves(ou, du), _leaves(ov, dv))
    for _ in range(2):
        t = min(max(t, 0.0), most)
        i, j, xi, eta = place(ou + t * du, ov + t * dv, pieces)
        z = c[i, j, 0, 0] + c[i, j, 1, 0] * xi + c[i, j, 0, 1] * eta
        slope = dz - c[i, j, 1, 0] * wu[i] * du - c[i, j, 0, 1] * wv[j] * dv
        t -= (oz + t * dz - z) / max(slope, 0.5 * dz)
    t = min(max(t, 0.0), most)
    return t, piece(ou + t * du, pieces.breaks_u), piece(ov + t * dv, pieces.breaks_v)


class _Tile(NamedTuple):
    """Of a tile's rays: estimates and numbers of those that are batched, their span products, who is left (and sorted by these),
    and the numbers of those that go alone; lanes of a batch, and scratch of `_group`."""

    start: np.ndarray
    at: np.ndarray
    key: np.ndarray
    some: np.ndarray
    together: np.ndarray
    alone: np.ndarray
    w: np.ndarray
    ends: np.ndarray


@njit(**FAST)
def _sort_out(first, last, order, batched, rays, limits, slopes, c, pieces, tile):
    """Which rays of a tile are batched, with estimates: how many are, how many are not, and the range of their span products."""
    (ou, ov, oz, du, dv, dz), wide = rays, len(pieces.breaks_v) - 1
    start, at, key, some, _, alone, _, _ = tile
    middle, thick = 0.5 * (limits[0] + limits[1]), 0.5 * (limits[1] - limits[0])
    left, lone, low, high = 0, 0, np.int32(2**31 - 1), np.int32(0)
    for k in range(first, last):
        r = UINT(order[k])
        u, v, safe = ou[r], ov[r], slopes[0] * abs(du[r]) + slopes[1] * abs(dv[r]) < dz[r]
        if not (batched and safe and u >= 0.0 and u <= 1.0 and v >= 0.0 and v <= 1.0):
            alone[lone] = r
            lone += 1
            continue
        t, i, j = _guess(u, v, oz[r], du[r], dv[r], dz[r], middle, thick, c, pieces)
        start[left], at[left], some[left], key[left] = t, r, left, i * wide + j
        low, high = min(low, key[left]), max(high, key[left])
        left += 1
    return left, lone, low, high


@njit(**FAST)
def _turn(left, lone, to, fewest, rays, size, c, pieces, tile, hits):
    """One Newton iteration in batches: those that have converged into `hits`, from `to` on; the others are left, or go alone.

    Returns left, lone, to, and the range of the span products of those left.
    """
    (ou, ov, oz, du, dv, dz), bu, bv = rays, pieces.breaks_u, pieces.breaks_v
    status, reach, gx, gy, met, where = hits
    start, at, key, some, together, alone, w, _ = tile
    begin, stop, left, low, high, wide = 0, left, 0, np.int32(2**31 - 1), np.int32(0), len(bv) - 1
    known, bounds = np.int32(-1), (0.0, 0.0, 0.0)
    while begin < stop:
        piece_ = key[together[begin]]
        end, most = begin + 1, min(begin + LANES, stop)
        while end < most and key[together[end]] == piece_:
            end += 1
        if end - begin < fewest:
            for k in range(begin, end):
                alone[lone] = at[together[k]]
                lone += 1
            begin = end
            continue
        a, b = piece_ // wide, piece_ % wide
        if piece_ != known:
            known, bounds = piece_, _bounds(c, a, b)
        for k in range(LANES):
            s = together[min(begin + k, end - 1)]
            r = UINT(at[s])
            w[OU + k], w[OV + k], w[OZ + k], w[T + k] = ou[r], ov[r], oz[r], start[s]
            w[DU + k], w[DV + k], w[DZ + k] = du[r], dv[r], dz[r]
        _settle(w, size, c, a, b, bounds, pieces)
        for k in range(end - begin):
            s, t = together[begin + k], w[T + k]
            r = UINT(at[s])
            if w[DONE + k] > 0.0:
                met[to], where[to] = r, piece_
                status[r], reach[r], gx[r], gy[r] = HIT, t, w[G_U + k] * pieces.scale_x, w[G_V + k] * pieces.scale_y
                to += 1
                continue
            start[s] = t
            key[s] = piece(w[OU + k] + t * w[DU + k], bu) * wide + piece(w[OV + k] + t * w[DV + k], bv)
            low, high = min(low, key[s]), max(high, key[s])
            some[left] = s
            left += 1
        begin = end
    return left, lone, to, low, high


@njit(**FAST)
def _one_by_one(lone, to, rays, begin, limits, slopes, c, pieces, alone, hits):
    (ou, ov, oz, du, dv, dz), (status, reach, gx, gy, met, where) = rays, hits
    for k in range(lone):
        r = alone[k]
        slope = slopes[0] * abs(du[r]) + slopes[1] * abs(dv[r])
        t, status[r], guess = 0.0, MISSED, begin[r] if len(begin) > 0 else -1.0
        if guess < np.inf:
            t, status[r] = _root((ou[r], ov[r], oz[r], du[r], dv[r], dz[r]), guess, limits, slope, c, pieces)
        met[to], where[to], reach[r], gx[r], gy[r] = r, -1, -1.0, 0.0, 0.0
        if status[r] == HIT:
            u, v = ou[r] + t * du[r], ov[r] + t * dv[r]
            _, zu, zv = value_at(c, u, v, pieces)
            where[to] = piece(u, pieces.breaks_u) * (len(pieces.breaks_v) - 1) + piece(v, pieces.breaks_v)
            reach[r], gx[r], gy[r] = t, zu * pieces.scale_x, zv * pieces.scale_y
        to += 1


@njit(entry=True, **FAST)
def first_hits(block, order, batched, rays, begin, limits, slopes, round_, c, pieces, hits, blocks):
    """First intersections of rays, (o_u, o_v, o_z, d_u, d_v, d_z), (N,) each, into `hits`.

    order (N,): of the rays; batched: whether to look for batches; begin: estimates of the distances of rays that are not, (N,),
    infinite for none, or (0,); limits: least and largest control height; slopes: bounds of |Z_u| and |Z_v|; round_: radius of a
    circular aperture, mm, or infinite.
    """
    if on_threads(block, blocks, (order, batched, rays, begin, limits, slopes, round_, c, pieces, hits, blocks)):
        return
    count, size, fewest = len(order), max(abs(limits[0]), abs(limits[1])), max(1, FEWEST // (c.shape[2] * c.shape[3]))
    some, together, alone = np.empty(TILE, np.int32), np.empty(TILE, np.int32), np.empty(TILE, np.int32)
    start, at, key = np.empty(TILE), np.empty(TILE, np.int32), np.empty(TILE, np.int32)
    tile = _Tile(start, at, key, some, together, alone, np.empty(ROWS * LANES), np.empty(BOX + 2, np.int32))
    first, stop = block * count // blocks, (block + 1) * count // blocks
    while first < stop:
        last, to = min(first + TILE, stop), first
        left, lone, low, high = _sort_out(first, last, order, batched, rays, limits, slopes, c, pieces, tile)
        for _ in range(TURNS):
            if left < fewest or high - low >= BOX:
                break
            _group(some, left, key, low, high, tile.ends, together)
            left, lone, to, low, high = _turn(left, lone, to, fewest, rays, size, c, pieces, tile, hits)
        for k in range(left):
            alone[lone] = at[some[k]]
            lone += 1
        _one_by_one(lone, to, rays, begin, limits, slopes, c, pieces, alone, hits)
        if round_ < np.inf:  # outside a circular aperture the ray has left the lens
            (ou, ov, _, du, dv, _), (status, reach, gx, gy, met, where) = rays, hits
            for k in range(first, last):
                r = met[k]
                x, y = (ou[r] - 0.5 + reach[r] * du[r]) / pieces.scale_x, (ov[r] - 0.5 + reach[r] * dv[r]) / pieces.scale_y
                if status[r] == HIT and x * x + y * y > round_ * round_:
                    where[k], status[r], reach[r], gx[r], gy[r] = -1, MISSED, -1.0, 0.0, 0.0
        first = last


@njit(**FAST)
def _tables(w, p, q, table):
    """Tables (2 p' + 2 q', LANES), p' and q' up to a multiple of 2 and 4: the sum over lanes of by_z z + by_xi z_xi + by_eta z_eta,

    differentiated by c[a, b], is that of A_a E_b + C_a D_b with E_b = eta^b, D_b = b eta^(b-1), A_a = by_z xi^a + by_xi a xi^(a-1),
    C_a = by_eta xi^a.  by_z, by_xi, by_eta: BY_Z, BY_U, BY_V.
    """
    pp, qq = (p + 1) // 2 * 2, (q + 3) // 4 * 4
    ea, ed, ec = pp * LANES, (pp + qq) * LANES, (pp + 2 * qq) * LANES
    _powers(w, XI, 0, ec, pp, table)
    _powers(w, ETA, ea, ed, qq, table)
    for at in range(0, pp * LANES, LANES):
        power, slope = table[at : at + LANES], table[ec + at : ec + at + LANES]
        for k in range(LANES):
            power[k], slope[k] = w[BY_Z + k] * power[k] + w[BY_U + k] * slope[k], w[BY_V + k] * power[k]


@njit(**FAST)
def _powers(w, x, first, second, count, table):
    """Powers 0 to count - 1 of a row x of the scratch, and their derivatives, into the table from these places on."""
    s = carray(_stack(POWERS), (POWERS,))
    for k in range(LANES):
        s[k], s[LANES + k], s[2 * LANES + k] = w[x + k], 1.0, 0.0
    for at in range(0, count * LANES, 2 * LANES):  # two rows in one loop: shorter ones are unrolled ray by ray, not made vectors
        e0, e1 = table[first + at : first + at + LANES], table[first + at + LANES : first + at + 2 * LANES]
        d0, d1 = table[second + at : second + at + LANES], table[second + at + LANES : second + at + 2 * LANES]
        for k in range(LANES):
            x_, power, slope = s[k], s[LANES + k], s[2 * LANES + k]
            e0[k], d0[k] = power, slope
            slope = slope * x_ + power
            power *= x_
            e1[k], d1[k] = power, slope
            s[LANES + k], s[2 * LANES + k] = power * x_, slope * x_ + power


@njit(**SUMS)
def _gather(table, p, q, total):
    """Add the sums over the lanes that `_tables` describes to total (p', q')."""
    pp, qq = (p + 1) // 2 * 2, (q + 3) // 4 * 4
    for a in range(0, pp, 2):
        c, f = table[a * LANES : (a + 2) * LANES], table[(pp + 2 * qq + a) * LANES : (pp + 2 * qq + a + 2) * LANES]
        for b in range(0, qq, 4):
            e, d = table[(pp + b) * LANES : (pp + b + 4) * LANES], table[(pp + qq + b) * LANES : (pp + qq + b + 4) * LANES]
            s0, s1, s2, s3, s4, s5, s6, s7 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(LANES):
                s0 += c[k] * e[k] + f[k] * d[k]
                s1 += c[k] * e[LANES + k] + f[k] * d[LANES + k]
                s2 += c[k] * e[2 * LANES + k] + f[k] * d[2 * LANES + k]
                s3 += c[k] * e[3 * LANES + k] + f[k] * d[3 * LANES + k]
                s4 += c[LANES + k] * e[k] + f[LANES + k] * d[k]
                s5 += c[LANES + k] * e[LANES + k] + f[LANES + k] * d[LANES + k]
                s6 += c[LANES + k] * e[2 * LANES + k] + f[LANES + k] * d[2 * LANES + k]
                s7 += c[LANES + k] * e[3 * LANES + k] + f[LANES + k] * d[3 * LANES + k]
            total[a, b] += s0
            total[a, b + 1] += s1
            total[a, b + 2] += s2
            total[a, b + 3] += s3
            total[a + 1, b] += s4
            total[a + 1, b + 1] += s5
            total[a + 1, b + 2] += s6
            total[a + 1, b + 3] += s7


@njit(**FAST)
def _pull_each(begin, end, a, b, met, by, rays, found, c, pieces, grad, powers, starts):
    """The adjoint of some rays that meet the span product (a, b), one by one."""
    (by_t, by_gx, by_gy), (ou, ov, _, du, dv, dz), (t, gx, gy), (by_ox, by_oy, by_oz) = by, rays, found, starts
    _, mu, wu, _, mv, wv, scale_x, scale_y = pieces
    wi, wj, mi, mj = wu[a], wv[b], mu[a], mv[b]
    for k in range(begin, end):
        r = met[k]
        xi, eta = (ou[r] + t[r] * du[r] - mi) * wi, (ov[r] + t[r] * dv[r] - mj) * wj
        _, _, _, xx, xy, yy = jet(c, a, b, xi, eta)
        by_u, by_v = by_gx[r] * scale_x, by_gy[r] * scale_y
        by_x, by_y = by_u * xx * wi * wi + by_v * xy * wi * wj, by_u * xy * wi * wj + by_v * yy * wj * wj
        cosine = max(dz[r] - gx[r] * du[r] / scale_x - gy[r] * dv[r] / scale_y, LEAST_COSINE)
        by_z = (by_t[r] + by_x * du[r] + by_y * dv[r]) / cosine
        if grad.size > 0:
            push_powers(grad, a, b, xi, eta, by_z, by_u * wi, by_v * wj, powers)
        if len(by_ox) > 0:
            by_ox[r], by_oy[r], by_oz[r] = by_x * scale_x + by_z * gx[r], by_y * scale_y + by_z * gy[r], -by_z


@njit(**FAST)
def _pull_lanes(begin, end, a, b, met, by, rays, found, c, pieces, w, starts):
    """The same of rays in lanes: X, Y and L_Z, and by these the rays' starts; the rest is left to `_tables`."""
    (by_t, by_gx, by_gy), (ou, ov, _, du, dv, dz), (t, gx, gy), (by_ox, by_oy, by_oz) = by, rays, found, starts
    _, mu, wu, _, mv, wv, scale_x, scale_y = pieces
    wi, wj, mi, mj = wu[a], wv[b], mu[a], mv[b]
    for k in range(LANES):
        r, here = UINT(met[min(begin + k, end - 1)]), 1.0 if k < end - begin else 0.0
        w[OU + k], w[OV + k], w[T + k], w[GX + k], w[GY + k] = ou[r], ov[r], t[r], gx[r], gy[r]
        w[DU + k], w[DV + k], w[DZ + k] = du[r], dv[r], dz[r]
        w[BY_T + k], w[BY_U + k], w[BY_V + k] = here * by_t[r], here * by_gx[r], here * by_gy[r]
    for k in range(LANES):
        w[XI + k] = (w[OU + k] + w[T + k] * w[DU + k] - mi) * wi
        w[ETA + k] = (w[OV + k] + w[T + k] * w[DV + k] - mj) * wj
    _jets(w, c, a, b, True)
    for k in range(LANES):
        xx, xy, yy = 2.0 * w[H_XI + k] * wi * wi, w[MIXED + k] * wi * wj, 2.0 * w[H_ETA + k] * wj * wj
        by_u, by_v = w[BY_U + k] * scale_x, w[BY_V + k] * scale_y
        by_x, by_y = by_u * xx + by_v * xy, by_u * xy + by_v * yy
        cosine = max(w[DZ + k] - w[GX + k] / scale_x * w[DU + k] - w[GY + k] / scale_y * w[DV + k], LEAST_COSINE)
        by_z = (w[BY_T + k] + by_x * w[DU + k] + by_y * w[DV + k]) / cosine
        w[BY_Z + k], w[BY_U + k], w[BY_V + k] = by_z, by_u * wi, by_v * wj
        w[BY_X + k], w[BY_Y + k] = by_x * scale_x + by_z * w[GX + k], by_y * scale_y + by_z * w[GY + k]
    if len(by_ox) > 0:
        for k in range(end - begin):
            r = met[begin + k]
            by_ox[r], by_oy[r], by_oz[r] = w[BY_X + k], w[BY_Y + k], -w[BY_Z + k]


@njit(entry=True, **FAST)
def pull_back(block, met, where, by, rays, found, c, pieces, grads, starts):
    """Adjoint of `first_hits`: derivatives by the coefficients (blocks, I, J, p + 1, q + 1), overwritten, and by the rays' starts.

    by: derivatives by distance and slopes, (N,) each; met, where: from `first_hits`; found: distance and slopes; grads may have no
    coefficients, and `starts` (by o, (N,) each, per mm) no rays, if these are not asked for.
    """
    count, blocks, p, q, wide = len(where), len(grads), c.shape[2], c.shape[3], len(pieces.breaks_v) - 1
    if on_threads(block, blocks, (met, where, by, rays, found, c, pieces, grads, starts)):
        return
    w, grad, powers = np.zeros(ROWS * LANES), grads[block], np.empty((2, q))
    grad[:] = 0.0
    pp, qq = (p + 1) // 2 * 2, (q + 3) // 4 * 4
    table, total = np.zeros(2 * (pp + qq) * LANES), np.zeros((pp, qq))
    begin, stop = block * count // blocks, (block + 1) * count // blocks
    summed = False
    while begin < stop:
        if where[begin] < 0:
            if len(starts[0]) > 0:
                starts[0][met[begin]], starts[1][met[begin]], starts[2][met[begin]] = 0.0, 0.0, 0.0
            begin += 1
            continue
        end, most, a, b = begin + 1, min(begin + LANES, stop), where[begin] // wide, where[begin] % wide
        while end < most and where[end] == where[begin]:
            end += 1
        if not summed and (end - begin) * (p + q) < ALONE:
            _pull_each(begin, end, a, b, met, by, rays, found, c, pieces, grad, powers, starts)
            begin = end
            continue
        _pull_lanes(begin, end, a, b, met, by, rays, found, c, pieces, w, starts)
        if grad.size > 0:
            _tables(w, p, q, table)
            _gather(table, p, q, total)
            summed = end < stop and where[end] == where[begin]
            if not summed:
                for k in range(p):
                    for m in range(q):
                        grad[a, b, k, m] += total[k, m]
                total[:] = 0.0
        begin = end
