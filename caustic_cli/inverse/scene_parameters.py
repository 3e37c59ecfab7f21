"""Scene parameters over whose ranges a network is trained, which takes them as inputs (thesis 2.5.2 and 7.2).

    throw                            distance of the screen from the lens' origin along the axis, mm (of a mirror, before it); in
                                     tilted light the screen moves along it
    source.x, source.y, source.z     position of a point source, or of the centre of a grid of points, mm

Each varies over a range.  These are the independent parameters of eq. 2.5.8, and the network is the map from them to the lens:

    heights(v) = network(c),    c = (2 v - low - high) / (high - low)    in [-1, 1] along each range

Neither the size of the picture in mm nor the offset surface depends on them; both are those of the middle of every range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.sampling import stream
from caustic_cli.scene import Scene, Source
from caustic_cli.schema.table import check

#: Parameters that may vary, and the setting whose bounds apply.
KEYS = {"throw": "screen.z", "source.x": "source.position", "source.y": "source.position", "source.z": "source.position"}
FORM = f"KEY=LOW:HIGH separated by commas, KEY one of {', '.join(KEYS)}, like throw=250:350"
#: Fractions of a range at which a trained network is evaluated.
EVALUATED = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class Range:
    """key, of KEYS, from low to high, mm."""

    key: str
    low: float
    high: float

    @property
    def middle(self) -> float:
        """mm."""
        return 0.5 * (self.low + self.high)


@dataclass(frozen=True)
class Ranges:
    """The ranges a network is trained over; rows of values (k, d) have one column per range, in order.

    Raises:
        InputError: a key occurs twice.
    """

    each: tuple[Range, ...]

    def __post_init__(self):
        names = [one.key for one in self.each]
        if len(set(names)) < len(names):
            raise InputError(f"⟨design.over⟩ may name every key once, got {', '.join(names)}")

    @classmethod
    def parse(cls, text: str) -> Ranges | None:
        """ "throw=250:350, source.z=-80:-40" as ranges, None where the text is empty.

        Raises:
            InputError: the text cannot be parsed, a key is unknown, or a range is empty, reversed or beyond the bounds of its
                setting.
        """
        if not text.strip():
            return None
        found = []
        for key, part in _assignments("⟨design.over⟩", text, FORM):
            ends = part.split(":")
            if len(ends) != 2:
                raise InputError(f"⟨design.over⟩ must be {FORM}, got {key}={part}")
            low, high = (_number("⟨design.over⟩", key, end, FORM) for end in ends)
            if not low < high:
                raise InputError(f"⟨design.over⟩ {key}: the range must ascend, from LOW to a HIGH above it, got {part}")
            found.append(Range(key, low, high))
        return cls(tuple(found))

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of all ranges, in order."""
        return tuple(one.key for one in self.each)

    @property
    def middle(self) -> tuple[float, ...]:
        """Middle of every range, mm."""
        return tuple(one.middle for one in self.each)

    def words(self) -> str:
        """Keys and ranges as a phrase for messages."""
        return ", ".join(f"{one.key} {one.low:g} to {one.high:g} mm" for one in self.each)

    def values(self, text: str) -> tuple[float, ...]:
        """ "throw=300" as values, mm; the middle of each range that is not named.

        Raises:
            InputError: a key is unknown, or a value is not a number or outside its range.
        """
        form = f"KEY=VALUE separated by commas, of {self.words()}"
        said = dict(_assignments("⟨at⟩", text, form, self.keys))
        for one in self.each:
            if one.key in said:
                value = _number("⟨at⟩", one.key, said[one.key], form)
                if not one.low <= value <= one.high:
                    raise InputError(f"⟨at⟩ {one.key} must be {one.low:g} to {one.high:g} mm, as trained, got {value:g}")
        return tuple(float(said.get(one.key, one.middle)) for one in self.each)

    def scaled(self, values: Sequence[Sequence[float]] | np.ndarray) -> Tensor:
        """Rows of values (k, d), mm, as the network's inputs (k, d) in [-1, 1], float64."""
        low, high = (np.array([getattr(one, end) for one in self.each]) for end in ("low", "high"))
        width = np.where(high > low, high - low, 1.0)  # a range of a single value has the input 0
        return torch.from_numpy((2.0 * np.asarray(values, dtype=np.float64) - low - high) / width)

    def sampled(self, seed: int, iteration: int, count: int) -> np.ndarray:
        """Values (count, d) of one iteration, mm: a Latin hypercube sample of the ranges."""
        rng = np.random.default_rng(stream(seed, f"values {iteration}"))
        parts = np.stack([(rng.permutation(count) + rng.random(count)) / count for _ in self.each], 1)
        return np.array([one.low for one in self.each]) + parts * np.array([one.high - one.low for one in self.each])

    def evaluation_points(self) -> list[tuple[float, ...]]:
        """Values at which a network is evaluated: at the fractions EVALUATED of each range, all others at their middle."""
        rows = [
            tuple(one.low + part * (one.high - one.low) if one is along else one.middle for one in self.each)
            for along in self.each
            for part in EVALUATED
        ]
        return list(dict.fromkeys(rows))

    def scene(self, scene: Scene, values: Sequence[float]) -> Scene:
        """The scene at these values.

        Raises:
            InputError: the source has no single position, or the resulting scene is invalid.
        """
        at = dict(zip(self.keys, values, strict=True))
        if "throw" in at:
            z, screen, light = scene.lens.interaction.side * at["throw"], scene.screen, scene.undeviated
            x, y = (c + (z - screen.z) * d / light[2] for c, d in zip(screen.shift, light, strict=False))
            scene = replace(scene, screen=replace(screen, z=z, shift=(x, y)))
        if any(key.startswith("source.") for key in at):
            source = scene.source
            self.refuse(source)
            shift = [at.get(f"source.{axis}", c) - c for axis, c in zip("xyz", source.centre, strict=True)]

            def place(p: Sequence[float]) -> tuple[float, float, float]:
                return p[0] + shift[0], p[1] + shift[1], p[2] + shift[2]

            scene = replace(scene, source=source.displaced(place, 1.0))
        return scene

    def refuse(self, source: Source) -> None:
        """Refuse a source without a single position where its position varies.

        Raises:
            InputError: one of the ranges is of its position.
        """
        key = next((key for key in self.keys if key.startswith("source.")), "")
        if key and (source.distant or source.apart or source.rays is not None or max(source.extent) > 0):
            raise InputError(f"⟨design.over⟩ {key} needs ⟨+source.type⟩ point, of one place, or grid, got {source.label}")

    def ends(self, scene: Scene) -> list[Scene]:
        """The scenes at all combinations of the ends of the ranges.

        Raises:
            InputError: one of these scenes is invalid.
        """
        corners = np.stack(np.meshgrid(*([one.low, one.high] for one in self.each), indexing="ij"), -1).reshape(-1, len(self.each))
        return [self.scene(scene, row.tolist()) for row in corners]


def _assignments(where: str, text: str, form: str, known: Sequence[str] = tuple(KEYS)) -> list[tuple[str, str]]:
    """Parse KEY=TEXT pairs separated by commas."""
    found = []
    for part in text.split(","):
        key, equals, value = (word.strip() for word in part.partition("="))
        if not equals or not value:
            raise InputError(f"{where} must be {form}; got {part.strip()!r}")
        if key not in known:
            raise InputError(f"{where}: {key!r} is not a key; known are {', '.join(known)}")
        if key in dict(found):
            raise InputError(f"{where} may name every key once, got {key} twice")
        found.append((key, value))
    return found


def _number(where: str, key: str, text: str, form: str) -> float:
    """Parse a finite number within the bounds of the key's setting."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where} {key} must be finite numbers of mm, {form}; got {text!r}")
    try:
        check(KEYS[key], value if KEYS[key] == "screen.z" else [value] * 3)
    except InputError as error:
        raise InputError(f"{where} {key}: {error}") from error
    return value
