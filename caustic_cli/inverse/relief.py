"""The relief of a lens on a given base surface: its place between its limits, and the size of the picture that they allow.

To first order in all angles the relief of a picture s times as large is linear in s, since the light that passes a point then
lands s times as far from the middle: reliefs of sizes in between follow from those that were solved for, to the same order, and
the one that is found is solved for in turn.  A constant added to a relief moves no light, so that it is free to place it between
its limits.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caustic_cli.errors import InputError, at_least, at_most
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability

MAGNIFICATION = Capability("advice on the magnification that a relief allows", {"lenslet array": "it is that of one lens"})
#: Sizes of a picture that are tried, over that of the picture, of which those that are solved for first, or these where light does
#: not reach that far; cells and most number of further ones, and the factor of the size that needs none.
SIZES = np.geomspace(0.2, 5.0, 401)
ENDS = ((0.2, 0.5), (5.0, 2.0))
CELLS, SOLVED, CLOSE = 64, 4, 1.03


def placed(heights: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Heights (n, m), mm, moved as a whole as little as brings them between their limits, or to the middle of them; and the depth
    that the limits lack, mm, 0 if there is none: control heights beyond them have to be cut off."""
    least, most = float((low - heights).max()), float((high - heights).min())
    move = min(max(0.0, least), most) if least <= most else 0.5 * (least + most)
    return heights + move, max(0.0, least - most)


def words(
    scene: Scene, field: HeightField, heights: np.ndarray, lacking: float, picture: tuple[float, float], target: np.ndarray
) -> str:
    """What is to be said where the limits of the relief lack depth, mm, for a picture of this size, mm, and its irradiance on the
    screen, (n_x, n_y)."""
    lens, (low, high) = scene.lens, scene.lens.height_range
    text = (
        f"the picture takes a relief {high - low + lacking:.3g} mm deep, and ⟨lens.height_range⟩ leaves {high - low:.3g} mm: it is"
        " cut off at its limits, as the figures of the design will show"
    )
    if scene.joint or not MAGNIFICATION.supports(scene):
        return text
    size, depth = fitting(scene, field, heights, target)
    mag = picture[0] / lens.size[0] * size
    if depth > high - low:
        return f"{text}; the least is {depth:.3g} mm, at a ⟨+mag⟩ of {mag:.2g}, and a longer ⟨+throw⟩ lessens it in proportion"
    return f"{text}; it is deep enough for a ⟨+mag⟩ of about {(at_most if size < 1.0 else at_least)(mag, 2)}"


def fitting(scene: Scene, field: HeightField, heights: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """The size of the picture closest to its own, over that, whose relief fits between its limits, and its depth, mm; or those of
    the shallowest relief.  Arguments as of `words`."""
    low, high = scene.lens.height_range
    base = scene.lens.offset.heights(*(c.numpy() for c in field.control_xy()))
    known = {1.0: heights - base}

    def solve(size: float) -> bool:
        """Whether light reaches a picture of this size, whose relief is then known."""
        larger = replace(scene, screen=replace(scene.screen, size=tuple(size * w for w in scene.screen.size)))
        try:
            known[size] = first_surface(larger, target, field, CELLS, fixed=True).heights.numpy() - base
        except InputError:
            return False
        return True

    for ends in ENDS:
        any(map(solve, ends))
    while True:
        at = sorted(known)
        sizes = SIZES[(at[0] <= SIZES) & (at[-1] >= SIZES)]
        depths = np.array([np.ptp(_between(known, at, s)) for s in sizes])
        fits = np.flatnonzero(depths <= high - low)
        best = fits[np.abs(np.log(sizes[fits])).argmin()] if len(fits) else depths.argmin()
        size = float(sizes[best])
        if len(at) > SOLVED + len(ENDS) or min(max(size / s, s / size) for s in at) < CLOSE or not solve(size):
            return size, float(depths[best])


def _between(known: dict[float, np.ndarray], at: list[float], size: float) -> np.ndarray:
    """The relief of a size, mm, between those of the known ones, ascending, next to it."""
    k = min(max(1, int(np.searchsorted(at, size))), len(at) - 1)
    if len(at) == 1:
        return known[at[0]]
    part = (size - at[k - 1]) / (at[k] - at[k - 1])
    return (1.0 - part) * known[at[k - 1]] + part * known[at[k]]
