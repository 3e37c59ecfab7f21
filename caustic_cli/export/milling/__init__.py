"""What a three-axis mill is told: the settings of `export format gcode`, in mm, mm/min and revolutions per minute.

Loaded by the command line, which makes an option of each: no torch here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

from caustic_cli.config import checks
from caustic_cli.errors import InputError

PATHS = ("raster", "raster-y", "spiral")
TOOLS = ("ball", "flat")
#: Part of the tool's curvature up to which hollows are followed by finer passes; beyond, material is left in any case.
FITS = 0.75


def _setting(default, help: str, unit: str = "", high: float = 1e6, choices: tuple[str, ...] = ()):
    """A setting above 0 and up to `high`, or one of `choices`; None for what follows from others."""
    return field(default=default, metadata={"help": help, "unit": unit, "high": high, "choices": choices})


@dataclass(frozen=True)
class Milling:
    """How a surface is milled; see the help of each."""

    tool_radius: float = _setting(2.0, "Radius of the ball-nose tool that finishes.", "mm", 1e3)
    scallop: float = _setting(0.001, "Height of the scallops that finishing leaves, at most; sets the step-over.", "mm", 10.0)
    step_over: float | None = _setting(None, "Distance between passes instead.", "mm", 1e3)
    path: str = _setting("raster", "raster (along x), raster-y, or spiral from the middle outwards.", choices=PATHS)
    feed: float = _setting(600.0, "Feed along the path.", "mm/min")
    plunge: float = _setting(200.0, "Feed straight down.", "mm/min")
    spindle: float = _setting(20000.0, "Spindle speed.", "1/min")
    safe_height: float = _setting(5.0, "Height above the stock of moves between cuts.", "mm", 1e4)
    stock: float | None = _setting(
        None, "Height of the stock above Z0, the flat face.  [default: the highest point and 0.1 to 0.2 mm]", "mm", 1e4
    )
    roughing: float | None = _setting(None, "Rough first, in layers of at most this depth.  [default: no roughing]", "mm", 1e3)
    roughing_tool: str = _setting("flat", "Tool that roughs: ball or flat.", choices=TOOLS)
    roughing_radius: float | None = _setting(
        None, "Radius of the tool that roughs.  [default: that of the ball that finishes]", "mm", 1e3
    )
    allowance: float = _setting(0.1, "What roughing leaves above the surface.", "mm", 100.0)

    def __post_init__(self):
        for row in fields(self):
            value, known = getattr(self, row.name), row.metadata
            if known["choices"]:
                checks.choice(f"⟨{row.name}⟩", value, known["choices"])
            elif value is not None:
                checks.number(f"⟨{row.name}⟩", value, 0.0, known["high"], open_low=True)
        if self.scallop >= self.tool_radius:
            raise InputError(f"⟨scallop⟩ must be lower than the tool's radius of {self.tool_radius:g} mm, got {self.scallop:g} mm")
        if self.step_over is not None and self.step_over >= 2.0 * self.tool_radius:
            raise InputError(
                f"⟨step_over⟩ must be less than the tool's diameter of {2 * self.tool_radius:g} mm, got {self.step_over:g}"
            )

    def step(self, concave: float = 0.0, slope: float = 0.0) -> float:
        """Distance of passes, mm in the plane, that leaves scallops of at most `scallop`: see `scallop_of`.

        Args:
            concave: largest concave curvature of the surface, 1/mm, 0 where it has none; slope: largest.
        """
        if self.step_over is not None:
            return self.step_over
        h, r = self.scallop, self.tool_radius
        return math.sqrt(4.0 * h * (2.0 * r - h) * self._room(concave) / (1.0 + slope * slope))

    def scallop_of(self, step: float, concave: float = 0.0, slope: float = 0.0) -> float:
        """Largest height, mm, of the scallops that passes `step` mm apart leave, along the surface's normal.

        The tool's middles are s apart, seen from above s times the cosine of the slope.  In a hollow of curvature k they touch the
        surface s / (1 - R k) apart, and their spheres rise by the curvature 1 / R - k above it: h = s^2 / (8 R (1 - R k)) to first
        order, and s^2 = 4 h (2 R - h) exactly on a flat surface.  Hollows into which the ball hardly fits count as curved by FITS /
        R.
        """
        r, square = self.tool_radius, step * step * (1.0 + slope * slope) / self._room(concave)
        return square / (4.0 * (r + math.sqrt(max(0.0, r * r - 0.25 * square))))

    def _room(self, concave: float) -> float:
        """1 - R k."""
        return 1.0 - min(FITS, self.tool_radius * max(0.0, concave))

    @property
    def rough_radius(self) -> float:
        """Of the tool that roughs, mm."""
        return self.tool_radius if self.roughing_radius is None else self.roughing_radius
