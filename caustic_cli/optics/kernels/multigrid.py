"""Conjugate gradients on a graph Laplacian with an aggregation multigrid preconditioner (Notay, ETNA 37, 2010).

Notation
    A        symmetric, rows in CSR form; off-diagonal entries <= 0, each row sums to (nearly) 0
    aggregate    a node and its free neighbours across strong borders; the coarse matrix sums A over aggregates
    OVER     factor of the coarse correction, which piecewise constants underestimate

All sums run in a fixed order, so a result does not depend on threads.
"""

from __future__ import annotations

import numpy as np

from caustic_cli.optics.kernels.jit import njit

STRONG, OVER, SMALLEST, LEVELS = 0.25, 1.6, 60, 10


@njit(entry=True, nogil=True)
def matrix(head, link, end, weight, mass, goal, missing, touched, bond):
    """The derivative of cells' masses by prices, negated: start, column, entry off the diagonal in CSR form, and the diagonal.

    Args:
        head, link, end, weight: the cells' borders, as of `laguerre.borders` and `laguerre.cells`.
        mass, goal (N,): mass of each cell and target mass; for a cell below its target the secant is used.
        missing, touched, bond: sites without a cell (ascending), the sites they are tied to, and how firmly.
    """
    n = len(head)
    stiff = np.ones(n)
    for p in range(n):
        if mass[p] < goal[p]:
            stiff[p] = 0.5 * (1.0 + np.sqrt(goal[p] / max(mass[p], 1e-4 * goal[p])))
    extra, after = np.full(n, -1, np.int32), np.full(len(missing), -1, np.int32)
    for h in range(len(missing)):
        after[h], extra[touched[h]] = extra[touched[h]], h
    room = len(end) + 2 * len(missing)
    start, column, entry, diagonal = np.zeros(n + 1, np.int64), np.empty(room, np.int32), np.empty(room), np.zeros(n)
    used, own = 0, 0
    for p in range(n):
        e = head[p]
        while e >= 0:
            w = 0.5 * (weight[e] + weight[e ^ 1]) * max(stiff[p], stiff[end[e]])
            if w > 0.0:
                column[used], entry[used] = end[e], -w
                used += 1
            e = link[e]
        h = extra[p]
        while h >= 0:
            column[used], entry[used] = missing[h], -bond[h]
            used += 1
            h = after[h]
        if own < len(missing) and missing[own] == p:
            column[used], entry[used] = touched[own], -bond[own]
            used += 1
            own += 1
        start[p + 1] = used
        for e in range(start[p], used):
            diagonal[p] -= entry[e]
        diagonal[p] = diagonal[p] * (1.0 + 1e-10) if diagonal[p] > 0.0 else 1.0
    return start, column[:used].copy(), entry[:used].copy(), diagonal


@njit(entry=True, nogil=True)
def _aggregate(start, column, entry):
    """Aggregate of each node (n,), and how many there are."""
    n = len(start) - 1
    group, count = np.full(n, -1, np.int32), 0
    for i in range(n):
        if group[i] >= 0:
            continue
        strongest = 0.0
        for e in range(start[i], start[i + 1]):
            strongest = max(strongest, -entry[e])
        joined = False
        group[i] = count
        for e in range(start[i], start[i + 1]):
            if group[column[e]] < 0 and -entry[e] >= STRONG * strongest:
                group[column[e]] = count
                joined = True
        if joined or strongest == 0.0:
            count += 1
            continue
        best = -1.0  # alone: to its strongest neighbour's aggregate
        for e in range(start[i], start[i + 1]):
            if column[e] != i and -entry[e] > best:
                best, group[i] = -entry[e], group[column[e]]
    return group, count


