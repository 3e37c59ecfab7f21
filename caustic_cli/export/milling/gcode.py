"""A program for a three-axis mill: G-code of the common kind (RS-274: G0, G1, G17, G21, G90, G94, M0, M3, M5, M30).

X0 Y0 is the middle of the part, on its axis; Z0 is its flat face, which lies on the table; Z goes up.  X, Y, Z are those of the
tool's tip.  A mirror, or the mould of a lens, lies on its back: the scene's (x, y, z) is (x, -y, -z) of the program, more the
height of Z0, which a comment says.

Finishing follows the offset surface (`offset`), so that the ball cuts nowhere into the part, in straight moves whose tips are off
by at most a tolerance: a hundredth of the scallops unless said.  With curvature k along the path a move's middle is then off by t =
k l^2 / 8 and its ends tilt by sqrt(2 t k), where scallops tilt by sqrt(2 h / R): a tenth of that where k = 1 / R, and less where
the surface bends less.  Numbers have so many digits that rounding stays below a tenth of the tolerance.

Roughing goes down in layers over a raster, at the tolerance of the allowance, and where a layer's floor is below the surface's
offset stays above that.  It is written with half the tool's radius between passes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from dataclasses import field as made
from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.config import checks
from caustic_cli.config.checks import LENGTH
from caustic_cli.errors import InputError
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.offset import BallOffset, FlatOffset, shape_of
from caustic_cli.export.milling.paths import heightened, raster, spacing, spiral
from caustic_cli.export.part import Part
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import atomic_path
from caustic_cli.optics.surfaces.heightfield import HeightField

#: Tolerance of the path in parts of the scallops' height; digits of a number beyond those of the tolerance; and at least.
PATH_PART, MORE_DIGITS, LEAST_DIGITS = 0.01, 1, 4
#: Passes go beyond the aperture by at most this part of the tool's radius.
MOST_OVER = 0.7
#: First moves of a path, in parts of the radius, and at most a knot span; first moves worked on at a time, which bounds the memory.
FIRST_MOVE, AT_A_TIME = 0.125, 4096
#: What stock has above the highest point, at least, unless said, mm.
FACING = 0.1
#: Roughing: distance of passes in parts of the radius, tolerance in parts of the allowance.
ROUGH_STEP, ROUGH_PART = 0.5, 0.05
#: Rapid moves, mm/min, for the time said: mills have 3 to 30 m/min.
RAPID = 3000.0
#: Letters of the line that says lines and time, which is written last.
COUNTED = 100


@dataclass
class _Writer:
    """Writes moves and adds up what they are."""

    file: object
    digits: int
    lines: int = 0
    minutes: float = 0.0
    length: float = 0.0
    at: tuple[float, float, float] | None = None
    feed: float = 0.0
    forms: list[str] = made(default_factory=list)

    def __post_init__(self):
        words = [f"{letter}%.{self.digits}f" for letter in "XYZ"]
        self.forms = [" ".join(w for k, w in enumerate(words) if mask >> k & 1) for mask in range(8)]

    def say(self, *lines: str) -> None:
        self.file.write("".join(f"{line}\n" for line in lines).encode("ascii"))
        self.lines += len(lines)

    def rapid(self, x: float | None = None, y: float | None = None, z: float | None = None) -> None:
        """G0 to what is given of a place."""
        if x is not None:
            self.say(f"G0 {self.forms[3] % (x, y)}")
        else:
            self.say(f"G0 {self.forms[4] % z}")
        before = self.at or (x or 0.0, y or 0.0, z or 0.0)
        to = (before[0] if x is None else x, before[1] if y is None else y, before[2] if z is None else z)
        self.minutes += math.dist(before, to) / RAPID
        self.at = to

    def cut(self, points: np.ndarray, feed: float) -> None:
        """G1 through points (m, 3); coordinates that stay are not said again."""
        points = np.round(points, self.digits) + 0.0
        before = np.concatenate([[self.at], points[:-1]])
        changed = points != before
        moved = changed.any(1)
        points, before, changed = points[moved], before[moved], changed[moved]
        if not len(points):
            return
        masks = (changed @ [1, 2, 4]).tolist()
        rows = [
            "G1 " + self.forms[mask] % tuple(v for v, c in zip(row, kept, strict=True) if c)
            for mask, row, kept in zip(masks, points.tolist(), changed.tolist(), strict=True)
        ]
        if feed != self.feed:
            rows[0] += f" F{feed:g}"
            self.feed = feed
        self.file.write(("\n".join(rows) + "\n").encode("ascii"))
        long = float(np.linalg.norm(points - before, axis=1).sum())
        self.lines, self.length, self.minutes = self.lines + len(rows), self.length + long, self.minutes + long / feed
        self.at = tuple(points[-1].tolist())


def write_gcode(path: str | Path, part: Part, milling: Milling | None = None, tolerance: float | None = None) -> dict:
    """Write the program whole or not at all.

    Args:
        milling: tools, speeds and the path; tolerance: of straight moves, mm.

    Returns:
        what was written: lines, minutes, length_mm, step_over_mm, scallop_mm, scallop_slope, tolerance_mm, tool_radius_mm,
        stock_mm.

    Raises:
        InputError: stock below the surface, a tool that would cut into the table, or a file that cannot be written there.
    """
    if tolerance is not None:
        checks.number("⟨tolerance⟩", tolerance, 0.0, LENGTH, open_low=True)
    m, lens, base = milling or Milling(), part.lens, part.lens.z_in
    field, heights = part.field, part.heights - base  # from here on Z0 is the flat face
    low, high, slope, concave = shape_of(field, heights)
    step = m.step(concave, slope)
    over = min(MOST_OVER * m.tool_radius, m.tool_radius * slope / math.sqrt(1.0 + slope * slope) + step)
    step = spacing(m.path, lens.half_size, over, step, lens.round)
    scallop = m.scallop_of(step, concave, slope)
    tolerance = PATH_PART * scallop if tolerance is None else tolerance
    digits = max(LEAST_DIGITS, math.ceil(-math.log10(tolerance)) + MORE_DIGITS)
    top = math.ceil((high + FACING) * 10.0) / 10.0 if m.stock is None else m.stock
    if top < high:
        raise InputError(f"⟨stock⟩ must reach the surface's highest point, {high:.6g} mm above Z0, got {top:g} mm")
    dips = low - m.tool_radius + math.sqrt(m.tool_radius**2 - min(2.0 * over * over, 0.99 * m.tool_radius**2))
    if dips < 0.0:
        raise InputError(
            f"the tool would go {-dips:.3g} mm below the flat face at the edges: a thicker part (⟨lens.min_thickness⟩, ⟨block⟩), a"
            " larger tool or finer scallops keep it above"
        )
    safe, lines = top + m.safe_height, {"raster": 0, "raster-y": 1}
    shape = (lens.half_size, over, step, lens.round)
    passes = spiral(*shape) if m.path == "spiral" else raster(*shape, lines[m.path])
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        out = _Writer(file, digits)
        out.say(*_head(part, m, step, scallop, top, digits, tolerance))
        place = file.tell()
        out.say(" " * COUNTED, "G21 G90 G17 G94")
        if m.roughing is not None:
            _begin(out, m.roughing_tool, m.rough_radius, m.spindle, safe)
            _rough(out, m, field, heights, lens, top, low, safe)
            out.say("M5", "M0 (change the tool)")
        _begin(out, "ball", m.tool_radius, m.spindle, safe)
        offset, first = BallOffset(field, heights, m.tool_radius), True
        move = min(
            FIRST_MOVE * m.tool_radius, *(2.0 * r / (len(s.breaks) - 1) for s, r in zip(field.spaces, field.half_size, strict=True))
        )
        for line in _batches(passes, move):
            points = heightened(line, offset, move, tolerance)
            if first:
                _descend(out, points[0], top, m.plunge)
                first = False
            out.cut(points, m.feed)
        out.rapid(z=safe)
        out.say("M5", "M30")
        file.seek(place)
        file.write(f"({out.lines} lines, {out.length:.0f} mm of cut, about {out.minutes:.1f} minutes)".ljust(COUNTED).encode())
    return {
        "lines": out.lines,
        "minutes": out.minutes,
        "length_mm": out.length,
        "tool_radius_mm": m.tool_radius,
        "step_over_mm": step,
        "scallop_mm": scallop,
        "scallop_slope": 0.5 * step / m.tool_radius,
        "tolerance_mm": tolerance,
        "stock_mm": top,
    }


def _head(part: Part, m: Milling, step: float, scallop: float, top: float, digits: int, tolerance: float) -> list[str]:
    """Comments: what is made, with what, and where zero is.  `io.gcode` reads those with a colon."""
    wide, high = part.lens.size
    turned = "yes, the scene's x, y, z is x, -y, -z here" if part.turned else "no"
    return [
        f"({CREATED})",
        f"(part: {part.kind})",
        f"(turned: {turned})",
        f"(Z0: {part.lens.z_in:.17g} mm is its z in the other formats; the flat face, on the table)",
        "(X0 Y0: the middle of the part; X Y Z are of the tool's tip)",
        f"(stock: {wide:g} x {high:g} x {top:g} mm, top at Z{top:g})",
        f"(finishing: {m.path}, step-over {step:.6g} mm, scallops up to {scallop:.3g} mm, moves within {tolerance:.3g} mm)",
        f"(units: mm, mm/min; {digits} decimals)",
    ]


def _begin(out: _Writer, tool: str, radius: float, spindle: float, safe: float) -> None:
    name = "ball nose" if tool == "ball" else "flat end"
    out.say(f"(tool: {name}, radius {radius:.17g} mm)", f"M3 S{spindle:g}")
    out.rapid(z=safe)
    out.feed = 0.0


def _descend(out: _Writer, to: np.ndarray, top: float, plunge: float) -> None:
    """To a point: over it, down to the stock, and into it."""
    out.rapid(x=float(to[0]), y=float(to[1]))
    if to[2] < top < out.at[2]:
        out.rapid(z=top)
    out.cut(to[None], plunge)


def _batches(passes: Iterator[np.ndarray], move: float) -> Iterator[np.ndarray]:
    """Consecutive passes as one line each time they have AT_A_TIME first moves."""
    held, moves = [], 0.0
    for line in passes:
        held.append(line if not held else line[1:])
        moves += float(np.hypot(*np.diff(line, axis=0).T).sum()) / move
        if moves > AT_A_TIME:
            yield np.concatenate(held)
            held, moves = [line[-1:]], 0.0
    if sum(map(len, held)) > 1:
        yield np.concatenate(held)


def _rough(out: _Writer, m: Milling, field: HeightField, heights: Tensor, lens, top: float, low: float, safe: float) -> None:
    """Layers from the top of the stock down to the allowance above the surface."""
    make, radius = {"ball": BallOffset, "flat": FlatOffset}[m.roughing_tool], m.rough_radius
    offset = make(field, heights, radius, m.allowance)
    deep = top - low - m.allowance
    if deep <= 0:
        return
    layers = math.ceil(deep / m.roughing)
    for k in range(1, layers + 1):
        floor, above = top - deep * k / layers, top - deep * (k - 1) / layers

        def height(x: np.ndarray, y: np.ndarray, floor: float = floor) -> np.ndarray:
            return np.maximum(offset(x, y), floor)

        for line in raster(lens.half_size, 0.5 * radius, ROUGH_STEP * radius, lens.round):
            points = heightened(line, height, FIRST_MOVE * radius, ROUGH_PART * m.allowance)
            kept = points[:, 2] < above  # the rest is as low as it may be, or nothing is there any more
            for run in np.split(np.arange(len(points)), np.flatnonzero(np.diff(kept.astype(int))) + 1):
                if kept[run[0]]:
                    run = points[max(0, run[0] - 1) : run[-1] + 2]  # with a point above on either side
                    _descend(out, np.array([*run[0, :2], max(run[0, 2], floor)]), top, m.plunge)
                    out.cut(run, m.feed)
                    out.rapid(z=safe)
