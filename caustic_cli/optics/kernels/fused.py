"""Fused CPU kernel: refraction at the exit surface -> landing point -> splat, with its adjoint.

It combines the stages of `optics.trace`, row by row of rays without intermediate storage; the plain-torch backend is its reference.
Everything is float64, since float32 was no faster.

Each of a fixed number of blocks of rows accumulates an image of its own, and these are added in order, so the result depends on the
number of blocks (threads) but not on timing.  Only the scatter to and the gather from pixels are per ray; the rest (`rows`,
`axial_refraction` or `landing`, `filter_weights`) is vectorised over rows.
"""

from __future__ import annotations

import numpy as np

from caustic_cli.optics.kernels import axial_refraction, landing
from caustic_cli.optics.kernels import rows as row
from caustic_cli.optics.kernels.arguments import Splat
from caustic_cli.optics.kernels.jit import FAST, SUMS, njit
from caustic_cli.optics.kernels.rows import combine, load, spread
from caustic_cli.optics.kernels.splat import gather, scatter, share
from caustic_cli.optics.kernels.threads import ALL, on_threads

LOST_BY_FRESNEL, REFLECTED, OFF_SCREEN, LEAVING, MISSED, COLUMNS = range(6)  # of the ledger


@njit(inline="always", **FAST)
def _aim(v, i, surface, rays, exit_, frame, oblique, point, parallel):
    """Powers and landing points of row i."""
    if oblique is None:
        combine(i, surface, v[row.SAG], v[row.GX], v[row.GY])
    if oblique is not None or point is not None or parallel is not None:
        landing.aim(v, i, surface, rays, exit_, frame, oblique, point, parallel)
    else:
        load(rays.flux[i], v[row.FLUX])
        load(rays.x[i], v[row.X])
        load(rays.y[i], v[row.Y])
        axial_refraction.aim(v, exit_, frame)


@njit(**SUMS)
def _account(v, ledger):
    """Add one row's losses at the surface, and the power that leaves it; that of lost rays becomes 0."""
    flux, power = v[row.FLUX], v[row.POWER]
    fresnel, reflected, missed, leaving = 0.0, 0.0, 0.0, 0.0
    for j in range(len(power)):
        emitted, weight = flux[j], power[j]
        lost = weight < 0.0
        fresnel += 0.0 if lost else emitted - weight
        leaving += 0.0 if lost else weight
        reflected += emitted if lost and weight != row.MISSED_POWER else 0.0
        missed += emitted if weight == row.MISSED_POWER else 0.0
        power[j] = 0.0 if lost else weight
    ledger[LOST_BY_FRESNEL] += fresnel
    ledger[REFLECTED] += reflected
    ledger[LEAVING] += leaving
    ledger[MISSED] += missed


@njit(**FAST)
def _remove_lost(power):
    for j in range(len(power)):
        power[j] = 0.0 if power[j] < 0.0 else power[j]


def scratch_rows(splat: Splat) -> int:
    """Number of rows of a block's scratch memory."""
    return row.VECTORS + row.SCRATCH + 2 * (splat.size_x + splat.size_y)


@njit(inline="always", **FAST)
def _cut(scratch, vx, vy):
    """A block's scratch as vectors, weights along x and y, their slopes."""
    a = row.VECTORS + row.SCRATCH
    b, c, d = a + vx, a + vx + vy, a + 2 * vx + vy
    return scratch[:a], scratch[a:b], scratch[b:c], scratch[c:d], scratch[d:]


@njit(entry=True, **FAST)
def forward(block, images, ledgers, scratch, surface, rays, exit_, frame, splat, oblique, point, parallel):
    """Ledgers (blocks, COLUMNS) of the losses, and partial images, whose `pixels.total` is the padded image.

    images (blocks, n_x + 4 r_x, n_y + 4 r_y, and -v_y % 4 more), ledgers and scratch (blocks, `scratch_rows`, b) are overwritten;
    they set the number of blocks.

    surface, rays, exit_, frame, splat: as in `arguments`.  oblique: True for rays of any direction; point: of rays from one;
    parallel: of parallel rays at an angle to z; all None for rays along z.  Each is compiled apart.
    """
    if on_threads(block, len(images), (images, ledgers, scratch, surface, rays, exit_, frame, splat, oblique, point, parallel)):
        return
    rows, blocks = len(rays.x), len(images)
    images[block] = 0.0
    ledgers[block] = 0.0
    v, sx, sy, dx, dy = _cut(scratch[block], splat.size_x, splat.size_y)
    column = np.zeros(splat.size_y + -splat.size_y % 4)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        _aim(v, i, surface, rays, exit_, frame, oblique, point, parallel)
        _account(v, ledgers[block])
        share(v, splat, sx, sy, dx[:0], dy[:0])
        ledgers[block, OFF_SCREEN] += scatter(v, v.shape[1], frame, splat, sx, sy, images[block], column)


@njit(entry=True, **FAST)
def backward(block, grad, grad_leaving, apart, nets, scratch, surface, rays, exit_, frame, splat, oblique, point, parallel):
    """Adjoint of `forward`: derivatives by the three nets, from those by the padded image and leaving power.

    nets (3, 1 if apart else blocks, n, b) are overwritten: the `pixels.total` of each is the derivative by a net (n, b).

    apart: no two rows share a row of the nets, so that a single sum suffices for all blocks.  Otherwise net_x is taken to be net
    itself, and the sum of both derivatives comes as the first.  scratch: overwritten, as in `forward`.
    """
    if block == ALL and apart and oblique is None:
        nets[:] = 0.0
    if on_threads(
        block,
        len(scratch),
        (grad, grad_leaving, apart, nets, scratch, surface, rays, exit_, frame, splat, oblique, point, parallel),
    ):
        return
    rows, blocks = len(rays.x), len(scratch)
    if not apart:
        nets[:, block] = 0.0
    v, sx, sy, dx, dy = _cut(scratch[block], splat.size_x, splat.size_y)
    column, tilt = np.zeros(splat.size_y + -splat.size_y % 4), np.zeros(splat.size_y + -splat.size_y % 4)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        _aim(v, i, surface, rays, exit_, frame, oblique, point, parallel)
        _remove_lost(v[row.POWER])
        share(v, splat, sx, sy, dx, dy)
        gather(v, v.shape[1], frame, splat, sx, sy, dx, dy, grad, grad_leaving, grad_leaving, column, tilt)
        if oblique is not None:
            landing.pull(v, i, surface, rays, exit_, oblique, point, parallel, nets[0, 0, i], nets[1, 0, i], nets[2, 0, i])
            continue
        if point is not None or parallel is not None:
            landing.pull(v, i, surface, rays, exit_, oblique, point, parallel, v[row.BY_SAG], v[row.BY_GX], v[row.BY_GY])
        else:
            axial_refraction.pull(v, exit_)
        spread(i, surface, v[row.BY_SAG], v[row.BY_GX], v[row.BY_GY], nets[:, 0 if apart else block], apart)
