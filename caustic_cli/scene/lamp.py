"""A lamp: a lens around a light-emitting chip, and where its light is wanted.

The chip lies in the plane z = 0 with its centre at the origin, and emits into z > 0 by Lambert's law.  The lens lies between a
hemisphere about the origin, which does not deflect the light of the chip's centre, a plane, the roof of a cylindrical cavity, or a
second free-form surface, and a free-form surface; its base is the ring between the two in the plane z = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene import anglemap
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.rayset import RaySet

SHAPES = ("point", "disc", "rectangle", "rays")
#: Width of the classes of angles in which the intensity of a ray file is counted, degrees.
CLASS = 5.0
#: Points of a pixel along both axes at which its solid angle is taken, and pixels of that of a whole target.
WITHIN, WHOLE = 3, (300, 300)
#: Border of a target, a fraction of its smaller side, that is no part of its interior: least, and most where a chip blurs more.
BORDERS = (0.025, 0.1)
#: Most lamps of an array.
MOST_LAMPS = 400
#: Largest ratio of its sides, and least distance of a plane target in radii of the lens.
OBLONG, NEAREST = 100.0, 2.0


@dataclass(frozen=True)
class Chip:
    """An emitter, Lambertian unless its intensity is tabulated.

    Raises:
        InputError: an unknown shape, or a size that does not belong to it.
    """

    #: point, disc (an ellipse where width and height differ), rectangle, or rays of a ray file.
    shape: str = "point"
    #: Full width and height, mm; 0 for a point.
    size: tuple[float, float] = (0.0, 0.0)
    #: Of every point of it by the angle from +z; None for Lambert's law.
    intensity: Distribution | None = None
    #: Of a ray file, in the frame of the lamp.
    rays: RaySet | None = None
    #: Part of the light that comes back to it which it reflects, diffusely.
    reflectance: float = 0.0

    @classmethod
    def of_rays(cls, rays: RaySet) -> Chip:
        """The chip that a ray file was measured of: its size is that of the places where rays begin, its intensity that of all.

        Raises:
            InputError: there is no light within 90 degrees of +z.
        """
        width, height = (2.0 * float(c) for c in np.abs(rays.positions[:, :2]).max(0))
        edges = np.arange(0.0, 90.0 + CLASS, CLASS)
        angle = np.degrees(np.arccos(rays.directions[:, 2].clip(-1.0, 1.0)))
        seen = np.histogram(angle, edges, weights=rays.flux)[0] / -np.diff(np.cos(np.radians(edges)))
        middle = 0.5 * (edges[1:] + edges[:-1])
        values = np.concatenate([seen[:1], seen, seen[-1:]])
        return cls("rays", (width, height), Distribution((0.0, *middle.tolist(), 90.0), tuple(values.tolist())), rays)

    def __post_init__(self):
        if self.shape not in SHAPES or (self.shape == "rays") != (self.rays is not None):
            raise InputError(f"the shape of a chip must be one of {', '.join(SHAPES[:3])}, got {self.shape!r}")
        if not 0 <= self.reflectance <= 1:
            raise InputError(f"the reflectance of a chip must be 0 to 1, got {self.reflectance!r}")
        if self.rays is not None:
            return
        if not all(math.isfinite(s) and s >= 0 for s in self.size):
            raise InputError(f"the size of a chip must be finite and not negative, got {self.size}")
        if (self.shape == "point") != (self.size == (0.0, 0.0)) or (min(self.size) == 0 < max(self.size)):
            raise InputError(
                f"a {self.shape} has {'no size' if self.shape == 'point' else 'two sizes above 0 mm'}, got {self.size}"
            )

    @property
    def centre(self) -> Chip:
        """A point that emits as the chip does."""
        return Chip(intensity=self.intensity)

    @property
    def top(self) -> float:
        """Height of its uppermost point above the plane z = 0, mm."""
        return 0.0 if self.rays is None else max(0.0, float(self.rays.positions[:, 2].max()))

    @property
    def reach(self) -> float:
        """Largest distance of its points from the origin, mm."""
        if self.rays is not None:
            return float(np.linalg.norm(self.rays.positions, axis=1).max())
        return 0.5 * (math.hypot(*self.size) if self.shape == "rectangle" else max(self.size))


@dataclass(frozen=True)
class Goal:
    """Where the light is wanted: a rectangle of a plane z = distance, or of angles in the far field, centred on the axis there.

    In the far field x and y are those of a map of the directions, see `anglemap`.

    Raises:
        InputError: out of range.
    """

    #: Full width and height, mm on the plane or degrees of the map in the far field.
    size: tuple[float, float]
    #: Of the plane, mm; inf for the far field.
    distance: float = math.inf
    #: Of its centre on the plane, from the axis, mm; 0 in the far field.
    shift: tuple[float, float] = (0.0, 0.0)
    #: Of the directions in the far field, one of `anglemap.MAPS`.
    projection: str = "latitude"

    def __post_init__(self):
        if not all(0 < s < math.inf for s in self.size):
            raise InputError(f"width and height of a target must be greater than 0, got {self.size}")
        if max(self.size) > OBLONG * min(self.size):
            raise InputError(
                f"a target of a lamp is at most {OBLONG:g} times as long as wide, got {self.size[0]:g} x {self.size[1]:g}"
            )
        if not self.distance > 0:
            raise InputError(f"the distance of a target must be greater than 0 mm, or inf, got {self.distance}")
        if not all(math.isfinite(s) for s in self.shift):
            raise InputError(f"the shift of a target must be finite, got {self.shift}")
        if self.far and self.shift != (0.0, 0.0):
            raise InputError(f"a target in the far field is centred on the axis, got a shift of {self.shift}")
        if self.projection not in anglemap.MAPS or (self.projection != "latitude" and not self.far):
            raise InputError(
                f"the projection of a target in the far field is one of {', '.join(anglemap.MAPS)}, and of a plane there is none"
            )
        if self.far and not max(self.angles) <= (widest := anglemap.widest_of(self.projection)) + 1e-9:
            raise InputError(
                f"a target in the far field is at most {widest:g} degrees wide and high, got {self.angles[0]:g} x"
                f" {self.angles[1]:g}"
            )

    @property
    def far(self) -> bool:
        """Whether it is in the far field."""
        return math.isinf(self.distance)

    @property
    def by_latitude(self) -> bool:
        """Whether it is in the far field, and along y is the latitude."""
        return self.far and self.projection == "latitude"

    @property
    def angles(self) -> tuple[float, float]:
        """Full angles about the axis of its width and height in the far field, degrees."""
        width, height = (anglemap.angle_of(self.projection, s) for s in self.size)
        return width, height

    @property
    def solid_angle(self) -> float:
        """Of a target in the far field, sr."""
        return float(self._solid_angles(WHOLE).sum())

    def _solid_angles(self, pixels: tuple[int, int]) -> np.ndarray:
        """Of each pixel in the far field, (n_x, n_y), sr: exact by latitude, else by WITHIN^2 points of each."""
        if self.projection == "latitude":
            along = np.diff(np.sin(np.radians(self.size[1] * (np.arange(pixels[1] + 1) / pixels[1] - 0.5))))
            return np.outer(np.full(pixels[0], math.radians(self.size[0]) / pixels[0]), along)
        x, y = np.meshgrid(*self._centres((WITHIN * pixels[0], WITHIN * pixels[1])), indexing="ij")
        found = anglemap.solid_angles_at(self.projection, x, y).reshape(pixels[0], WITHIN, pixels[1], WITHIN).mean((1, 3))
        return found * math.prod(self.size) / math.prod(pixels)

    def _centres(self, pixels: tuple[int, int]) -> list[np.ndarray]:
        """Coordinates of the centres of pixels from that of the target, (n_x,) and (n_y,), mm or degrees."""
        return [((np.arange(n) + 0.5) / n - 0.5) * s for n, s in zip(pixels, self.size, strict=True)]

    def directions(self, pixels: tuple[int, int]) -> np.ndarray:
        """Unit directions from the origin to the centres of pixels, (n_x n_y, 3)."""
        x, y = (c.reshape(-1) for c in np.meshgrid(*self._centres(pixels), indexing="ij"))
        if self.far:
            return anglemap.directions_at(self.projection, x, y)
        found = np.stack([x + self.shift[0], y + self.shift[1], np.full_like(x, self.distance)], 1)
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    def shares(self, pixels: tuple[int, int]) -> np.ndarray:
        """Part of each pixel in the area of a plane target, or in the solid angle of one in the far field: (n_x, n_y), of sum 1."""
        found = self._solid_angles(pixels) if self.far else np.ones(pixels)
        return found / found.sum()

    @property
    def nearest_edge(self) -> float:
        """Angle from the axis of the middle of the nearest edge, degrees; negative if the axis misses the target."""
        if self.far:
            return min(self.angles) / 2
        reach = min(s / 2 - abs(c) for c, s in zip(self.shift, self.size, strict=True))
        return math.degrees(math.atan(reach / self.distance))

    @property
    def slopes(self) -> tuple[float, float]:
        """Largest tangents along x and along y of the angles of a plane target's light to the axis."""
        across, along = ((s / 2 + abs(c)) / self.distance for c, s in zip(self.shift, self.size, strict=True))
        return across, along

    @property
    def unit(self) -> str:
        """Of its size."""
        return "degrees" if self.far else "mm"


