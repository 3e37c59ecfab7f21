"""CPU kernels of `inverse.multigrid`: the two loops in which a node depends on those before it, on matrices by compressed rows."""

from __future__ import annotations

import numpy as np

from caustic_cli.optics.kernels.jit import njit

STRONG = 0.25


@njit(entry=True, nogil=True)
def aggregate(start, column, entry):
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
def sweep(start, column, entry, diagonal, r, x):
    """Symmetric Gauss-Seidel on A x = r: one sweep forwards and one back."""
    n = len(x)
    for k in range(2 * n):
        i = k if k < n else 2 * n - 1 - k
        s = r[i]
        for e in range(start[i], start[i + 1]):
            s -= entry[e] * x[column[e]]
        x[i] += s / diagonal[i]
