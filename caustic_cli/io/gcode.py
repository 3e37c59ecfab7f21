"""Reader of three-axis G-code programs (RS-274): linear moves, by tool.

Supported are G0 and G1 with X, Y, Z in absolute millimetres (G21) or inches (G20), with X, C, Z after a comment that names a tool
of a lathe, or with X, A, Z after one that names a rotary axis, one motion per block, without block delete; G17, G18, G90, G93, G94,
F, S, M and N words are ignored; comments are in parentheses or after a semicolon.  Arcs, relative moves, cycles, offsets and
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
from caustic_cli.io import columns
from caustic_cli.io.files import naming, open_regular

ACCEPTED = "a program of G0 and G1 moves is needed"
#: Largest program read, bytes: some 20 million moves.
MOST_BYTES = 1 << 29
#: Kind of the tool of a lathe.
LATHE = "round nose"
#: Words of units, and mm of each.
UNITS = {"G20": 25.4, "G21": 1.0}
#: G words without influence on the tool path, or with the assumed modes; and ignored letters.
IGNORED = {"G17", "G18", "G40", "G49", "G54", "G61", "G64", "G80", "G90", "G93", "G94", *"FSTMNH"}

_WORD = re.compile(r"([A-Z])\s*([+-]?(?:\d+\.?\d*|\.\d+))")
_COMMENT = re.compile(r"\([^()]*\)|;.*")
_TOOL = re.compile(r"\(tool: (ball nose|flat end|drill|round nose), radius ([0-9.eE+-]+) mm")
_STOCK = re.compile(r"\(stock: .*top at Z([0-9.eE+-]+)\)")
_ZERO = re.compile(r"\(Z0: ([0-9.eE+-]+) mm")
_ROTARY = re.compile(r"\(rotary: axis along ([xy] at z = [0-9.eE+-]+) mm")
_TURNED = re.compile(r"\(turned: (yes|no)")


@dataclass(frozen=True, eq=False)
class Cut:
    """Path of one tool: kind (ball nose, flat end, drill, round nose, "" if unknown), radius, mm or None; positions of the tip
    (k, 3) mm, of a tool of a lathe X, mm, C, radians, and Z, mm, beside a rotary axis X, A and Z; rapid (k,), whether each was
    reached by G0."""

    kind: str
    radius: float | None
    tips: np.ndarray
    rapid: np.ndarray


@dataclass(frozen=True, eq=False)
class Program:
    """cuts: paths by tool; top: height of the stock, mm, or None; zero: z of Z0 in the coordinates of the part, mm, or None;
    turned: whether the (x, y, z) of the scene is (x, -y, -z) of the part, or None; rotary: the axis of A, x or y, and its z, mm, or
    None."""

    cuts: tuple[Cut, ...]
    top: float | None
    zero: float | None
    turned: bool | None
    rotary: tuple[str, float] | None = None


class _Interpreter:
    """State of a machine that reads a program line by line."""

    def __init__(self) -> None:
        #: What the comments say, by pattern.
        self.comments: dict[re.Pattern, str] = {}
        #: Kind and radius of each tool, and its moves: x, y, z, whether rapid.
        self.tools: list[tuple[str, float | None]] = [("", None)]
        self.moves: list[list[tuple]] = [[]]
        #: G0 or G1, None before the first; the position, nan where unknown.
        self.motion: str | None = None
        self.position = [math.nan] * 3
        #: Letters of its coordinates.
        self.letters = "XYZ"
        #: mm of a coordinate's unit.
        self.unit = 1.0

    def read(self, line: str, number: int) -> None:
        """Read a line; InputError if it is not supported."""
        if "(" in line:
            self._comment(line, number)
        line = _COMMENT.sub("", line).upper().strip().strip("%")
        if not line:
            return
        if _WORD.sub("", line).strip():
            raise InputError(f"line {number}: {line!r} is no block of words; {ACCEPTED}")
        moved = False
        for letter, value in _WORD.findall(line):
            if letter in self.letters:
                unit = math.radians(1.0) if letter in "AC" else self.unit
                self.position[self.letters.index(letter)] = float(value) * unit
                moved = True
            else:
                self._mode(letter, value, number)
        if moved:
            if self.motion is None:
                raise InputError(f"line {number}: a place without G0 or G1; {ACCEPTED}")
            self.moves[-1].append((*self.position, self.motion == "G0"))

    def _comment(self, line: str, number: int) -> None:
        for pattern in (_STOCK, _ZERO, _TURNED, _ROTARY):
            if said := pattern.search(line):
                self.comments[pattern] = said[1]
        if tool := _TOOL.search(line):
            self.tools.append((tool[1], _real(tool[2], number)))
            self.moves.append([])
            self.letters = "XCZ" if tool[1] == LATHE else "XAZ" if _ROTARY in self.comments else "XYZ"
            self.position = [math.nan] * 3  # unknown after a tool change

    def _mode(self, letter: str, value: str, number: int) -> None:
        code = f"G{float(value):g}" if letter == "G" else letter
        if code in ("G0", "G1"):
            self.motion = code
        elif code in UNITS:
            self.unit = UNITS[code]
        elif code not in IGNORED:
            raise InputError(f"line {number}: {code} is not read; {ACCEPTED}")


def read_program(path: str | Path) -> Program:
    """Read a program.

    Raises:
        InputError: it is invalid or not supported, with the line.
    """
    machine = _Interpreter()
    with open_regular(path, ACCEPTED, MOST_BYTES) as file, naming(path):
        for number, line in enumerate(file, 1):
            machine.read(line.decode("latin-1"), number)
    cuts = []
    for (kind, radius), rows in zip(machine.tools, machine.moves, strict=True):
        table = np.array(rows, float).reshape(-1, 4)
        known = np.isfinite(table[:, :3]).all(1)  # positions with all coordinates known
        if known.any():
            cuts.append(Cut(kind, radius, table[known, :3], table[known, 3] > 0))
    if not cuts:
        raise InputError(f"{path}: moves no tool; {ACCEPTED}")
    said = machine.comments
    top, zero = (_real(said[key], 0) if key in said else None for key in (_STOCK, _ZERO))
    turns = said.get(_ROTARY, "").partition(" at z = ")
    rotary = (turns[0], _real(turns[2], 0)) if _ROTARY in said else None
    return Program(tuple(cuts), top, zero, said[_TURNED] == "yes" if _TURNED in said else None, rotary)


def _real(text: str, number: int) -> float:
    value = columns.number(text)
    if value is None or not math.isfinite(value):
        raise InputError(f"line {number}: {text!r} is no number; {ACCEPTED}")
    return value