@dataclass(frozen=True)
class Lamp:
    """The lens around the chip, but for its free-form surface.

    Raises:
        InputError: out of range, or the chip does not fit into the hemisphere.
    """

    chip: Chip = field(default_factory=Chip)
    #: Refractive index.
    index: float = 1.49
    #: Radius of the hemisphere around the chip, or of a cavity with a flat roof, mm.
    inner: float = 4.0
    #: Greatest distance of the free-form surface from the chip's centre, mm, and least distance from the hemisphere.
    radius: float = 15.0
    wall: float = 1.0
    #: Number of free-form surfaces: with 2 the inner side is one instead of the hemisphere, and `inner` its least radius.
    surfaces: int = 1
    #: Thickness of the foot below the plane of the chip, and width of its flange beyond the rim of the lens, mm.
    base: float = 0.0
    flange: float = 0.0
    #: Lamps of an array along x and y, each with its chip, and their distances, mm: one part on a board, which the foot is.
    array: tuple[int, int] = (1, 1)
    pitch: tuple[float, float] = (0.0, 0.0)
    #: Height of a flat inner side above the chip, mm; None for another one.
    flat: float | None = None
    #: Whether light that is reflected within the lens is followed (`optics.lamp_ghosts`) instead of booked as lost.
    ghosts: bool = False

    def __post_init__(self):
        if not (min(self.array) >= 1 and self.count <= MOST_LAMPS):
            raise InputError(f"⟨lens.array⟩ of a lamp holds 1 to {MOST_LAMPS} lamps, got {self.array[0]} x {self.array[1]}")
        if self.count > 1 and not (self.base > 0 and all(2.0 * self.radius < p < math.inf for p in self.pitch)):
            raise InputError(
                f"⟨lamp.pitch⟩ must be greater than twice ⟨+lamp.radius⟩, {2.0 * self.radius:g} mm, and ⟨+lamp.base⟩, the board"
                f" that holds an array, greater than 0 mm, got {self.pitch[0]:g} x {self.pitch[1]:g} and {self.base:g} mm"
            )
        if self.surfaces not in (1, 2):
            raise InputError(f"a lamp has 1 or 2 free-form surfaces, got {self.surfaces!r}")
        if self.flat is not None and (self.surfaces > 1 or not self.chip.top < self.flat < self.radius - self.wall):
            raise InputError(
                f"⟨lamp.flat⟩ must be greater than the height of the chip, {self.chip.top:g} mm, and less than"
                f" {self.radius - self.wall:g} mm, with one free-form surface, got {self.flat:g} mm and {self.surfaces}"
            )
        self._check_solid()

    def _check_solid(self) -> None:
        if not 1.0 < self.index <= 5.0:
            raise InputError(f"⟨lens.index⟩ of a lamp must be greater than 1 and at most 5, got {self.index!r}")
        if not all(0 <= s < math.inf for s in (self.base, self.flange)) or (self.flange > 0 and self.base == 0):
            raise InputError(
                "⟨lamp.base⟩ and ⟨lamp.flange⟩ must not be negative, and a flange needs the thickness ⟨+lamp.base⟩, got"
                f" {self.base:g} and {self.flange:g} mm"
            )
        if not self.chip.reach < self.inner < math.inf:
            raise InputError(
                f"⟨lamp.inner⟩ must be greater than the radius of the chip, {self.chip.reach:g} mm, got {self.inner:g} mm"
            )
        if not (self.wall > 0 and self.inner + self.wall < self.radius < math.inf):
            raise InputError(
                f"⟨lamp.radius⟩ must be greater than ⟨+lamp.inner⟩ and ⟨+lamp.wall⟩ together, {self.inner + self.wall:g} mm, got"
                f" {self.radius:g} mm"
            )

    @property
    def count(self) -> int:
        """Number of lamps."""
        return math.prod(self.array)

    @property
    def places(self) -> np.ndarray:
        """Centres of the chips (count, 2), mm, y varying fastest; their mean is the origin."""
        x, y = (p * (np.arange(n) - 0.5 * (n - 1)) for n, p in zip(self.array, self.pitch, strict=True))
        return np.stack([c.reshape(-1) for c in np.meshgrid(x, y, indexing="ij")], 1)

    @property
    def board(self) -> tuple[float, float]:
        """Half width and height of the board of an array, mm: a cell of the lattice for each lamp, and the flange around."""
        x, y = (0.5 * n * p + self.flange for n, p in zip(self.array, self.pitch, strict=True))
        return x, y

    def blur(self, goal: Goal) -> float:
        """Full width of a point of the picture, mm or degrees: the chip as seen from the greatest radius of the lens, on the
        axis, through a plane as large as through air.  It is wider off the axis, and where the surface is nearer to the chip."""
        angle = max(self.chip.size) / self.radius * (1.0 if self.flat is None else self.index)
        return math.degrees(angle) if goal.far else angle * goal.distance

    def border(self, goal: Goal) -> float:
        """Border of a target that its interior is without, mm or degrees: both sides of the blur, within BORDERS."""
        least, most = (part * min(goal.size) for part in BORDERS)
        return min(max(least, 2.0 * self.blur(goal)), most)

    @property
    def normal_transmittance(self) -> float:
        """1 - R at normal incidence, R = ((n - 1) / (n + 1))^2."""
        return 1.0 - ((self.index - 1.0) / (self.index + 1.0)) ** 2
