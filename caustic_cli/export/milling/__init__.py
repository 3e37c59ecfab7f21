"""Machining parameters of `export format gcode` for a mill or a lathe, in mm, mm/min and revolutions per minute.

The command line makes an option of each, so that this module must not import torch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

from caustic_cli.errors import InputError
from caustic_cli.schema import checks

#: Path of a lathe, of a mill with a rotary axis, and all.
TURNING, ROTARY = "turning", "rotary"
PATHS = ("raster", "raster-y", "spiral", ROTARY, TURNING)
#: Parameters of mills alone, and of lathes alone.
MILLED = ("feed", "spindle", "roughing", "roughing_tool", "roughing_radius", "allowance")
TURNED = ("clearance", "revolutions")
TOOLS = ("ball", "flat")
#: Words of a program: G0 for rapid moves and F where it changes, or G1 with F in every move; in mm or inches.
DIALECTS = ("mm", "inch", "simple", "simple-inch")
#: Largest concave curvature, over that of the tool, for which the step-over is reduced; beyond, material is left in any case.
FITS = 0.75
#: Default scallops, mm, by path.
SCALLOPS = {"raster": 1e-3, TURNING: 1e-4}
#: Default least stock above the highest point, mm.
FACING = 0.1


def _setting(default, help: str, unit: str = "", high: float = 1e6, choices: tuple[str, ...] = ()):
    """A parameter above 0 and up to `high`, or one of `choices`; default None if it follows from others."""
    return field(default=default, metadata={"help": help, "unit": unit, "high": high, "choices": choices})


@dataclass(frozen=True)
class Milling:
    """Machining parameters; see the help of each."""

    tool_radius: float = _setting(2.0, "Radius of the ball that finishes, or of the nose of a tool that turns.", "mm", 1e3)
    scallop: float | None = _setting(
        None,
        "Height of the scallops that finishing leaves, at most; sets the step-over.  [default: 0.001, of turning 0.0001]",
        "mm",
        10.0,
    )
    step_over: float | None = _setting(None, "Distance between passes instead.", "mm", 1e3)
    path: str = _setting(
        "raster",
        "raster (along x), raster-y, or spiral from the middle outwards; rotary: X, A, Z of a mill with a rotary axis, on the"
        " outside of a cylinder; turning: X, C, Z of a lathe with a tool servo.",
        choices=PATHS,
    )
    dialect: str = _setting(
        "mm", "Words of the program: mm; inch (G20); simple, simple-inch: G1 with a feed in every line, no G0.", choices=DIALECTS
    )
    feed: float = _setting(600.0, "Feed along the path.", "mm/min")
    plunge: float = _setting(200.0, "Feed straight down.", "mm/min")
    spindle: float = _setting(20000.0, "Spindle speed.", "1/min")
    safe_height: float = _setting(5.0, "Height above the stock of moves between cuts.", "mm", 1e4)
    pin: float = _setting(3.0, "Lens with two free-form sides: diameter of the dowel pins beside it.", "mm", 100.0)
    clearance: float = _setting(10.0, "turning: Clearance angle of the tool.", "deg", 89.0)
    revolutions: float = _setting(60.0, "turning: Speed of the part.", "1/min")
    stock: float | None = _setting(
        None,
        "Height of the stock above Z0, the flat face, or the axis of a cylinder.  [default: the highest point and 0.1 to 0.2 mm]",
        "mm",
        1e4,
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
        if self.highest >= self.tool_radius:
            raise InputError(f"⟨scallop⟩ must be lower than the tool's radius of {self.tool_radius:g} mm, got {self.highest:g} mm")
        if self.step_over is not None and self.step_over >= 2.0 * self.tool_radius:
            raise InputError(
                f"⟨step_over⟩ must be less than the tool's diameter of {2 * self.tool_radius:g} mm, got {self.step_over:g}"
            )

    @property
    def highest(self) -> float:
        """Scallops, mm, at most."""
        return self.scallop or SCALLOPS.get(self.path, SCALLOPS["raster"])

    def top(self, high: float) -> float:
        """Height of the stock, mm, for a surface up to `high` mm.

        Raises:
            InputError: it is lower.
        """
        top = math.ceil((high + FACING) * 10.0) / 10.0 if self.stock is None else self.stock
        if top < high:
            raise InputError(f"⟨stock⟩ must reach the surface's highest point, {high:.6g} mm above Z0, got {top:g} mm")
        return top

    def step(self, concave: float = 0.0, slope: float = 0.0) -> float:
        """Step-over, mm in the plane, for scallops of at most `scallop`: inverse of `scallop_of`.

        Args:
            concave: largest concave curvature of the surface, 1/mm, 0 for none; slope: largest slope.
        """
        if self.step_over is not None:
            return self.step_over
        h, r = self.highest, self.tool_radius
        return math.sqrt(4.0 * h * (2.0 * r - h) * self._room(concave) / (1.0 + slope * slope))

    def scallop_of(self, step: float, concave: float = 0.0, slope: float = 0.0) -> float:
        """Largest height of the scallops along the surface normal, mm, for a step-over `step`, mm in the plane.

        The centres of the tool are s apart, projected s times the cosine of the slope.  In a concave region of curvature k the
        contact points are s / (1 - R k) apart, and the spheres have the curvature 1 / R - k relative to the surface: h = s^2 / (8 R
        (1 - R k)) to first order, and s^2 = 4 h (2 R - h) exactly on a plane.  Curvatures above FITS / R count as FITS / R.
        """
        r, square = self.tool_radius, step * step * (1.0 + slope * slope) / self._room(concave)
        return square / (4.0 * (r + math.sqrt(max(0.0, r * r - 0.25 * square))))

    def _room(self, concave: float) -> float:
        """1 - R k, at least 1 - FITS."""
        return 1.0 - min(FITS, self.tool_radius * max(0.0, concave))

    @property
    def rough_radius(self) -> float:
        """Radius of the roughing tool, mm."""
        return self.tool_radius if self.roughing_radius is None else self.roughing_radius
