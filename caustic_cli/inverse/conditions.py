"""Values of the scene that a network of heights takes as inputs: a lens for each of them (thesis 2.5.2 and 7.2).

    throw                            distance of the screen from the lens' origin, mm (of a mirror, before it)
    source.x, source.y, source.z     place of a point source, or of the middle of a grid of points, mm

Each varies over a range.  These are the independent parameters of eq. 2.5.8, and the network is the map from them to the lens:

    heights(v) = network(c),    c = (2 v - low - high) / (high - low)    in [-1, 1] along each range

The picture keeps its size in mm whatever they are, and so does the offset surface, which is that of the middle of every range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config.table import check
from caustic_cli.errors import InputError
from caustic_cli.optics.sampling import stream
from caustic_cli.scene import Scene, Source

#: What may vary, and the setting whose range holds for it.
KEYS = {"throw": "screen.z", "source.x": "source.position", "source.y": "source.position", "source.z": "source.position"}
FORM = f"KEY=LOW:HIGH separated by commas, KEY one of {', '.join(KEYS)}, like throw=250:350"
#: Parts of a range at which its lenses are judged: its ends, its middle, and between.
JUDGED = (0.0, 0.25, 0.5, 0.75, 1.0)


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
    """What a network is trained over; rows of values (k, d) have one for each range, in their order.

    Raises:
        InputError: a key stands twice.
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
            InputError: it is none, a key is unknown, or a range is empty, reversed or beyond what the setting accepts.
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
        """In order."""
        return tuple(one.key for one in self.each)

    @property
    def middle(self) -> tuple[float, ...]:
        """Of every range, mm."""
        return tuple(one.middle for one in self.each)

    def words(self) -> str:
        """Keys and ranges in a clause."""
        return ", ".join(f"{one.key} {one.low:g} to {one.high:g} mm" for one in self.each)

    def values(self, text: str) -> tuple[float, ...]:
        """ "throw=300" as values; the middle of what it does not name.

        Raises:
            InputError: naming what is unknown, no number, or outside its range.
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
        width = np.where(high > low, high - low, 1.0)  # of a range of one value, whose input is 0
        return torch.from_numpy((2.0 * np.asarray(values, dtype=np.float64) - low - high) / width)

    def drawn(self, seed: int, iteration: int, count: int) -> np.ndarray:
        """Values (count, d) of one iteration: a Latin hypercube, one in each of `count` equal parts of every range."""
        rng = np.random.default_rng(stream(seed, f"values {iteration}"))
        parts = np.stack([(rng.permutation(count) + rng.random(count)) / count for _ in self.each], 1)
        return np.array([one.low for one in self.each]) + parts * np.array([one.high - one.low for one in self.each])

    def judged(self) -> list[tuple[float, ...]]:
        """Values at which a network is judged: along every range at the parts JUDGED, all others in their middle."""
        rows = [
            tuple(one.low + part * (one.high - one.low) if one is along else one.middle for one in self.each)
            for along in self.each
            for part in JUDGED
        ]
        return list(dict.fromkeys(rows))

    def scene(self, scene: Scene, values: Sequence[float]) -> Scene:
        """The scene at these values.

        Raises:
            InputError: nothing of it can have them, or it is none.
        """
        at = dict(zip(self.keys, values, strict=True))
        if "throw" in at:
            z = -at["throw"] if scene.lens.mirror else at["throw"]
            scene = replace(scene, screen=replace(scene.screen, z=z))
        if any(key.startswith("source.") for key in at):
            source = scene.source
            self.refuse(source)
            shift = [at.get(f"source.{axis}", c) - c for axis, c in zip("xyz", source.centre, strict=True)]

            def place(p: Sequence[float]) -> tuple[float, float, float]:
                return p[0] + shift[0], p[1] + shift[1], p[2] + shift[2]

            scene = replace(scene, source=source.displaced(place, 1.0))
        return scene

    def refuse(self, source: Source) -> None:
        """Refuse a source that has no one place, where its place varies.

        Raises:
            InputError: there is a range of its place.
        """
        key = next((key for key in self.keys if key.startswith("source.")), "")
        if key and (source.distant or source.apart or source.rays is not None or max(source.extent) > 0):
            raise InputError(f"⟨design.over⟩ {key} needs ⟨+source.type⟩ point, of one place, or grid, got {source.label}")

    def ends(self, scene: Scene) -> list[Scene]:
        """The scene at all combinations of ends of ranges.

        Raises:
            InputError: one of them is none.
        """
        corners = np.stack(np.meshgrid(*([one.low, one.high] for one in self.each), indexing="ij"), -1).reshape(-1, len(self.each))
        return [self.scene(scene, row.tolist()) for row in corners]


def _assignments(where: str, text: str, form: str, known: Sequence[str] = tuple(KEYS)) -> list[tuple[str, str]]:
    """KEY=TEXT separated by commas."""
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
    """A finite number that the key's setting accepts."""
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
