"""B-spline surface from scattered slopes, by weighted and regularised least squares.

Notation
    c           control heights (n, m), mm;  J c the slopes along x and y at N points, linear in c
    s, w        given slopes, and the weight of each point, N in total
    S c         second differences of the control net along both axes

c minimises |J c - s|^2 weighted by w, plus the regularisation SMOOTH N / (n m) |S c|^2, which determines it where there are no
points.  Conjugate gradients, preconditioned with the solution for uniformly distributed points, a Poisson equation, by the cosine
transform.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.fft import dctn, idctn
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.surfaces.heightfield import HeightField

#: Regularisation parameter: weight of second differences relative to slopes of points of mean weight.
SMOOTH = 1e-3
#: Most iterations of conjugate gradients, and their relative tolerance.
STEPS, ENOUGH = 40, 1e-4


def fitted(
    field: HeightField, points: tuple[Tensor, Tensor], slopes: tuple[Tensor, Tensor], weight: Tensor, first: Tensor
) -> Tensor:
    """Control heights (n, m) mm float64, with the mean of `first`, the initial guess.

    Args:
        points: x and y (N,) on the aperture, mm; slopes: along x and y there (N,); weight: of each point (N,), not negative.
    """
    n, m = first.shape
    backend, weight = backend_for("cpu"), weight / weight.mean()
    density = weight.numel() / first.numel()
    step = [2.0 * r / (k - p) for r, k, p in zip(field.half_size, (n, m), (s.degree for s in field.spaces), strict=True)]

    apart = [torch.diff(c) for c in field.control_xy()]

    def pulled(net: Tensor, along: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """J^T w (J c), or J^T w s of slopes `along`."""
        net = net.detach().clone().requires_grad_()
        _, gx, gy = backend.spline_at(field, net, *points)
        ways = [weight * (g.detach() if along is None else a) for g, a in zip((gx, gy), along or (gx, gy), strict=True)]
        return pull_back((gx, gy), [net], ways)[0]

    def bent(net: Tensor) -> Tensor:
        """S^T S c."""
        out = torch.zeros_like(net)
        for axis, d in enumerate(apart):
            across = 1.0 / (d[:, None] if axis == 0 else d)
            steeper = torch.diff(across * torch.diff(net, dim=axis), dim=axis)
            fewer = steeper.new_zeros([1 if k == axis else size for k, size in enumerate(steeper.shape)])
            out += torch.diff(
                across * torch.diff(steeper, dim=axis, prepend=fewer, append=fewer), dim=axis, prepend=fewer, append=fewer
            )
        return SMOOTH * density * out

    def normal(c: np.ndarray) -> np.ndarray:
        net = torch.from_numpy(c.reshape(n, m))
        return (pulled(net) + bent(net)).numpy().ravel()

    modes = [(2.0 * np.sin(0.5 * np.pi * np.arange(k) / k)) ** 2 for k in (n, m)]
    even = density * sum((q / h**2) * (1.0 + SMOOTH * q) for q, h in zip(np.meshgrid(*modes, indexing="ij"), step, strict=True))
    even[0, 0] = np.inf

    def inverse(r: np.ndarray) -> np.ndarray:
        return idctn(dctn(r.reshape(n, m), norm="ortho") / even, norm="ortho").ravel()

    right = (pulled(first, slopes) - pulled(first) - bent(first)).numpy().ravel()
    system, solved = (LinearOperator((n * m, n * m), matvec, dtype=float) for matvec in (normal, inverse))
    change, _ = cg(system, right, M=solved, rtol=ENOUGH, maxiter=STEPS)
    net = first + torch.from_numpy(change.reshape(n, m))
    return net + (first.mean() - net.mean())
