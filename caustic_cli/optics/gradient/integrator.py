"""Symplectic integration of rays in gradient-index media, with a reversible adjoint of constant memory.

Notation
    q, p        position, mm, and optical momentum n d of a ray; |p| = n along it
    tau         parameter of the ray, d tau = ds / n, mm
    S, L        optical and geometric path length, mm
    F           grad(n^2) / 2

The ray equation d/ds(n dq/ds) = grad n is Hamilton's with H = (p^2 - n^2) / 2 = 0 (Sharma, Kumar & Ghatak, Appl. Opt. 21, 1982):

    dq/dtau = p,    dp/dtau = F(q),    dS/dtau = n^2 = (p^2 + n^2) / 2,    dL/dtau = n

H is the sum of a function of p and a function of q, whose flows are known in closed form:

    drift by a      q += a p,      S += a p^2 / 2
    kick by b       p += b F(q),   S += b n^2 / 2,   L += b n

drift (h / 2), kick (h), drift (h / 2) is of second order, symplectic, and its own inverse with -h.  Compositions of it with steps
w_i h, w symmetric, have order 4 (Suzuki, Phys. Lett. A 146, 1990) and 6 (Kahan & Li, Math. Comp. 66, 1997).  Since every step is
reversible, the adjoint retraces the ray from its end and stores no intermediate states:

    drift back      lp += a lq + s a p
    kick back       lq += b (dF/dq)^T lp + s b F + l b grad n,      lc += b (dF/dc)^T lp + ...

with lq, lp, s, l the adjoint variables of q, p, S and L, and lc that of the field's coefficients.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.errors import CausticError
from caustic_cli.optics.backends import in_forward_mode
from caustic_cli.optics.gradient.fields import LEAST_SQUARE, IndexField, square_of

_S4 = 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
_S6 = (0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.082213596293550800230, 0.79854399093482996340)
#: Coefficients w of the composition, by order of the method.
WEIGHTS = {2: (1.0,), 4: (_S4, _S4, 1.0 - 4.0 * _S4, _S4, _S4), 6: (*_S6, *_S6[-2::-1])}
#: Default order of the method.
ORDER = 4
#: Number of rays for the choice of the number of steps, and its maximum.
PROBES, MOST_STEPS = 256, 1 << 14


class Flow(NamedTuple):
    """Final state of rays: point q (mm) and momentum p, three (N,) each; optical and geometric path lengths S and L, (N,) mm."""

    point: tuple[Tensor, ...]
    momentum: tuple[Tensor, ...]
    path: Tensor
    length: Tensor


def flow(field: IndexField, coefficients: Tensor | None, point, momentum, time: Tensor, steps: int, order: int = ORDER) -> Flow:
    """Integrate rays over `time` (N,) mm of tau in equal steps; the plain-torch reference, for any field.

    Differentiable once by coefficients, points, momenta and times: in reverse mode by the adjoint, in forward mode step by step.
    """
    march = _marched if in_forward_mode() else _Flow.apply
    out = march(field, steps, order, coefficients, time, *point, *momentum)
    return Flow(out[:3], out[3:6], out[6], out[7])


def drift(q, p, path: Tensor, a):
    """The flow of p^2 / 2; see the module."""
    return tuple(x + a * v for x, v in zip(q, p, strict=True)), path + 0.5 * a * square_of(p)


def kick(field: IndexField, coefficients, q, p, path: Tensor, length: Tensor, b):
    """The flow of -n^2 / 2; see the module."""
    square, force = field.at(q, coefficients)
    p = tuple(v + b * f for v, f in zip(p, force, strict=True))
    return p, path + 0.5 * b * square, length + b * square.clamp_min(LEAST_SQUARE).sqrt()


def _marched(field: IndexField, steps: int, order: int, coefficients: Tensor | None, time: Tensor, *ray: Tensor):
    """The steps of `flow`."""
    q, p = ray[:3], ray[3:]
    path, length, h = torch.zeros_like(q[0]), torch.zeros_like(q[0]), time / steps
    for _ in range(steps):
        for w in WEIGHTS[order]:
            q, path = drift(q, p, path, 0.5 * w * h)
            p, path, length = kick(field, coefficients, q, p, path, length, w * h)
            q, path = drift(q, p, path, 0.5 * w * h)
    return (*q, *p, path, length)


class _Flow(torch.autograd.Function):
    """`flow` with inputs and outputs by components."""

    @staticmethod
    def forward(field, steps, order, coefficients, time, *ray):
        return _marched(field, steps, order, coefficients, time, *ray)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.field, ctx.steps, ctx.order, coefficients, time, *_ = inputs
        ctx.free = coefficients is not None
        ctx.save_for_backward(time, *output[:6], *([coefficients] if ctx.free else []))

    @staticmethod
    @once_differentiable
    def backward(ctx, *given):
        time, *ends = ctx.saved_tensors
        q, p, c = tuple(ends[:3]), tuple(ends[3:6]), ends[6] if ctx.free else None
        lq, lp, s, by_length = list(given[:3]), list(given[3:6]), given[6], given[7]
        by_time, by_c, h = torch.zeros_like(time), None if c is None else torch.zeros_like(c), time / ctx.steps

        def drift_back(a):
            nonlocal q
            rate = sum(x * v for x, v in zip(lq, p, strict=True)) + 0.5 * s * square_of(p)
            for k in range(3):
                lp[k] = lp[k] + a * (lq[k] + s * p[k])
            q = tuple(x - a * v for x, v in zip(q, p, strict=True))
            return rate

        for _ in range(ctx.steps):
            for w in WEIGHTS[ctx.order]:
                rate = 0.5 * drift_back(0.5 * w * h)
                with torch.enable_grad():
                    at = [x.detach().requires_grad_() for x in q]
                    free = [] if c is None else [c.detach().requires_grad_()]
                    square, force = ctx.field.at(at, free[0] if free else None)
                    action = sum(v * f for v, f in zip(lp, force, strict=True)) + 0.5 * s * square
                    action = action + by_length * square.clamp_min(LEAST_SQUARE).sqrt()
                    pulled = torch.autograd.grad((w * h * action).sum(), [*at, *free], allow_unused=True)
                for k in range(3):
                    if pulled[k] is not None:
                        lq[k] = lq[k] + pulled[k]
                if by_c is not None and pulled[3] is not None:
                    by_c += pulled[3]
                rate = rate + action.detach()
                p = tuple(v - w * h * f.detach() for v, f in zip(p, force, strict=True))
                rate = rate + 0.5 * drift_back(0.5 * w * h)
                by_time += w / ctx.steps * rate
        return (None, None, None, by_c, by_time, *lq, *lp)


def steps_for(
    march, field: IndexField, coefficients: Tensor | None, point, momentum, time: Tensor, tolerance: float, order: int = ORDER
) -> int:
    """Number of steps by step doubling: the least power of 2 whose result agrees with that of twice as many, on a subset of the
    rays.

    Args:
        march: `flow` of a backend.
        tolerance: of the root mean square difference of points, relative to the path length, and of momenta.  The error with twice
            as many steps is 2^order times smaller.

    Raises:
        CausticError: no convergence with MOST_STEPS.
    """
    every = max(1, time.numel() // PROBES)
    some = [c.detach()[::every].contiguous() for c in (*point, *momentum, time)]
    q, p, t = some[:3], some[3:6], some[6]
    c = None if coefficients is None else coefficients.detach()
    scale = float(t.abs().max()) or 1.0
    with torch.no_grad():
        steps, before = 1, march(field, c, q, p, t, 1, order)
        while steps <= MOST_STEPS:
            after = march(field, c, q, p, t, 2 * steps, order)
            off = [float((a - b).square().mean().sqrt()) / scale for a, b in zip(after.point, before.point, strict=True)]
            off += [float((a - b).square().mean().sqrt()) for a, b in zip(after.momentum, before.momentum, strict=True)]
            if max(off) <= tolerance:
                return steps
            if not all(map(math.isfinite, off)):
                break
            steps, before = 2 * steps, after
    raise CausticError(f"rays through the gradient index do not converge to {tolerance:g} with {MOST_STEPS:,} steps")
