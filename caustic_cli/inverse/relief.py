"""The relief of a lens on a given base surface: its place between its limits, and the size of the picture that they allow.

Notation
    f, z        base surface and exit, mm;  r = z - f  the relief, at the control points
    A           magnification by the base surface alone, along x and y: paraxial, through entrance and base surface (ABCD matrices)
    D, n        distance from the exit to the screen, mm; index

Where the light that passes x lands at T = A x + (n - 1) D grad r, the map T is the gradient of phi = A |x|^2 / 2 + (n - 1) D r.  A
picture s times as large has the potential s phi, and so the relief

    r_s = s r + (s - 1) A |x|^2 / (2 (n - 1) D)

with A along each axis: to first order in all angles.  A constant added to r moves no light, so that it is free to place the relief
between its limits.
"""

from __future__ import annotations

import numpy as np

from caustic_cli.errors import at_most
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability

MAGNIFICATION = Capability(
    "advice on the magnification that a relief allows",
    {
        "mirror": "it has no entrance",
        "other elements": "they magnify the picture, too",
        "tilted light": "it is that of light along the axis",
        "lenslet array": "it is that of one lens",
        "far field": "there is no distance",
        "gradient index": "its index deflects light, too",
    },
)
#: Sizes of a picture that are tried, over that of the picture: 0.2 to 5.
SIZES = np.geomspace(0.2, 5.0, 401)
#: Part of the half width over which the curvature at a vertex is measured.
NEAR = 1e-2


def placed(heights: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Heights (n, m), mm, moved as a whole as little as brings them between their limits, or to the middle of them; and the depth
    that the limits lack, mm, 0 if there is none: control heights beyond them have to be cut off."""
    least, most = float((low - heights).max()), float((high - heights).min())
    move = min(max(0.0, least), most) if least <= most else 0.5 * (least + most)
    return heights + move, max(0.0, least - most)


def magnification(scene: Scene) -> tuple[float, float]:
    """A along x and y."""
    lens, source = scene.lens, scene.source
    n, wall, throw = lens.index, lens.offset.thickness - lens.z_in, scene.screen.z - lens.offset.thickness
    diverging, found = 0.0 if source.distant else 1.0 / (lens.z_in - source.centre[2]), []
    for axis, half in enumerate(lens.half_size):
        x = half * NEAR * np.array([-1.0, 0.0, 1.0])
        lines = (x, np.zeros(1)) if axis == 0 else (np.zeros(1), x)
        exit = lens.offset.sag(lines[0][:, None], lines[1][None, :]).ravel()
        entrance = np.zeros(3)
        if lens.entrance is not None:
            entrance = lens.entrance.at(*(c / r for c, r in zip(lines, lens.half_size, strict=True))).ravel()
        first, last = (float(np.diff(z, 2)[0]) / (half * NEAR) ** 2 for z in (entrance, exit))
        inside = (diverging - (n - 1.0) * first) / n  # tangent of a ray at height 1, behind the entrance
        height = 1.0 + wall * inside
        behind = n * inside + (n - 1.0) * last * height
        found.append(1.0 + throw * behind / height)
    return found[0], found[1]


def words(scene: Scene, field: HeightField, heights: np.ndarray, lacking: float, picture: tuple[float, float]) -> str:
    """What is to be said where the limits of the relief lack depth, mm, for a picture of this size, mm."""
    lens, (low, high) = scene.lens, scene.lens.height_range
    text = (
        f"the picture takes a relief {high - low + lacking:.3g} mm deep, and ⟨lens.height_range⟩ leaves {high - low:.3g} mm: it is"
        " cut off at its limits, as the figures of the design will show"
    )
    if not MAGNIFICATION.supports(scene):
        return text
    x, y = (c.numpy() for c in field.control_xy())
    relief, (across, along) = heights - lens.offset.heights(x, y), magnification(scene)
    bowl = (across * x[:, None] ** 2 + along * y[None, :] ** 2) / (
        2.0 * (lens.index - 1.0) * (scene.screen.z - lens.offset.thickness)
    )
    depths = np.array([np.ptp(s * relief + (s - 1.0) * bowl) for s in SIZES])
    fits = np.flatnonzero(depths <= high - low)
    if not len(fits):
        mag = picture[0] / lens.size[0] * SIZES[depths.argmin()]
        return (
            f"{text}; the least is {depths.min():.3g} mm, at a ⟨+mag⟩ of {mag:.2g}, and a longer ⟨+throw⟩ lessens it in proportion"
        )
    best = SIZES[fits[np.abs(np.log(SIZES[fits])).argmin()]]
    return f"{text}; it is deep enough for a ⟨+mag⟩ of about {at_most(picture[0] / lens.size[0] * best, 2)}"
