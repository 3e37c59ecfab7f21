"""Fused CPU kernel: refraction at the exit surface -> landing point -> splat, with its adjoint.

It combines the stages of `optics.trace`, row by row of rays without intermediate storage; the plain-torch backend is its reference.
Everything is float64, since float32 was no faster.

Each of a fixed number of blocks of rows accumulates an image of its own, and these are added in order, so the result depends on the
number of blocks (threads) but not on timing.  Only the scatter to and the gather from pixels are per ray; the rest (`rows`,
`axial_refraction` or `landing`, `filter_weights`) is vectorised over rows.
"""

from __future__ import annotations

from caustic_cli.optics.kernels import landing
from caustic_cli.optics.kernels import rows as row
from caustic_cli.optics.kernels.jit import FAST, SUMS, njit
from caustic_cli.optics.kernels.rows import WIDE, spread
from caustic_cli.optics.kernels.splat import gather, scatter, share
from caustic_cli.optics.kernels.threads import ALL, on_threads

LOST_BY_FRESNEL, REFLECTED, OFF_SCREEN, LEAVING, MISSED, COLUMNS = range(6)  # of the ledger


@njit(**SUMS)
def _account(flux, power, ledger):
    """Add a batch's losses, and the power that leaves it, unless `ledger` is None; the power of lost rays becomes 0."""
    fresnel, reflected, missed, leaving = 0.0, 0.0, 0.0, 0.0
    for j in range(len(power)):
        emitted, weight = flux[j], power[j]
        lost = weight < 0.0
        fresnel += 0.0 if lost else emitted - weight
        leaving += 0.0 if lost else weight
        reflected += emitted if lost and weight != row.MISSED_POWER else 0.0
        missed += emitted if weight == row.MISSED_POWER else 0.0
        power[j] = 0.0 if lost else weight
    if ledger is not None:
        ledger[LOST_BY_FRESNEL] += fresnel
        ledger[REFLECTED] += reflected
        ledger[LEAVING] += leaving
        ledger[MISSED] += missed


@njit(entry=True, **FAST)
def forward(block, images, ledgers, scratch, surface, rays, exit_, frame, splat, oblique, point, parallel):
    """Ledgers (blocks, COLUMNS) of the losses, and partial images, whose `pixels.total` is the padded image.

    images (blocks, n_x + 4 r_x, n_y + 4 r_y, and -v_y % 4 more), ledgers and scratch (`rows.room`) are overwritten; they set the
    number of blocks.

    surface, rays, exit_, frame, splat: as in `arguments`.  oblique: True for rays of any direction; point: of rays from one;
    parallel: of parallel rays at an angle to z; all None for rays along z.  Each is compiled apart.
    """
    if on_threads(block, len(images), (images, ledgers, scratch, surface, rays, exit_, frame, splat, oblique, point, parallel)):
        return
    (rows, columns), blocks = rays.x.shape, len(images)
    images[block] = 0.0
    ledgers[block] = 0.0
    v, sx, sy, dx, dy, column, _ = row.cut(scratch[block], splat)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        for start in range(0, columns, WIDE):
            count = min(WIDE, columns - start)
            landing.aim(v, i, start, count, surface, rays, exit_, frame, oblique, point, parallel)
            _account(v[row.FLUX][:count], v[row.POWER][:count], ledgers[block])
            share(v, count, splat, sx, sy, dx[:0], dy[:0])
            ledgers[block, OFF_SCREEN] += scatter(v, count, frame, splat, sx, sy, images[block], column)


@njit(entry=True, **FAST)
def backward(block, grad, grad_leaving, apart, nets, scratch, surface, rays, exit_, frame, splat, oblique, point, parallel):
    """Adjoint of `forward`: derivatives by the three nets, from those by the padded image and leaving power.

    nets (3, 1 if apart else blocks, n, b) are overwritten: the `pixels.total` of each is the derivative by a net (n, b).

    apart: no two rows share a row of the nets, so that a single sum suffices for all blocks.  Otherwise net_x is taken to be net
    itself, and the sum of both derivatives comes as the first.  scratch: overwritten, as in `forward`.
    """
    if block == ALL and apart:
        nets[:] = 0.0
    if on_threads(
        block,
        len(scratch),
        (grad, grad_leaving, apart, nets, scratch, surface, rays, exit_, frame, splat, oblique, point, parallel),
    ):
        return
    (rows, columns), blocks = rays.x.shape, len(scratch)
    to = 0 if apart else block
    if not apart:
        nets[:, to] = 0.0
    v, sx, sy, dx, dy, column, tilt = row.cut(scratch[block], splat)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        for start in range(0, columns, WIDE):
            count = min(WIDE, columns - start)
            landing.aim(v, i, start, count, surface, rays, exit_, frame, oblique, point, parallel)
            _account(v[row.FLUX][:count], v[row.POWER][:count], None)
            share(v, count, splat, sx, sy, dx, dy)
            gather(v, count, frame, splat, sx, sy, dx, dy, grad, grad_leaving, grad_leaving, column, tilt)
            landing.pull(v, count, exit_, oblique, point, parallel)
            by_sag, by_gx, by_gy = v[row.BY_SAG][:count], v[row.BY_GX][:count], v[row.BY_GY][:count]
            spread(i, start, surface, by_sag, by_gx, by_gy, nets[:, to], apart)
