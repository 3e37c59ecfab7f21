"""Programs for a mill with a rotary axis: a relief on the outside of a cylinder, or a ring of them, by tools that point to the axis
of the part.

X0 is the middle of the part, X along the axis of the cylinder, A the angle about it, A0 at the vertex, and Z the distance of the
tool's tip from that axis, which is Z0; Y stays 0.  Directions are those of ISO 841, as if the tool moved around the part: at A it
is over Y = -Z sin A.  Passes run along X, in G94, and A turns between them alone.

Notation
    R_0, a, theta, rho    of the base cylinder, see `export.panels`;  s = R_0 theta;  R  radius of the tool

The tip follows the cutter-location surfaces of `radial`.  A linear move of A and Z is one of s and rho, in which moves are within a
tolerance.  Passes a distance s apart on the cylinder leave scallops as on a plane for s sqrt(1 + R / R_0), since both the ball and
the cylinder are convex.  Roughing (`roughing`) removes layers of constant radius first; its flat end leaves s^2 / (8 R_0) between
passes, and on the cylinder no more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.offset import shape_of
from caustic_cli.export.milling.paths import batches, raster, spacing, with_heights
from caustic_cli.export.milling.radial import RadialBall, RadialFlat
from caustic_cli.export.milling.roughing import ROUGH_PART, ROUGH_STEP, rough
from caustic_cli.export.milling.writer import (
    FIRST_MOVE,
    MOST_OVER,
    PATH_PART,
    Writer,
    begin,
    descend,
    digits_of,
    figures_of,
)
from caustic_cli.export.panels import Panels
from caustic_cli.export.part import Part
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import atomic_file
from caustic_cli.scene import Aperture

#: Cutter-location surfaces of the tools that rough.
ROUGHING = {"ball": RadialBall, "flat": RadialFlat}


@dataclass(frozen=True, eq=False)
class _Finishing:
    """Finishing of panels: step-over, scallops and tolerance, mm, and how far passes go beyond the panels, mm."""

    panels: Panels
    m: Milling
    step: float
    scallop: float
    tolerance: float
    over: float

    @classmethod
    def of(cls, panels: Panels, m: Milling, tolerance: float | None) -> _Finishing:
        concave, slope = max(shape_of(*side)[3] for side in panels.unlike), panels.slope
        wider = math.sqrt(1.0 + m.tool_radius / panels.cylinder.radius)
        step = m.step(concave, slope) / wider
        over = min(MOST_OVER * m.tool_radius, m.tool_radius * slope / math.sqrt(1.0 + slope * slope) + step)
        step = spacing("raster", _outline(panels, over, step), step)
        scallop = m.scallop_of(step * wider, concave, slope)
        return cls(panels, m, step, scallop, PATH_PART * scallop if tolerance is None else tolerance, over)

    @property
    def outline(self) -> Aperture:
        """Of its passes over a and s."""
        return _outline(self.panels, self.over, self.step)

    def write(self, out: Writer, top: float, unit: float) -> None:
        """Write the passes, from the top of the stock on."""
        m, first, offset = self.m, True, RadialBall(self.panels, self.m.tool_radius)
        spans = (2.0 * r / (len(s.breaks) - 1) for f, _ in self.panels.unlike for s, r in zip(f.spaces, f.half_size, strict=True))
        move = min(FIRST_MOVE * m.tool_radius, *spans)
        for line in batches(raster(self.outline, self.step), move):
            points = _program(self.panels, with_heights(line, offset, move, self.tolerance), unit)
            if first:
                descend(out, points[0], top, m.plunge)
            first = False
            out.cut(points, m.feed)


def _outline(panels: Panels, over: float, step: float) -> Aperture:
    """Of passes over a and s, that far beyond the panels; of a ring once around, at least as close as the step-over."""
    around = panels.cylinder.radius * panels.turn + over
    if panels.closed:
        whole = 2.0 * math.pi * panels.cylinder.radius
        around = 0.5 * whole * (1.0 - 1.0 / math.ceil(whole / step * (1.0 - 1e-9)))
    return Aperture((panels.half + over, around))


def _program(panels: Panels, points: np.ndarray, unit: float) -> np.ndarray:
    """X, mm, A, degrees, and Z, mm, of points (a, s, Z), (m, 3): X, Y, Z is right-handed with X = y, Y = -x, or with x, y; `Writer`
    divides by the program's unit, mm, which A does not have."""
    cylinder = panels.cylinder
    turn = np.degrees(points[:, 1] / cylinder.radius) * (unit if cylinder.bent == 0 else -unit)
    return np.stack([points[:, 0], turn, points[:, 2]], -1)