@njit(entry=True, nogil=True)
def _coarsen(start, column, entry, diagonal, group, count):
    """The matrix summed over aggregates."""
    n = len(start) - 1
    fill = np.zeros(count + 1, np.int64)
    for i in range(n):
        fill[group[i] + 1] += 1
    fill = np.cumsum(fill)
    order, at = np.empty(n, np.int32), fill[:-1].copy()
    for i in range(n):
        order[at[group[i]]] = i
        at[group[i]] += 1
    c_start, c_diagonal = np.zeros(count + 1, np.int64), np.zeros(count)
    c_column, c_entry = np.empty(len(column), np.int32), np.empty(len(column))
    seen, used = np.full(count, -1, np.int64), 0
    for g in range(count):
        first = used
        for k in range(fill[g], fill[g + 1]):
            i = order[k]
            c_diagonal[g] += diagonal[i]
            for e in range(start[i], start[i + 1]):
                h = group[column[e]]
                if h == g:
                    c_diagonal[g] += entry[e]
                elif seen[h] >= first:
                    c_entry[seen[h]] += entry[e]
                else:
                    seen[h] = used
                    c_column[used], c_entry[used] = h, entry[e]
                    used += 1
        c_start[g + 1] = used
    return c_start, c_column[:used].copy(), c_entry[:used].copy(), c_diagonal


@njit(entry=True, nogil=True)
def _sweep(start, column, entry, diagonal, r, x, backward):
    """One Gauss-Seidel sweep on A x = r."""
    n = len(x)
    for k in range(n):
        i = n - 1 - k if backward else k
        s = r[i]
        for e in range(start[i], start[i + 1]):
            s -= entry[e] * x[column[e]]
        x[i] = s / diagonal[i]


@njit(entry=True, nogil=True)
def _residual(start, column, entry, diagonal, r, x):
    out = np.empty(len(x))
    for i in range(len(x)):
        s = r[i] - diagonal[i] * x[i]
        for e in range(start[i], start[i + 1]):
            s -= entry[e] * x[column[e]]
        out[i] = s
    return out


@njit(entry=True, nogil=True)
def _down(group, count, r):
    out = np.zeros(count)
    for i in range(len(r)):
        out[group[i]] += r[i]
    return out


class Multigrid:
    """A preconditioned solver for one matrix: `solve` after construction, as often as needed.

    Args:
        start (n + 1,), column, entry: the off-diagonal entries in CSR form; diagonal (n,), positive.
    """

    def __init__(self, start, column, entry, diagonal):
        self.levels = []
        while True:
            n = len(diagonal)
            if n <= SMALLEST or len(self.levels) == LEVELS:
                break
            group, count = _aggregate(start, column, entry)
            if count > 0.6 * n:
                break
            self.levels.append((start, column, entry, diagonal, group, count))
            start, column, entry, diagonal = _coarsen(start, column, entry, diagonal, group, count)
        self.last = (start, column, entry, diagonal)
        self.inverse = None
        if len(diagonal) <= 4 * SMALLEST:
            dense = np.diag(diagonal)
            np.add.at(dense, (np.repeat(np.arange(len(diagonal)), np.diff(start)), column), entry)
            self.inverse = np.linalg.pinv(dense, rcond=1e-10, hermitian=True)

    def cycle(self, r, level=0):
        """An approximate solution of A x = r: a W-cycle with symmetric Gauss-Seidel smoothing."""
        if level == len(self.levels):
            if self.inverse is not None:
                return self.inverse @ r
            x = np.zeros_like(r)
            _sweep(*self.last, r, x, False)
            _sweep(*self.last, r, x, True)
            return x
        *matrix, group, count = self.levels[level]
        x = np.zeros_like(r)
        _sweep(*matrix, r, x, False)
        _sweep(*matrix, r, x, True)
        coarse = _down(group, count, _residual(*matrix, r, x))
        y = self.cycle(coarse, level + 1)
        if level > 0 and level + 1 < len(self.levels):
            m = self.levels[level + 1]
            y = y + self.cycle(_residual(*m[:4], coarse, y), level + 1)
        x += OVER * y[group]
        _sweep(*matrix, r, x, False)
        _sweep(*matrix, r, x, True)
        return x

    def solve(self, r, tolerance, most=60):
        """x with |A x - r| <= tolerance |r|, by conjugate gradients of at most `most` steps; x (n,), steps taken."""
        matrix = self.levels[0][:4] if self.levels else self.last
        x, r = np.zeros_like(r), r.copy()
        goal, p, rz = tolerance * np.linalg.norm(r), None, 0.0
        for step in range(most):
            if np.linalg.norm(r) <= goal:
                return x, step
            z = self.cycle(r)
            old, rz = rz, r @ z
            p = z if p is None else z + (rz / old) * p
            q = -_residual(*matrix, np.zeros_like(r), p)
            alpha = rz / (p @ q)
            x += alpha * p
            r -= alpha * q
        return x, most
