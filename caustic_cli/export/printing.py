"""How a part stands on a printer's plate: the steps of its surface by orientation, and which is least.

Notation
    t, p        height of a layer, and least step in its plane (a pixel; of a laser or a nozzle how finely its path is placed), mm
    s_x, s_y, s_z   steps along the part's axes: t along the one that stands upright, p along the others
    g_x, g_y    slopes of the surface

Of steps that are rounded to, the error is even over a step, of variance s^2 / 12; along x and y it moves the surface by the slope:

    sigma^2 = (s_z^2 + <g_x^2> s_x^2 + <g_y^2> s_y^2) / 12.

Upright surfaces of slope g have terraces t / g wide; on edge the lines of the layers are t apart, which a thin coat levels.  Face
down has the steps of face up, and supports on the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from caustic_cli.export import ORIENTATIONS
from caustic_cli.export.surface import sample_grid
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Lens

#: Part's axis that stands upright, by orientation, and how that is said.
UPRIGHT = dict(zip(ORIENTATIONS, (2, 0, 1), strict=True))
WORDS = dict(zip(ORIENTATIONS, ("face up", "on edge, x upright", "on edge, y upright"), strict=True))
#: t and p unless known, mm.
USUAL = (0.05, 0.05)
#: Points along an axis for slopes; steps that are less by this factor are worth to stand on edge, which needs supports.
SURVEY, WORTH = 301, 0.9


@dataclass(frozen=True)
class Orientation:
    """Advice: sigma, mm, by orientation, that which is least, and in words."""

    steps: dict[str, float]
    advised: str
    words: str

    @property
    def figures(self) -> dict:
        """For JSON."""
        return {"advised": self.advised, "steps_um": {name: 1e3 * s for name, s in self.steps.items()}, "advice": self.words}


def advised(lens: Lens, field: HeightField, heights: Tensor, printer: tuple[float, float] = USUAL) -> Orientation:
    """The orientation of least steps; printer: t and p, mm.  Of two free-form sides that with more steps counts."""
    sides = [(field, heights)]
    if lens.entrance is not None:
        entrance = entrance_of(lens)
        sides.append((entrance.field, entrance.heights))
    slopes = np.array([_slopes(*side) for side in sides])  # (sides, 2), mean squares along x and y
    layer, plane = printer
    steps = {}
    for name, upright in UPRIGHT.items():
        s = np.full(3, plane)
        s[upright] = layer
        steps[name] = float(np.sqrt((s[2] ** 2 + slopes @ s[:2] ** 2) / 12.0).max())
    edge = min("edge-x", "edge-y", key=steps.__getitem__)
    best = edge if steps[edge] < WORTH * steps["up"] else "up"
    apart = {"up": layer / max(math.sqrt(slopes.sum(1).max()), 1e-12), edge: layer}
    said = [f"{WORDS[name]} {1e3 * steps[name]:.2g} µm RMS, {apart[name]:.2g} mm apart" for name in apart]
    words = (
        f"print it {WORDS[best]}: steps of the surface {'; '.join(said)} (layers of {1e3 * layer:g} µm, {1e3 * plane:g} µm in their"
        " plane)"
    )
    return Orientation(steps, best, words)


def _slopes(field: HeightField, heights: Tensor) -> tuple[float, float]:
    """Mean squares of the slopes along x and y."""
    grid = sample_grid(field, heights.detach().double().cpu(), (SURVEY, SURVEY))
    return float(np.square(grid.zx).mean()), float(np.square(grid.zy).mean())


def placed(orientation: str, vertices: np.ndarray, face: int) -> np.ndarray:
    """Rotation and shift (4, 3) by which points (V, 3), mm, as rows with a 1 behind, stand on the plate; face: 1, or -1 where the
    surface looks to -z."""
    upright = UPRIGHT[orientation]
    turn = np.eye(3)[:, [(upright + 1) % 3, (upright + 2) % 3, upright]]  # a cyclic exchange of the axes
    if upright == 2:
        turn = turn @ np.diag([1.0, face, face])
    low, high = (f((vertices @ turn), 0) for f in (np.min, np.max))
    return np.vstack([turn, [-0.5 * (low[0] + high[0]), -0.5 * (low[1] + high[1]), -low[2]]]) + 0.0
