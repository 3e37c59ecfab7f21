"""Wave images on tilted and curved screens, from a stack of planes normal to the axis.

Notation, on a plane at distance L_k, for light with intercepts x on the reference plane (see `wavefront`)
    U, U_x      propagated fields of u and of x u
    P           (X |U|^2 - Re(conj(U) U_x)) / L, power density times mean slope: the transverse flux
    d           P / |U|^2 of the light as a whole, from a linear fit of the map from intercepts to landing points

A point of the screen at height z above the nearest plane takes |U|^2 and P from the point where its light crosses that plane,
(X - z a) / (1 + z b) with d = a + b X, diluted by 1 + z b along each axis.  Its power per area of the pixel's cell in the tangent
plane is |U|^2 n_z + P . n, n the screen's normal of the length of its area over that of the cell.  The planes are so close that
deviations from the linear map, and interference fringes of two pixels, shift by less than STEP of a pixel in between.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.receiver import Receiver, dot
from caustic_cli.optics.waves.propagation import phase_of
from caustic_cli.optics.waves.sampling import Sampling
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.optics.waves.wavefront import Wavefront

#: Tolerated shift of light between planes, in pixels; largest number of planes; sample points along each axis of a pixel.
STEP, MOST_PLANES, A_PIXEL = 0.2, 400, 4


def power_by_planes(r: Receiver, s: Sampling, front: Wavefront, length: float, behind: float, dtype: torch.dtype) -> Tensor:
    """Power of one wavefront on the pixels of a tilted or curved screen, float64.

    length, behind: wavelength in vacuum and in the image space, mm.

    Raises:
        NoWaveImage: too many planes are needed.
    """
    device = front.path.device
    if not bool((front.density > 0).any()):  # no light lands near the screen
        return torch.zeros(r.resolution, dtype=torch.float64, device=device)
    (x, y, z), normal = _samples(r, device)
    path, root, lit = front.on(s.low, s.step, s.count).rows()
    amplitude = root * lit
    foot = [s.low[k] + s.step[k] * (torch.arange(s.count[k], dtype=torch.float64, device=device) + 0.5) for k in (0, 1)]
    maps = _mean_map(front, s.distance)  # slopes qx, qy of the light that lands at X, Y: a + b X
    depth = float(z.abs().max())
    residual = max(m[2] for m in maps) + 0.5 * behind / min(r.pixel)
    planes = max(1, math.ceil(2.0 * depth * residual / (2.0 * STEP * min(r.pixel))))
    if planes > MOST_PLANES:
        raise NoWaveImage(
            f"a wave image of this screen needs {planes} planes, at most {MOST_PLANES} are made: less tilt, less curvature or"
            " larger pixels need fewer"
        )
    image = torch.zeros_like(z)
    height = 2.0 * depth / planes
    for k in range(planes):
        above = -depth + (k + 0.5) * height
        here = (z - above).abs() <= 0.5 * height * (1.0 + 1e-12)
        if not bool(here.any()):
            continue
        image = image + _through(
            replace(s, distance=s.distance + above),
            path,
            amplitude,
            foot,
            maps,
            (x, y, z - above),
            normal,
            here,
            length,
            behind,
            dtype,
            r.pixel,
        )
    cell = r.pixel[0] * r.pixel[1] / A_PIXEL**2
    n, m = r.resolution
    return image.view(n, A_PIXEL, m, A_PIXEL).sum((1, 3)) * cell


def _samples(r: Receiver, device: torch.device) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Sample points of a screen's pixels, from its `Receiver.plane` and in the frame of that, mm, and normals as in the module's
    notation; three components each, of all samples along x and y."""
    plane = r.plane
    lines = [
        r.low[k] + r.pixel[k] * (torch.arange(A_PIXEL * r.resolution[k], dtype=torch.float64, device=device) + 0.5) / A_PIXEL
        for k in (0, 1)
    ]
    u, v = torch.meshgrid(*lines, indexing="ij")
    sag, *slopes = (torch.from_numpy(c).to(device) for c in r.shape.at(u.cpu().numpy(), v.cpu().numpy()))

    def turned(vector: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """From the screen's frame to the plane's."""
        return tuple(torch.stack([dot(a, e) * c for a, c in zip(r.axes, vector, strict=True)]).sum(0) for e in plane.axes)

    x, y, z = (c + dot(r.middle, e) for c, e in zip(turned((u, v, sag)), plane.axes, strict=True))
    facing = math.copysign(1.0, dot(r.axes[2], plane.axes[2]))
    return (x, y, z - plane.z), turned((-facing * slopes[0], -facing * slopes[1], torch.full_like(sag, facing)))


class PlanesExposure:
    """`propagation.Exposure` of such a screen; arguments: as of `power_by_planes`."""

    def __init__(self, r: Receiver, s: Sampling, front: Wavefront, length: float, behind: float, dtype: torch.dtype):
        self.front, self.rest = front, (length, behind, dtype)
        self.receiver, self.sampling = r, s
        self.kept: tuple[Tensor, Tensor] | None = None

    @property
    def resolution(self) -> tuple[int, int]:
        """Pixels along both axes."""
        return self.receiver.resolution

    def image(self, change: Tensor, keep: bool = False) -> Tensor:
        """As of `propagation.Exposure`."""
        with torch.set_grad_enabled(keep):
            leaf = change.detach().requires_grad_(keep)
            found = power_by_planes(self.receiver, self.sampling, replace(self.front, path=self.front.path + leaf), *self.rest)
        self.kept = (leaf, found) if keep else None
        return found.detach()

    def pull(self, by_pixel: Tensor, change: Tensor, out: Tensor) -> None:
        """As of `propagation.Exposure`."""
        if self.kept is None:
            self.image(change, keep=True)
        assert self.kept is not None
        (leaf, found), self.kept = self.kept, None
        out += pull_back([found], [leaf], [by_pixel])[0]


def _through(s, path, amplitude, foot, maps, point, normal, here, length, behind, dtype, pixel) -> Tensor:
    """Irradiance at the screen's sample points near one plane, 0 elsewhere."""
    u = torch.polar(amplitude.to(dtype), phase_of(path, s, length, behind).to(dtype))
    moments = (u, u * foot[0].to(dtype)[:, None], u * foot[1].to(dtype)[None, :])
    fields = [torch.fft.fft2(w, s=s.padded, norm="ortho") for w in moments]
    (dx, dy), (x0, y0) = s.spacing(behind), s.first(behind)
    x, y, z = point
    grid_x, grid_y = (
        c0 + d * torch.arange(n, dtype=dtype, device=path.device) for c0, d, n in zip((x0, y0), (dx, dy), s.padded, strict=True)
    )
    density = (fields[0].real.square() + fields[0].imag.square()) / (dx * dy)
    flux = [
        (grid * density - (fields[0].conj() * moved).real / (dx * dy)) / s.distance
        for grid, moved in ((grid_x[:, None], fields[1]), (grid_y[None, :], fields[2]))
    ]
    power = torch.stack([*flux, density])
    for axis, width in ((0, pixel[0] / dx), (1, pixel[1] / dy)):  # average over the area between the sample points
        half = int(0.5 * width / A_PIXEL)
        if half > 0:
            size, pad = ((2 * half + 1, 1), (half, 0)) if axis == 0 else ((1, 2 * half + 1), (0, half))
            power = torch.nn.functional.avg_pool2d(power[None], size, 1, pad)[0]
    thinner = [1.0 + z * b for _, b, _ in maps]
    at_x, at_y = (
        ((c - z * a) / t - c0) / d for c, (a, _, _), t, c0, d in zip((x, y), maps, thinner, (x0, y0), (dx, dy), strict=True)
    )
    n, m = s.padded
    spots = torch.stack([2.0 * at_y[here] / (m - 1) - 1.0, 2.0 * at_x[here] / (n - 1) - 1.0], -1).to(dtype)
    seen = torch.nn.functional.grid_sample(power[None], spots[None, None], mode="bicubic", align_corners=True)[0, :, 0]
    through = (torch.stack([c[here] for c in normal]) * seen.double()).sum(0)
    return torch.zeros_like(x).masked_scatter(here, through) / (thinner[0] * thinner[1])


@torch.no_grad()
def _mean_map(front: Wavefront, distance: float) -> list[tuple[float, float, float]]:
    """Linear fit of the slope for each axis: (a, b, largest residual) of the slope a + b X of light that lands at X."""
    weight, found = front.density, []
    n, m = weight.shape
    foot = (
        (front.low[0] + front.step[0] * (torch.arange(n).to(weight) + 0.5))[:, None].expand(n, m),
        (front.low[1] + front.step[1] * (torch.arange(m).to(weight) + 0.5))[None, :].expand(n, m),
    )
    lit = weight > 0
    for big, x in zip(front.landing, foot, strict=True):
        q, c, w = ((big - x) / distance)[lit], big[lit], weight[lit] / weight[lit].sum()
        mean_q, mean_c = float((w * q).sum()), float((w * c).sum())
        spread = float((w * (c - mean_c) ** 2).sum())
        b = float((w * (q - mean_q) * (c - mean_c)).sum()) / spread if spread > 0 else 0.0
        a = mean_q - b * mean_c
        found.append((a, b, float((q - a - b * c).abs().max())))
    return found
