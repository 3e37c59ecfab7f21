"""Moves of a mill as lines of a program, with their count, length and time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from dataclasses import field as made
from typing import Any

import numpy as np

#: Tolerance of the path over the scallop height; digits of a coordinate beyond those of the tolerance; least number of digits.
PATH_PART, MORE_DIGITS, LEAST_DIGITS = 0.01, 1, 4
#: Largest overrun of the passes beyond the aperture, over the tool radius.
MOST_OVER = 0.7
#: Length of the initial moves of a path over the radius, at most a knot span.
FIRST_MOVE = 0.125
#: Rapid feed for the estimated time, mm/min: mills have 3 to 30 m/min.
RAPID = 3000.0
#: Reserved length of the comment with the number of lines and the time, which is written last.
COUNTED = 100


@dataclass
class Writer:
    """Writes moves and accumulates lines, length and time.

    digits: of coordinates, in the unit of the program, of `unit` mm; simple: rapid moves are linear ones, and all have their feed;
    letters: of the coordinates.
    """

    file: Any
    digits: int
    unit: float = 1.0
    simple: bool = False
    lines: int = 0
    minutes: float = 0.0
    length: float = 0.0
    at: tuple[float, float, float] | None = None
    feed: float = 0.0
    forms: list[str] = made(default_factory=list)
    letters: str = "XYZ"
    place: int = 0

    def __post_init__(self):
        words = [f"{letter}%.{self.digits}f" for letter in self.letters]
        self.forms = [" ".join(w for k, w in enumerate(words) if mask >> k & 1) for mask in range(8)]

    def say(self, *lines: str) -> None:
        self.file.write("".join(f"{line}\n" for line in lines).encode("ascii"))
        self.lines += len(lines)

    def start(self, *head: str) -> None:
        """The comments at the head, room for `end`, and the modes."""
        self.say(*head)
        self.place = self.file.tell()
        self.say(" " * COUNTED, f"{'G21' if self.unit == 1.0 else 'G20'} G90 G17 G94")

    def end(self, safe: float) -> None:
        """Up to a height, the end of the program, and at its head what it takes."""
        self.rapid(z=safe)
        self.say("M5", "M30")
        self.file.seek(self.place)
        words = f"({self.lines} lines, {self.length:.0f} mm of cut, about {self.minutes:.1f} minutes)"
        self.file.write(words.ljust(COUNTED).encode())

    def rapid(self, x: float | None = None, y: float | None = None, z: float | None = None) -> None:
        """Rapid move (G0) in x and y, or in z."""
        word, feed = ("G1", f" F{RAPID / self.unit:.6g}") if self.simple else ("G0", "")
        to_there = self.forms[3] % (x / self.unit, y / self.unit) if x is not None else self.forms[4] % (z / self.unit)
        self.say(f"{word} {to_there}{feed}")
        before = self.at or (x or 0.0, y or 0.0, z or 0.0)
        to = (before[0] if x is None else x, before[1] if y is None else y, before[2] if z is None else z)
        self.minutes += math.dist(before, to) / RAPID
        self.at = to

    def cut(self, points: np.ndarray, feed: float) -> None:
        """Linear moves (G1) through points (m, 3), mm; unchanged coordinates are omitted."""
        points = np.round(points / self.unit, self.digits) + 0.0
        before = np.concatenate([[np.asarray(self.at) / self.unit], points[:-1]])
        changed = points != before
        moved = changed.any(1)
        points, before, changed = points[moved], before[moved], changed[moved]
        if not len(points):
            return
        masks = (changed @ [1, 2, 4]).tolist()
        words = f" F{feed / self.unit:.6g}"
        rows = [
            "G1 " + self.forms[mask] % tuple(v for v, c in zip(row, kept, strict=True) if c)
            for mask, row, kept in zip(masks, points.tolist(), changed.tolist(), strict=True)
        ]
        if self.simple:
            rows = [row + words for row in rows]
        elif feed != self.feed:
            rows[0] += words
        self.feed = feed
        self.file.write(("\n".join(rows) + "\n").encode("ascii"))
        long = float(np.linalg.norm(points - before, axis=1).sum()) * self.unit
        self.lines, self.length, self.minutes = self.lines + len(rows), self.length + long, self.minutes + long / feed
        self.at = tuple((points[-1] * self.unit).tolist())


def digits_of(tolerance: float) -> int:
    """Digits of coordinates for moves within a tolerance, both in the unit of the program."""
    return max(LEAST_DIGITS, math.ceil(-math.log10(tolerance)) + MORE_DIGITS)


def figures_of(out: Any, minutes: float, radius: float, step: float, scallop: float, tolerance: float, stock: float) -> dict:
    """Figures of a finished program, as of `gcode.write_gcode`; out: its writer; lengths in mm."""
    return {
        "lines": out.lines,
        "minutes": minutes,
        "length_mm": out.length,
        "tool_radius_mm": radius,
        "step_over_mm": step,
        "scallop_mm": scallop,
        "scallop_slope": 0.5 * step / radius,
        "tolerance_mm": tolerance,
        "stock_mm": stock,
    }


def begin(out: Writer, tool: str, radius: float, spindle: float, safe: float) -> None:
    name = {"ball": "ball nose", "flat": "flat end"}.get(tool, tool)
    out.say(f"(tool: {name}, radius {radius:.17g} mm)", f"M3 S{spindle:g}")
    out.rapid(z=safe)
    out.feed = 0.0


def descend(out: Writer, to: np.ndarray, top: float, plunge: float) -> None:
    """Approach a point: rapid above it, rapid down to the stock, plunge."""
    out.rapid(x=float(to[0]), y=float(to[1]))
    if to[2] < top < out.at[2]:
        out.rapid(z=top)
    out.cut(to[None], plunge)