def write_rotary(path: str | Path, part: Part, m: Milling, tolerance: float | None, unit: float, simple: bool) -> dict:
    """Write the program atomically; figures as of `gcode.write_gcode`, and turned_deg, to either side.

    Args:
        tolerance: of moves, mm; unit: of the program, mm; simple: no G0.

    Raises:
        InputError: the part is not the outside of a cylinder, or the stock is below its surface.
    """
    panels = Panels.of(part, part.others, "⟨path⟩ rotary")
    finishing, top = _Finishing.of(panels, m, tolerance), m.top(panels.high)
    with atomic_file(path) as file:
        out = Writer(file, digits_of(finishing.tolerance / unit), unit, simple, letters="XAZ")
        out.start(*_head(part, finishing, top))
        if m.roughing is not None:
            _rough(out, finishing, top, unit)
        begin(out, "ball", m.tool_radius, m.spindle, top + m.safe_height)
        finishing.write(out, top, unit)
        out.end(top + m.safe_height)
    figures = figures_of(out, out.minutes, m.tool_radius, finishing.step, finishing.scallop, finishing.tolerance, top)
    turned = 180.0 if panels.closed else math.degrees(finishing.outline.half_size[1] / panels.cylinder.radius)
    return figures | {"turned_deg": turned}


def _rough(out: Writer, finishing: _Finishing, top: float, unit: float) -> None:
    """Write the roughing passes: as far beyond the panels as the ball of finishing cuts, and down to the allowance above the lowest
    point at most, whether or not the tool touches the surface there."""
    panels, m = finishing.panels, finishing.m
    allowance = m.allowance * (1.0 + ROUGH_PART)  # its moves are within a tolerance
    offset = ROUGHING[m.roughing_tool](panels, m.rough_radius, allowance)
    over = max(0.5 * m.rough_radius, finishing.over + m.tool_radius - m.rough_radius)

    def height(along: np.ndarray, s: np.ndarray) -> np.ndarray:
        return np.fmax(offset(along, s), panels.low + allowance)

    outline = _outline(panels, over, ROUGH_STEP * m.rough_radius)
    rough(out, m, height, outline, top, panels.low, lambda points: _program(panels, points, unit))


def _head(part: Part, finishing: _Finishing, top: float) -> list[str]:
    """Header comments."""
    panels, m = finishing.panels, finishing.m
    cylinder = panels.cylinder
    axis, across = ("y", "-x") if cylinder.bent == 0 else ("x", "y")
    ring = [f"(ring: {len(panels.sides)} panels of {2.0 * math.degrees(panels.sector):.6g} degrees)"] if panels.closed else []
    return [
        f"({CREATED})",
        f"(part: {part.kind}, on a cylinder of radius {cylinder.radius:g} mm, with a rotary axis A about X)",
        *ring,
        f"(X0: the middle of the part; X is its {axis}, Y0 its axis, Y would be {across})",
        f"(Z0: the axis of the cylinder and of A, {cylinder.axis:.17g} mm is its z in other formats; X Z are of the tool's tip)",
        "(A: degrees from the vertex, as if the tool moved around the part: it is over Y = -Z sin A)",
        f"(rotary: axis along {axis} at z = {cylinder.axis:.17g} mm)",
        f"(blank: a cylinder or tube, outer radius {f'{top:g} mm' if m.roughing else f'at least {top:g} mm, or as it is'})",
        f"(finishing: passes along X, step-over {finishing.step:.6g} mm on the cylinder, scallops up to {finishing.scallop:.3g} mm,"
        f" moves within {finishing.tolerance:.3g} mm)",
        f"(units: {'inches' if m.dialect.endswith('inch') else 'mm'} and degrees, F of moves along X and Z; comments in mm)",
    ]
