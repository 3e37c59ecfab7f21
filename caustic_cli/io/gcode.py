"""Reader of three-axis G-code programs (RS-274): linear moves, by tool.

Supported are G0 and G1 with X, Y, Z in absolute millimetres, one motion per block, without block delete; G17, G21, G90, G94, F, S,
M and N words are ignored; comments are in parentheses or after a semicolon.  Arcs, inches, relative moves, cycles, offsets and
parameters are refused, since the simulated cut would be wrong.

Comments of exported programs give the tool, the stock, and the orientation of the part: see `export.milling.gcode`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.io.files import naming, open_regular

ACCEPTED = "a program of G0 and G1 moves in millimetres is needed"
#: Largest program read, bytes: some 20 million moves.
MOST_BYTES = 1 << 29
#: G words without influence on the tool path, or with the assumed modes; ignored letters.
PLAIN = {"G17", "G21", "G40", "G49", "G54", "G61", "G64", "G80", "G90", "G94"}
PASSED_OVER = set("FSTMNH")

_WORD = re.compile(r"([A-Z])\s*([+-]?(?:\d+\.?\d*|\.\d+))")
_COMMENT = re.compile(r"\([^()]*\)|;.*")
_TOOL = re.compile(r"\(tool: (ball nose|flat end), radius ([0-9.eE+-]+) mm\)")
_STOCK = re.compile(r"\(stock: .*top at Z([0-9.eE+-]+)\)")
_ZERO = re.compile(r"\(Z0: ([0-9.eE+-]+) mm")
_TURNED = re.compile(r"\(turned: (yes|no)")


@dataclass(frozen=True, eq=False)
class Cut:
    """Path of one tool: kind (ball nose, flat end, "" if unknown), radius, mm or None; successive positions of the tip (k, 3) mm;
    rapid (k,), whether each was reached by G0."""

    kind: str
    radius: float | None
    tips: np.ndarray
    rapid: np.ndarray


@dataclass(frozen=True, eq=False)
class Program:
    """cuts: paths by tool; top: height of the stock, mm, or None; zero: z of Z0 in the coordinates of the part, mm, or None;
    turned: whether the (x, y, z) of the scene is (x, -y, -z) of the part, or None."""

    cuts: tuple[Cut, ...]
    top: float | None
    zero: float | None
    turned: bool | None


def read_program(path: str | Path) -> Program:
    """Read a program.

    Raises:
        InputError: it is invalid or not supported, with the line.
    """
    with open_regular(path, ACCEPTED, MOST_BYTES) as file, naming(path):
        comments: dict[re.Pattern, str] = {}
        tools: list[tuple[str, float | None]] = [("", None)]
        moves: list[list[tuple]] = [[]]
        motion, place = None, [math.nan] * 3
        for number, raw in enumerate(file, 1):
            line = raw.decode("latin-1")
            if "(" in line:
                for pattern in (_STOCK, _ZERO, _TURNED):
                    if found := pattern.search(line):
                        comments[pattern] = found[1]
                if found := _TOOL.search(line):
                    tools.append((found[1], _real(found[2], number)))
                    moves.append([])
                    place = [math.nan] * 3  # the position is unknown after a tool change
            line = _COMMENT.sub("", line).upper().strip().strip("%")
            if not line:
                continue
            words = _WORD.findall(line)
            if _WORD.sub("", line).strip():
                raise InputError(f"line {number}: {line!r} is no block of words; {ACCEPTED}")
            moved = False
            for letter, value in words:
                if letter in "XYZ":
                    place["XYZ".index(letter)] = float(value)
                    moved = True
                elif letter == "G":
                    code = f"G{float(value):g}"
                    if code in ("G0", "G1"):
                        motion = code
                    elif code not in PLAIN:
                        raise InputError(f"line {number}: {code} is not read; {ACCEPTED}")
                elif letter not in PASSED_OVER:
                    raise InputError(f"line {number}: {letter} is not read; {ACCEPTED}")
            if moved:
                if motion is None:
                    raise InputError(f"line {number}: a place without G0 or G1; {ACCEPTED}")
                moves[-1].append((*place, motion == "G0"))
    cuts = []
    for (kind, radius), rows in zip(tools, moves, strict=True):
        table = np.array(rows, float).reshape(-1, 4)
        known = np.isfinite(table[:, :3]).all(1)  # positions with all coordinates known
        if known.any():
            cuts.append(Cut(kind, radius, table[known, :3], table[known, 3] > 0))
    if not cuts:
        raise InputError(f"{path}: moves no tool; {ACCEPTED}")
    real = {key: _real(comments[key], 0) if key in comments else None for key in (_STOCK, _ZERO)}
    return Program(tuple(cuts), real[_STOCK], real[_ZERO], comments[_TURNED] == "yes" if _TURNED in comments else None)


def _real(text: str, number: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"line {number}: {text!r} is no number; {ACCEPTED}")
    return value
