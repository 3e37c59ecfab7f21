"""The initial surface of a lamp by optimal transport on the sphere, with the cost of the far-field refractor.

The surface r(x) = b / (1 - k x.y), k = 1 / n, an ellipsoid with the source at a focus, refracts all its light into the direction y.
The upper envelope of such ellipsoids, one for each direction of the target, sends the light of each part of the sphere in its own
direction (Gutierrez and Huang, Arch. Rational Mech. Anal. 193, 2009), and which parts these are is an optimal transport of the
light, from directions x to directions y, with the cost

    c(x, y) = log(1 - k x.y),    -log r(x) = min_y (c(x, y) - g(y)),

whose Kantorovich potential is the surface itself.  The entropic problem is solved by Sinkhorn's iterations in the log domain, with
e decreased to that of the sampling; then

    -log r(x) = -e log sum_j b_j exp((g_j - c(x, y_j)) / e),

a smooth function of any direction x, and so defined beyond the light.
"""

from __future__ import annotations

import torch
from torch import Tensor

from caustic_cli.optics.lamp import LAMBERTIAN, emitted
from caustic_cli.optics.surfaces.polarfield import PolarField, Vectors, direction_of
from caustic_cli.scene.lamp import Chip

#: Cells of the source along u and v.
CELLS = 44
#: Regularisation e: first and last, the factor between them, and iterations at each and at the last.  The cost varies by 0.01 over
#: a cell of the source.
FIRST, LAST, FACTOR, EACH, FINAL = 0.3, 3e-3, 0.6, 8, 40
#: Control values evaluated at a time.
CHUNK = 512


def source_directions(cells: int = CELLS, chip: Chip = LAMBERTIAN) -> tuple[Tensor, Tensor]:
    """Directions (N, 3) of a point of a chip on a grid of stereographic coordinates, and its light there (N,), of sum 1."""
    u = (2.0 * torch.arange(cells, dtype=torch.float64) + 1.0) / cells - 1.0
    u, v = (c.reshape(-1) for c in torch.meshgrid(u, u, indexing="ij"))
    lit = u * u + v * v < 1.0
    u, v = u[lit], v[lit]
    weight = emitted(chip, u, v)
    return torch.stack(direction_of(u, v), 1), weight / weight.sum()


def refractor_potential(x: Tensor, a: Tensor, y: Tensor, b: Tensor, index: float) -> tuple[Tensor, float]:
    """The potential g (M,) of the target's directions, and the regularisation e that belongs to it.

    Args:
        x: unit directions of the light (N, 3); a: its power (N,), of sum 1.
        y: those of the target (M, 3); b: the power wanted there (M,), positive, of sum 1.
        index: of the lens, into vacuum.
    """
    cost = torch.log1p(-(x @ y.T) / index)
    log_a, log_b = a.log(), b.log()
    g, e = torch.zeros_like(b), FIRST
    while True:
        for _ in range(FINAL if e == LAST else EACH):
            f = -e * torch.logsumexp((g - cost) / e + log_b, 1)
            g = -e * torch.logsumexp((f[:, None] - cost) / e + log_a[:, None], 0)
        if e == LAST:
            return g, e
        e = max(LAST, FACTOR * e)


def envelope(directions: Vectors, y: Tensor, b: Tensor, g: Tensor, e: float, index: float) -> Tensor:
    """log r (N,) in directions (N,) each, see the module; up to a constant."""
    x, log_b, out = torch.stack(directions, 1), b.log(), []
    for part in x.split(CHUNK):
        cost = torch.log1p(-(part @ y.T) / index)
        out.append(e * torch.logsumexp((g - cost) / e + log_b, 1))
    return torch.cat(out)


def transported(
    field: PolarField, x: Tensor, a: Tensor, y: Tensor, b: Tensor, index: float, radius: float
) -> tuple[Tensor, Tensor]:
    """Control values (n, m) of r of the refractor that sends the light of a point to a target, and the directions (N, 3), about
    unit vectors, into which it sends that of each x: the mean of the plan of the transport.

    Args:
        x, a, y, b: the light within the lens and the target, as for `refractor_potential`.
        radius: greatest r towards the lit hemisphere, mm.
    """
    g, e = refractor_potential(x, a, y, b, index)
    u, v = field.net.control_xy()
    u, v = (c.reshape(-1) for c in torch.meshgrid(u, v, indexing="ij"))
    log_r = envelope(direction_of(u, v), y, b, g, e, index)
    values = field.net.interpolated((log_r - log_r.max()).exp().view(field.shape))
    lit = u * u + v * v <= 1.0
    plan = torch.softmax((g - torch.log1p(-(x @ y.T) / index)) / e + b.log(), 1)
    return radius / float(values.reshape(-1)[lit].max()) * values, plan @ y
