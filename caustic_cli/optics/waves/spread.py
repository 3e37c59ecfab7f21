"""An extended source that shifts the image: the image of its middle, spread by its own shape.

Light of a source point beside the middle lands shifted by (S_x dx, S_y dy), nearly alike for all of the lens.  How nearly is
measured on the outermost points: `error` is the most by which light lands elsewhere than so shifted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import j1
from torch import Tensor

from caustic_cli.optics.emission.coherent import Mode
from caustic_cli.optics.waves.wavefront import SURVEY, Optics

#: What `error` may be, in parts of what the image shows anyway: of diffraction's blur or a pixel, the larger.
ALLOWED = 0.25
#: Pixels that one of the screen is cut into, at most.
MOST_CUT = 4


@dataclass(frozen=True)
class Spread:
    """half: half axes of the ellipse over which a point of the image is spread, mm, 0 for points; shifts: of the source's positions
    on the screen (dx, dy), mm, and their parts of the power; error: see above."""

    half: tuple[float, float]
    shifts: tuple[tuple[float, float, float], ...]
    error: float

    def reach(self) -> tuple[float, float]:
        """How far it spreads, mm."""
        return tuple(max(abs(s[k]) for s in self.shifts) + self.half[k] for k in (0, 1))

    def grid(self, pixel: tuple[float, float]) -> tuple[int, tuple[int, int]]:
        """Into how many a pixel is cut along each axis to spread the image, and how many of those are needed beside the screen."""
        fine = min((h for h in self.half if h > 0), default=max(self.reach()) / 2.0)
        sub = max(1, min(MOST_CUT, math.ceil(2.0 * max(pixel) / fine))) if fine > 0 else 1
        return sub, tuple(sub * math.ceil(r / w) for r, w in zip(self.reach(), pixel, strict=True))

    def __call__(self, image: Tensor, pixel: tuple[float, float], sub: int, beside: tuple[int, int]) -> Tensor:
        """Spread an image on cut pixels with some beside (a, b); gives that on the screen's."""
        shape = tuple(n + 2 * b for n, b in zip(image.shape, beside, strict=True))
        padded = torch.nn.functional.pad(image, (0, 2 * beside[1], 0, 2 * beside[0]))
        fx = torch.fft.fftfreq(shape[0], pixel[0] / sub, dtype=torch.float64, device=image.device)[:, None]
        fy = torch.fft.rfftfreq(shape[1], pixel[1] / sub, dtype=torch.float64, device=image.device)[None, :]
        turned = 2.0 * math.pi * torch.hypot(fx * self.half[0], fy * self.half[1])
        disc = torch.from_numpy(j1(turned.cpu().numpy())).to(turned)
        disc = torch.where(turned > 1e-9, 2.0 * disc / turned.clamp_min(1e-9), torch.ones_like(turned))
        one = torch.ones_like(turned)
        place = sum(part * torch.polar(one, -2.0 * math.pi * (fx * dx + fy * dy)) for dx, dy, part in self.shifts)
        found = torch.fft.irfft2(torch.fft.rfft2(padded) * (disc * place), s=shape)[: image.shape[0], : image.shape[1]]
        inner = found[beside[0] : image.shape[0] - beside[0], beside[1] : image.shape[1] - beside[1]]
        n, m = inner.shape
        return inner.reshape(n // sub, sub, m // sub, sub).sum((1, 3))


@torch.no_grad()
def spread_by(optics: Optics, edges: list[Mode], shown: float) -> Spread | None:
    """How an extended source spreads the image of its middle; None where it does more than shift it.

    Args:
        optics: of the middle; edges: the outermost points, +x, -x, +y, -y.
        shown: mm, what the image shows anyway.
    """
    source = optics.system.source
    n = (SURVEY + 1) // 2
    device = next((h.device for h in optics.parameters.values()), torch.device("cpu"))
    line = torch.linspace(0.0, 1.0, n, dtype=torch.float64, device=device)
    u, v = (c.reshape(-1) for c in torch.meshgrid(line, line, indexing="ij"))
    at, moved = optics.feet(u, v), []
    for mode in edges:
        f = replace(optics, mode=mode).feet(u, v)
        lit = (f.power > 0) & (at.power > 0)
        if not bool(lit.any()):
            return None
        moved.append([(a - b)[lit] for a, b in ((f.big_x, at.big_x), (f.big_y, at.big_y))])
    # Shifts in proportion to the place on the source, by the outermost along each axis, and what departs from that.
    slope = []
    for k in (0, 1):
        (up, down), (high, low) = edges[2 * k : 2 * k + 2], moved[2 * k : 2 * k + 2]
        apart = up.position[k] - down.position[k]
        slope.append(float(high[k].mean() - low[k].mean()) / apart if apart else 0.0)
    centre = optics.mode.position
    error = max(float(torch.hypot(*(m[k] - slope[k] * (mode.position[k] - centre[k]) for k in (0, 1))).max())
                for mode, m in zip(edges, moved, strict=True))
    if error > ALLOWED * shown or (not source.distant and float(np.ptp(source.points()[0][:, 2])) > 0):
        return None
    if source.distant:
        return Spread(tuple(abs(c) * math.sin(source.half_angle) for c in slope), ((0.0, 0.0, 1.0),), error)
    places = tuple((float(slope[0] * (p[0] - centre[0])), float(slope[1] * (p[1] - centre[1])), float(part))
                   for p, part in zip(*source.points(), strict=True))
    return Spread(tuple(abs(c) * e for c, e in zip(slope, source.extent, strict=True)), places, error)
