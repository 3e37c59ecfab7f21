"""Roughing: layers from the top of the stock down to an allowance above the surface, by a raster with a step-over of half the tool
radius, at a tolerance relative to the allowance.

In a layer the tool goes to the higher of the layer's floor and of its own cutter-location surface above the allowance (`offset`,
`radial`), so that it never comes closer, and what it leaves follows the surface, not the layers.  Coordinates are those of the
passes, (u, v), and the height Z of the tip, mm; a machine with other axes has them `placed`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np

from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.paths import batches, raster, with_heights
from caustic_cli.export.milling.writer import FIRST_MOVE, Writer, begin, descend
from caustic_cli.scene import Aperture

#: Step-over over the radius, tolerance over the allowance.
ROUGH_STEP, ROUGH_PART = 0.5, 0.05


def rough(
    out: Writer,
    m: Milling,
    height: Callable[[np.ndarray, np.ndarray], np.ndarray],
    outline: Aperture,
    top: float,
    low: float,
    placed: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> None:
    """Write the layers, and the change of the tool.

    Args:
        height: of the tip (N,) mm above the allowance, at u, v (N,) mm, NaN where the tool does not reach the surface; outline: of
        the passes; top, low: of the stock, and the least height of the surface, mm; placed: points (k, 3) of u, v and Z in the
        program's coordinates.
    """
    deep, move = top - low - m.allowance, FIRST_MOVE * m.rough_radius
    begin(out, m.roughing_tool, m.rough_radius, m.spindle, top + m.safe_height)
    layers = math.ceil(deep / m.roughing) if m.roughing is not None and deep > 0 else 0
    floors = np.linspace(top, top - deep, layers + 1)
    for above, floor in itertools.pairwise(floors):

        def no_lower(u: np.ndarray, v: np.ndarray, floor: float = floor) -> np.ndarray:
            return np.maximum(height(u, v), floor)

        for line in batches(raster(outline, ROUGH_STEP * m.rough_radius), move):
            points = with_heights(line, no_lower, move, ROUGH_PART * m.allowance)
            _cut_below(out, m, points, above, top, placed)
    out.say("M5", "M0 (change the tool)")


def _cut_below(
    out: Writer, m: Milling, points: np.ndarray, above: float, top: float, placed: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Cut where a pass (k, 3) is below a height, mm: elsewhere the material is removed already, or the surface reached."""
    kept = points[:, 2] < above
    for run in np.split(np.arange(len(points)), np.flatnonzero(np.diff(kept.astype(int))) + 1):
        if len(run) and kept[run[0]]:
            cut = placed(points[max(0, run[0] - 1) : run[-1] + 2])  # including a point above on either side
            descend(out, cut[0], top, m.plunge)
            out.cut(cut, m.feed)
            out.rapid(z=top + m.safe_height)
