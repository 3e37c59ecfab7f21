"""The screen as it is seen from the lens' exit, through the lenses and mirrors behind it: a plane of reference for its wavefront.

Notation, along each transverse axis, for rays that leave the exit at x and land on the screen at X with the direction cosine p
    D, B, c     least-squares fit over the rays of a survey: x = D X - B p + c
    L           distance of an equivalent screen, |B| of the first axis, mm
    s           magnification of the exit in its coordinates, L / B
    x^          s (D X - B p + c), the intercept, and q^ = (X - x^) / L its slope
    V           optical path length to X, v^ that to the intercept, n the index in front of the screen

For any D and B the map from (X, p) to (x^, q^) is canonical.  With the generating function of the two points,

    v^ = V - n L q^2 / 2 - n ((s D - 1) X^2 + 2 s c X) / (2 L),     d v^ / d x^ = n q^

so that light that starts from x^ with this path and travels freely over L (Collins' integral of the optics behind the exit, with
its quadratic phase in v^) arrives at the traced landing points with the exact optical paths, as without other elements
(`wavefront`).  The fit makes the intercepts those points of the exit that the rays left, up to aberrations of the optics behind it;
geometrical optics bridges these.

Source: S. A. Collins, Lens-system diffraction integral written in terms of matrix optics, J. Opt. Soc. Am. 60, 1168 (1970).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.optics.waves.unsupported import NoWaveImage

#: Least distance L relative to the screen's: nearer to an image of the exit its structure is not resolved by its directions.
IMAGED = 1e-3
IS_IMAGED = "the screen is conjugate to the lens through the elements behind it, so that its wave image is that of its surface"


def conjugate_of(at: tuple[Tensor, Tensor], behind: tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]) -> float:
    """Distance of the image of the exit from a plane behind the last element, over a unit of slopes.

    Args:
        at: points of the exit, x and y, mm, (N,) each; behind: along each axis, where the same rays pass the plane, mm, and their
            slopes there in any unit, (N,) each: those through one point of the exit pass one point of its image.
    """
    found = []
    for x, (there, slope) in zip(at, behind, strict=True):
        by = torch.stack([there, slope, torch.ones_like(there)], -1)
        a, b, _ = torch.linalg.lstsq(by, x[:, None], driver="gelsd").solution[:, 0].tolist()
        found.append(b / a)
    return 0.5 * sum(found)


@dataclass(frozen=True)
class ImagedExit:
    """The coefficients s D, L and s c along both axes; see the module."""

    d: tuple[float, float]
    distance: float
    c: tuple[float, float]

    @classmethod
    def fitted(
        cls, at: tuple[Tensor, Tensor], landing: tuple[Tensor, Tensor], slopes: tuple[Tensor, Tensor], far: float
    ) -> ImagedExit:
        """From points of the exit, landing points, mm, and direction cosines on the screen of lit rays, (N,) each; far: length of
        the way to the screen, mm.

        Raises:
            NoWaveImage: the screen is an image of the exit.
        """
        found = []
        for x, big, p in zip(at, landing, slopes, strict=True):
            by = torch.stack([big, -p * far, torch.ones_like(big)], -1)
            d, b, c = torch.linalg.lstsq(by, x[:, None], driver="gelsd").solution[:, 0].tolist()
            found.append((d, b * far, c))
        distance = abs(found[0][1])
        if min(abs(b) for _, b, _ in found) < IMAGED * far:
            raise NoWaveImage(IS_IMAGED)
        (d, e), (c, f) = (tuple(distance / one[1] * one[k] for one in found) for k in (0, 2))
        return cls((d, e), distance, (c, f))

    def intercept(self, axis: int, landing: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """x^ and q^ along an axis, from X, mm, and p."""
        x = self.d[axis] * landing - self.distance * slope + self.c[axis]
        return x, (landing - x) / self.distance

    def path(self, axis: int, landing: Tensor) -> Tensor:
        """What v^ is shorter than V - L q^2 / 2 because of an axis, mm, in units of 1 / n."""
        return ((self.d[axis] - 1.0) * landing * landing + 2.0 * self.c[axis] * landing) / (2.0 * self.distance)
