"""G-code programs for a three-axis mill (RS-274: G0, G1, G17, G20 or G21, G90, G94, M0, M3, M5, M30).

X0 Y0 is the centre of the part, on its axis; Z0 is its flat face, on the table; Z points up.  X, Y, Z are coordinates of the tool
tip.  A mirror, or the mould of a lens, is turned over: the (x, y, z) of the scene is (x, -y, -z) of the program, plus the height of
Z0, which is given in a comment.

Finishing follows the offset surface (`offset`), so that the ball does not gouge the part, in linear moves within a tolerance, by
default a hundredth of the scallop height.  With curvature k along the path the midpoint of a move of length l deviates by t = k l^2
/ 8 and its ends by the slope sqrt(2 t k), compared with sqrt(2 h / R) of scallops: a tenth of that for k = 1 / R, and less for
smaller k.  Rounding of coordinates is below a tenth of the tolerance.

Roughing (`roughing`) removes the stock in layers above the offset surface.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.milling import ROTARY, TURNING, Milling
from caustic_cli.export.milling.offset import BallOffset, FlatOffset, shape_of
from caustic_cli.export.milling.paths import batches, raster, spacing, spiral, with_heights
from caustic_cli.export.milling.rotary import write_rotary
from caustic_cli.export.milling.roughing import rough
from caustic_cli.export.milling.turning import write_turning
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
from caustic_cli.export.part import Part, Register
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.schema import checks
from caustic_cli.schema.checks import LENGTH

#: Cutter-location surfaces of the tools that rough.
ROUGHING = {"ball": BallOffset, "flat": FlatOffset}
#: Depth of the holes for pins, in their diameters, and what is left below them at least, in parts of the stock.
HOLE, FLOOR = 3.0, 0.1
#: mm of an inch.
INCH = 25.4


def write_gcode(path: str | Path, part: Part, milling: Milling | None = None, tolerance: float | None = None) -> dict:
    """Write the program atomically.

    Args:
        milling: tools, speeds and path; tolerance: of linear moves, mm.

    Returns:
        figures: lines, minutes, length_mm, step_over_mm, scallop_mm, scallop_slope, tolerance_mm, tool_radius_mm,
        stock_mm.

    Raises:
        InputError: the stock is below the surface, the tool would cut into the table, or the file cannot be written.
    """
    if tolerance is not None:
        checks.number("⟨tolerance⟩", tolerance, 0.0, LENGTH, open_low=True)
    m, base = milling or Milling(), part.lens.z_in
    unit, simple = INCH if m.dialect.endswith("inch") else 1.0, m.dialect.startswith("simple")
    if m.path == TURNING:
        return write_turning(path, part, m, tolerance, unit, simple)
    if m.path == ROTARY:
        return write_rotary(path, part, m, tolerance, unit, simple)
    field, heights = part.field, part.heights - base  # from here on Z0 is the flat face
    low, high, slope, concave = shape_of(field, heights)
    step = m.step(concave, slope)
    over = min(MOST_OVER * m.tool_radius, m.tool_radius * slope / math.sqrt(1.0 + slope * slope) + step)
    outline = part.lens.opening.grown(over)
    step = spacing(m.path, outline, step)
    scallop = m.scallop_of(step, concave, slope)
    tolerance = PATH_PART * scallop if tolerance is None else tolerance
    digits = digits_of(tolerance / unit)
    top = m.top(high)
    _refuse_deep(part, low, m.tool_radius - math.sqrt(m.tool_radius**2 - min(2.0 * over * over, 0.99 * m.tool_radius**2)))
    safe, lines = top + m.safe_height, {"raster": 0, "raster-y": 1}
    passes = spiral(outline, step) if m.path == "spiral" else raster(outline, step, lines[m.path])
    with atomic_file(path) as file:
        out = Writer(file, digits, unit, simple)
        out.start(*_head(part, m, step, scallop, top, digits, tolerance))
        if part.register is not None and part.register.drills(part.turned):
            _drill(out, m, part.register, safe)
        if m.roughing is not None:
            offset = ROUGHING[m.roughing_tool](field, heights, m.rough_radius, m.allowance)
            rough(out, m, offset, part.lens.opening.grown(0.5 * m.rough_radius), top, low)
        begin(out, "ball", m.tool_radius, m.spindle, safe)
        _finish(out, m, field, heights, passes, top, tolerance)
        out.end(safe)
    return figures_of(out, out.minutes, m.tool_radius, step, scallop, tolerance, top)


def _refuse_deep(part: Part, low: float, deeper: float) -> None:
    """Refuse a part beside whose edges, at least `low` mm high, the tool goes deeper by so much, mm.

    Raises:
        InputError: it would cut into the table, or meet that of the other side.
    """
    if low < deeper:
        raise InputError(
            f"the tool would go {deeper - low:.3g} mm below the flat face at the edges: a thicker part (⟨lens.min_thickness⟩,"
            " ⟨block⟩), a larger tool or finer scallops keep it above"
        )
    if part.register is not None and part.register.rim < 2.0 * deeper:
        raise InputError(
            f"the tools of both sides would meet beside the lens, whose edge is {part.register.rim:.3g} mm thick: a thicker lens"
            " (⟨lens.thickness⟩), a larger tool or finer scallops keep it in its stock"
        )


def _head(part: Part, m: Milling, step: float, scallop: float, top: float, digits: int, tolerance: float) -> list[str]:
    """Header comments: part, tools and datum.  `io.gcode` reads those with a colon."""
    wide, high = part.lens.size if part.register is None else (part.register.wide, part.register.high)
    turned = "yes, the scene's x, y, z is x, -y, -z here" if part.turned else "no"
    return [
        f"({CREATED})",
        f"(part: {part.kind})",
        f"(turned: {turned})",
        f"(Z0: {part.lens.z_in:.17g} mm is its z in the other formats; {part.face}, on the table)",
        *([] if part.register is None else part.register.said(part.turned)),
        "(X0 Y0: the middle of the part; X Y Z are of the tool's tip)",
        f"(stock: {wide:g} x {high:g} x {top:g} mm, top at Z{top:g})",
        f"(finishing: {m.path}, step-over {step:.6g} mm, scallops up to {scallop:.3g} mm, moves within {tolerance:.3g} mm)",
        f"(units: {'inches, inches' if m.dialect.endswith('inch') else 'mm, mm'}/min; {digits} decimals; comments in mm)",
    ]


def _drill(out: Writer, m: Milling, register: Register, safe: float) -> None:
    """Write the holes for the dowel pins, from above, not through the stock."""
    begin(out, "drill", 0.5 * register.pin, m.spindle, safe)
    for x in register.pins:
        depth = min(HOLE * register.pin, (1.0 - FLOOR) * register.thickness)
        descend(out, np.array([x, 0.0, register.thickness - depth]), register.thickness, m.plunge)
        out.rapid(z=safe)
    out.say("M5", "M0 (change the tool)")


def _finish(
    out: Writer, m: Milling, field: HeightField, heights: Tensor, passes: Iterator[np.ndarray], top: float, tolerance: float
) -> None:
    """Write the finishing passes, from the top of the stock on."""
    offset, first = BallOffset(field, heights, m.tool_radius), True
    spans = (2.0 * r / (len(s.breaks) - 1) for s, r in zip(field.spaces, field.half_size, strict=True))
    move = min(FIRST_MOVE * m.tool_radius, *spans)
    for line in batches(passes, move):
        points = with_heights(line, offset, move, tolerance)
        if first:
            descend(out, points[0], top, m.plunge)
            first = False
        out.cut(points, m.feed)
