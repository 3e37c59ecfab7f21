"""Single rays at 60 digits, and the same by the package's two implementations: exit surface -> Snell, Fresnel -> screen -> pixels.

A ray is (d, t, gx, gy, x, y): unit direction in the glass, the distance along it from height 0 to the surface (mm), the slopes
there, where it starts (mm).  It is read as L = sum of image * WEIGHTS + leaving / 4, differentiated by t, gx and gy.
"""

from __future__ import annotations

import mpmath as mp
import numpy as np
import torch

from caustic_cli.optics.backends import backend_for, plain
from caustic_cli.optics.frames import IDENTITY
from caustic_cli.optics.kernels import fused_functions
from caustic_cli.optics.kernels.arguments import RowsOfRays
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.scene import Screen

mp.mp.dps = 60
HEIGHT = 10.0
SCREEN = Screen((48.0, 48.0), HEIGHT, (16, 16))
FILTER = Filter("cosine", (3, 3))
WEIGHTS = torch.linspace(0.3, 1.7, 256, dtype=torch.float64).view(16, 16).sin() + 1.5


def refracted(n, d, gx, gy):
    """(t_x, t_y, t_z), transmittance, and the radicand over |N|^2, or None where totally reflected; all mpf."""
    norm2 = 1 + gx * gx + gy * gy
    c = d[2] - d[0] * gx - d[1] * gy
    radicand = norm2 * (1 - n * n) + n * n * c * c
    if radicand <= 0:
        return None
    s = mp.sqrt(radicand)
    gamma = (s - n * c) / norm2
    rs, rp = (n * c - s) / (n * c + s), (c - n * s) / (c + n * s)
    return (n * d[0] - gamma * gx, n * d[1] - gamma * gy, n * d[2] + gamma), 1 - (rs * rs + rp * rp) / 2, radicand / norm2


def read(n, d, t, gx, gy, x, y):
    """L of one ray of power 1 just below the surface, mpf; arguments mpf."""
    found = refracted(n, d, gx, gy)
    if found is None:
        return mp.mpf(0)
    out, power, _ = found
    path = (HEIGHT - t * d[2]) / out[2]
    if out[2] <= 0 or path <= 0:
        return power / 4
    total, pixel = mp.mpf(0), mp.mpf(SCREEN.pixel[0])
    px, py = ((a + t * b + path * c) / pixel + 8 for a, b, c in ((x, d[0], out[0]), (y, d[1], out[1])))
    i, j = int(mp.floor(px)), int(mp.floor(py))
    for k in (-1, 0, 1):
        for m in (-1, 0, 1):
            if 0 <= i + k < 16 and 0 <= j + m < 16:
                share = [(1 + mp.cos(2 * mp.pi * (a + b + mp.mpf(1) / 2 - p) / 3)) / 3 for a, b, p in ((i, k, px), (j, m, py))]
                total += float(WEIGHTS[i + k, j + m]) * share[0] * share[1]
    return power * (total + mp.mpf(1) / 4)


def exactly(n: float, d, t: float, gx: float, gy: float, x: float, y: float):
    """L and its derivatives by t, gx, gy: four mpf.  The numbers are taken as they are, all their bits."""
    n, t, gx, gy, x, y = (mp.mpf(v) for v in (n, t, gx, gy, x, y))
    d = tuple(mp.mpf(v) for v in d)
    step = mp.mpf(10) ** -28
    sides = [[read(n, d, *(v + s * step * (k == i) for i, v in enumerate((t, gx, gy))), x, y) for s in (1, -1)] for k in range(3)]
    return read(n, d, t, gx, gy, x, y), *((a - b) / (2 * step) for a, b in sides)


def carried(direction, slopes, power, start, eta: float, height: float, fresnel: str = "exact"):
    """Rays from the exit surface to the screen in plain torch: x, y, power that arrives, and all that leaves the surface.

    direction: before it; start: x, y and z of the hits, mm; z counted as the screen's height.
    """
    with plain():
        stages = backend_for("cpu")
    out = stages.interact(direction, slopes, power, eta=eta, reflects=False, fresnel=fresnel)
    x, y, on_way = stages.land(start, out.direction, (0.0, 0.0, height), IDENTITY, 1.0)
    return x, y, torch.where(on_way, out.power, torch.zeros_like(out.power)), out.power.sum(dtype=torch.float64)


def splatted(nets, x, y, directions, power, fresnel: str, eta: float, filter: Filter):
    """Rays from the exit surface to the screen by the fused kernel: image, power that leaves, what is lost.

    nets: distances along the rays (or heights) and slopes, (1, N); directions: x and y of them, None for a plane wave.
    """
    along = [fused_functions._NONE] * 2 if directions is None else [fused_functions._strided(c.numpy()) for c in directions]
    x, y, power = (fused_functions._strided(a.numpy()) for a in (x, y, power))
    ones = np.ones((1, 1))
    return fused_functions._splat(
        nets,
        (np.zeros(1, np.int64), ones, ones),
        True,
        RowsOfRays(x, y, *along, power),
        (eta, fresnel),
        (0.0, HEIGHT),
        SCREEN,
        filter,
        fused_functions._Workspace(),
    )


def ours(kernels: str, dtype: torch.dtype, n: float, d, t, gx, gy, x, y) -> tuple[float, np.ndarray]:
    """L of all rays together, and its derivatives (3, N).  d: one direction, None for a plane wave; others (N,) arrays.

    The kernel is float64 alone: it takes a plane wave's numbers rounded to `dtype`, and others as they are.
    """
    rounded = torch.float64 if d is not None and kernels == "fused" else dtype
    dtype = torch.float64 if kernels == "fused" else dtype
    leaves = [torch.tensor(np.asarray(a, float)[None, :]).to(rounded).to(dtype).requires_grad_() for a in (t, gx, gy)]
    count = leaves[0].shape[1]
    x, y = (torch.tensor(np.broadcast_to(np.asarray(a, float), (1, count)).copy()).to(rounded).to(dtype) for a in (x, y))
    one = torch.ones(1, count, dtype=dtype)
    if kernels == "fused":
        along = None if d is None else [c * one for c in d[:2]]
        image, leaving, _ = splatted(leaves, x, y, along, one, "exact", n, FILTER)
    else:
        direction = (0.0, 0.0, 1.0) if d is None else tuple(c * one for c in d)
        start = tuple(o + leaves[0] * c for o, c in zip((x, y, 0.0), direction, strict=True))
        x, y, power, leaving = carried(direction, leaves[1:], one, start, n, HEIGHT)
        image = splat(x, y, power, SCREEN, FILTER)[0]
    value = (image.double() * WEIGHTS).sum() + leaving.double() / 4
    if not value.requires_grad:
        return float(value), np.zeros((3, count))
    return float(value.detach()), torch.cat(torch.autograd.grad(value, leaves)).double().numpy()
