"""Conjugate gradients on a graph Laplacian with an aggregation multigrid preconditioner (Notay, ETNA 37, 2010).

Notation
    A        symmetric; off-diagonal entries <= 0, each row sums to (nearly) 0
    aggregate    a node and its free neighbours across strong borders; the coarse matrix sums A over aggregates
    OVER     factor of the coarse correction, which piecewise constants underestimate

Matrices are SciPy's; compiled are the two loops in which a node depends on those before it (`optics.kernels.multigrid`).  All sums
run in a fixed order, so a result does not depend on threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from caustic_cli.loading import OnDemand

kernels = OnDemand("caustic_cli.optics.kernels.multigrid")

OVER, SMALLEST, LEVELS = 1.6, 60, 10


def matrix(end, weight, mass, goal, missing, touched, bond) -> sparse.csr_matrix:
    """The derivative of cells' masses by prices, negated, (N, N).

    Args:
        end, weight: the cells' half-borders, as of `laguerre.borders` and `laguerre.cells`.
        mass, goal (N,): mass of each cell and target mass; for a cell below its target the secant is used.
        missing, touched, bond: sites without a cell, the sites they are tied to, and how firmly.
    """
    other = np.arange(len(end)) ^ 1
    begin, weight = end[other], 0.5 * (weight + weight[other])
    stiff = np.where(mass < goal, 0.5 * (1.0 + np.sqrt(goal / np.maximum(mass, 1e-4 * goal))), 1.0)
    weight *= np.maximum(stiff[begin], stiff[end])
    between = weight > 0.0
    rows, columns = np.concatenate([begin[between], missing, touched]), np.concatenate([end[between], touched, missing])
    graph = sparse.csr_matrix((np.concatenate([weight[between], bond, bond]), (rows, columns)), (len(mass), len(mass)))
    diagonal = graph @ np.ones(len(mass))
    return sparse.csr_matrix(sparse.diags(np.where(diagonal > 0.0, diagonal * (1.0 + 1e-10), 1.0)) - graph)


class _Level(NamedTuple):
    """A matrix, its diagonal, and the sum over aggregates (count, n); none on the coarsest level."""

    matrix: sparse.csr_matrix
    diagonal: np.ndarray
    sums: sparse.csr_matrix | None

    def smooth(self, r, x) -> None:
        """Change x towards the solution of A x = r."""
        a = self.matrix
        kernels.sweep(a.indptr, a.indices, a.data, self.diagonal, r, x)


class Multigrid:
    """A preconditioned solver for one matrix A (n, n) with a positive diagonal: `solve` after construction, as often as needed."""

    def __init__(self, a: sparse.csr_matrix):
        self.levels: list[_Level] = []
        self.inverse = None
        while True:
            n, sums = a.shape[0], None
            if n > SMALLEST and len(self.levels) < LEVELS:
                group, count = kernels.aggregate(a.indptr, a.indices, a.data)
                if count <= 0.6 * n:
                    sums = sparse.csr_matrix((np.ones(n), (group, np.arange(n))), (count, n))
            self.levels.append(_Level(a, a.diagonal(), sums))
            if sums is None:
                break
            a = sparse.csr_matrix(sums @ a @ sums.T)
        if n <= 4 * SMALLEST:
            self.inverse = np.linalg.pinv(a.toarray(), rcond=1e-10, hermitian=True)

    def cycle(self, r, level=0):
        """An approximate solution of A x = r: a W-cycle with symmetric Gauss-Seidel smoothing."""
        own, x = self.levels[level], np.zeros_like(r)
        if own.sums is None and self.inverse is not None:
            return self.inverse @ r
        own.smooth(r, x)
        if own.sums is None:
            return x
        coarse = own.sums @ (r - own.matrix @ x)
        y = self.cycle(coarse, level + 1)
        if level > 0 and self.levels[level + 1].sums is not None:
            y = y + self.cycle(coarse - self.levels[level + 1].matrix @ y, level + 1)
        x += OVER * (own.sums.T @ y)
        own.smooth(r, x)
        return x

    def solve(self, r, tolerance, most=60):
        """x with |A x - r| <= tolerance |r|, by conjugate gradients of at most `most` steps; x (n,), steps taken."""
        steps = []
        own = LinearOperator((len(r), len(r)), matvec=self.cycle, dtype=np.float64)
        x, _ = cg(self.levels[0].matrix, r, rtol=tolerance, maxiter=most, M=own, callback=steps.append)
        return x, len(steps)
