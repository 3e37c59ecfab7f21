"""The inner side of a wall of even thickness: the surface parallel to the base surface of a lens, at a distance below it.

Notation
    f(a)        sag of the base surface at a = (x, y), g = (f_x, f_y) its slopes, L = sqrt(1 + |g|^2), all from its vertex
    t           thickness of the wall, mm, along the normal (-g_x, -g_y, 1) / L

The point of the inner side under a is a + t g / L, at the height f(a) + t (1 - 1 / L) above the inner vertex.  At a given point p
the equation a = p - t g(a) / L(a) is solved by iteration, which converges where the wall is thinner than the radius of curvature of
the base surface, as it has to be for the inner side to be smooth.  Of a sphere or cylinder it is the concentric one, of the radius
R + t in the sign convention of `scene.Offset`.
"""

from __future__ import annotations

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.optics.surfaces.fixed import Fixed
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import freeform_of
from caustic_cli.scene import FreeForm, Lens, Offset
from caustic_cli.scene.aperture import larger

#: Points along each axis of the interpolating cubic spline: of slopes up to 1.3 it departs by less than 1e-8 of the radius.
POINTS = 129
#: Half widths of a continued surface over those of the aperture.
BEYOND = 1.1
#: Most iterations, and the change of a, in parts of the half width, at which they end.
STEPS, STILL = 200, 1e-10


def parallel_side(base: Offset, wall: float, half_size: tuple[float, float]) -> FreeForm:
    """The inner side over an aperture of half widths `half_size`, mm, from its vertex.

    Raises:
        InputError: the wall is not thinner than the least radius of curvature of the base surface, or its inner side ends within
            the aperture.
    """
    if not wall > 0:
        raise InputError(f"⟨lens.entrance⟩ parallel needs ⟨+lens.thickness⟩ above z_in, the thickness of the wall, got {wall:g} mm")
    x, y = np.meshgrid(*(np.linspace(-r, r, POINTS) for r in half_size), indexing="ij")
    a, b = x, y
    gx, gy = base.slopes(a, b)
    for _ in range(STEPS):
        over = wall / np.sqrt(1.0 + gx * gx + gy * gy)
        before, (a, b) = (a, b), (x - over * gx, y - over * gy)
        if max(np.abs(a - before[0]).max(), np.abs(b - before[1]).max()) <= STILL * max(half_size):
            break
        try:
            gx, gy = base.slopes(a, b)
        except InputError as error:
            raise InputError(
                f"⟨lens.entrance⟩ parallel: the inner side of a wall of {wall:.3g} mm ends within the aperture; a narrower lens or"
                " a thinner wall has one (where the thickness is derived, the relief makes it so thick: limits of its depth,"
                " ⟨+lens.height_range⟩, or a larger ⟨+mag⟩ lessen it)"
            ) from error
    else:
        raise InputError(f"⟨lens.entrance⟩ parallel needs a wall thinner than the radii of the base surface, got {wall:g} mm")
    gx, gy = base.slopes(a, b)
    z = base.sag(a, b) + wall * (1.0 - 1.0 / np.sqrt(1.0 + gx * gx + gy * gy))
    return freeform_of(*HeightField.through(z, half_size))


def beyond_aperture(lens: Lens) -> Fixed:
    """A lens' curved entrance, continued beyond its aperture, for rays that are searched there."""
    assert lens.entrance is not None
    u = np.linspace(-BEYOND, BEYOND, POINTS)
    return Fixed(*HeightField.through(lens.entrance.at(u, u), larger(lens.half_size, BEYOND)))
