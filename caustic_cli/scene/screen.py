"""The screen: a rectangular pixel grid, in a plane z = const unless it is tilted or curved.

A curved screen is a height field S(x, y) over its tangent plane.  Its pixels are equal cells of x and y in that plane, so the
picture appears undistorted in orthographic projection along the screen's normal.  S > 0 lies on the side of the normal, which is +z
for an upright screen.

A far screen is the far field, as in the back focal plane of an ideal lens of focal length F = |z| that stands against the surface:
light with the direction cosines q along the screen's axes lands at F q, from wherever it comes.  With F = FOCAL, 1 m, the screen's
lengths are mrad.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import and_, mul
from typing import Any

import numpy as np

from caustic_cli.errors import InputError, at_least
from caustic_cli.scene.aperture import Aperture, larger
from caustic_cli.schema.table import check_all, default

#: Largest number of points of a measured shape along an axis.
MAX_SAGS = 4096
#: Largest half extent of a spherical or cylindrical screen, as a fraction of its radius: beyond it incidence is near grazing.
STEEPEST = 0.98
#: A sheet around a screen over it: that of the test card.
SHEET = 1.25
#: Least angle between the plane of a screen and the light, degrees: a beam is there a hundred times as long as it is wide.
GRAZING = 0.5
#: Focal length with which lengths on a far screen are mrad, mm.
FOCAL = 1000.0
#: Largest direction cosine of a corner of a far screen.
WIDEST = 0.5
#: Radii of a plane screen.
PLANE = (math.inf, math.inf)
#: Sine of the angle between a direction and the y axis up to which they count as parallel.
PARALLEL = 1e-9

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Sags:
    """Measured heights S of a screen: values (a, b) mm, [i, j] with i along +x, on a uniform grid over a rectangle of full width
    and height `size`, mm, centred on the screen, borders included.

    Raises:
        InputError: there are too few or too many values, or some are not finite.
    """

    values: np.ndarray
    size: tuple[float, float]

    def __post_init__(self):
        a, b = self.values.shape
        if not 4 <= min(a, b) <= max(a, b) <= MAX_SAGS:
            raise InputError(f"⟨screen.shape_file⟩ must have 4 to {MAX_SAGS} heights along each axis, got {a} x {b}")
        if not np.isfinite(self.values).all():
            raise InputError("⟨screen.shape_file⟩ must hold finite heights in mm")

    def scaled(self, factor: float) -> Sags:
        """Larger by a factor."""
        return Sags(factor * self.values, larger(self.size, factor))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sags) and self.values is other.values and self.size == other.size

    def __hash__(self) -> int:
        return hash((id(self.values), self.size))


@dataclass(frozen=True)
class Window:
    """An opening in a plane: that of a mirror in which a screen is seen.

    Args:
        vertex: its centre, mm; axes: unit vectors along its x, along its y, normal to it.
        opening: its aperture.
    """

    vertex: Vector
    axes: tuple[Vector, Vector, Vector]
    opening: Aperture

    def scaled(self, factor: float) -> Window:
        """The opening larger by a factor, at as many times the distance."""
        x, y, z = (factor * v for v in self.vertex)
        return replace(self, vertex=(x, y, z), opening=self.opening.scaled(factor))

    def passed(self, origin: Sequence[Any], direction: Sequence[Any]) -> Any:
        """Whether straight rays pass it, (N,): three components of their origins, mm, and directions, each (N,) or a number."""
        away = [o - v for o, v in zip(origin, self.vertex, strict=True)]
        (x, y, z), (dx, dy, dz) = ([sum(map(mul, axis, vector)) for axis in self.axes] for vector in (away, direction))
        return self.opening.contains(x - z / dz * dx, y - z / dz * dy)


def passed_by(windows: Iterable[Window], origin: Sequence[Any], direction: Sequence[Any]) -> Any:
    """Whether rays pass all windows; arguments as of `Window.passed`.  True without any."""
    return reduce(and_, (window.passed(origin, direction) for window in windows), True)


@dataclass(frozen=True)
class Screen:
    """Pixels [i, j], i along +x, j along +y, on [-R_x, R_x] x [-R_y, R_y] at z (thesis 3.1.1).

    Raises:
        InputError: a value is out of range, or the radii are those of neither a sphere nor a cylinder.
    """

    #: Full width and height (2 R_x, 2 R_y), mm.
    size: tuple[float, float]
    #: Position, mm.
    z: float = default("screen.z")
    #: Pixels along x and y.
    resolution: tuple[int, int] = (250, 250)
    #: Right-handed rotations of the screen about its own centre, (a, b) or (a, b, c), degrees: see `tilted`.
    tilt: tuple[float, ...] = default("screen.tilt")
    #: Decentre of the screen along x and y, mm.
    shift: tuple[float, float] = default("screen.shift")
    #: Radii of curvature along x and y, mm: equal for a sphere, one of them inf for a cylinder; positive if the centre of curvature
    #: lies on the side of the normal, so that the edges bend that way.
    radius: tuple[float, float] = PLANE
    #: A measured shape instead.
    sags: Sags | None = None
    #: Whether its x and y point against those of the scene, as of a screen that is seen in a mirror; tilt and shift refer to its
    #: own.
    mirrored: tuple[bool, bool] = (False, False)
    #: What light has to pass on its way to it.
    windows: tuple[Window, ...] = ()
    #: Whether it is the far field, see the module.
    far: bool = False

    def __post_init__(self):
        check_all("screen", self, "size", "z", "resolution", "tilt", "shift")
        if self.far and self.curved:
            raise InputError("⟨screen.far⟩ is the far field, which has no radius and no shape: leave out ⟨screen.radius⟩")
        if self.far and self.z and (widest := math.hypot(*self.half_size) / abs(self.z)) > WIDEST:
            raise InputError(
                f"⟨screen.far⟩: the screen reaches {math.degrees(math.asin(min(1.0, widest))):.3g} degrees from its centre at its"
                f" corners, and {math.degrees(math.asin(WIDEST)):.3g} at most are supported: a screen smaller than"
                f" {' x '.join(f'{WIDEST / widest * c:.4g}' for c in self.size)} {self.unit}"
            )
        if len(self.tilt) not in (2, 3):
            raise InputError(f"⟨screen.tilt⟩ must be two or three angles, got {len(self.tilt)}")
        self._check_shape()

    def _check_shape(self) -> None:
        if any(isinstance(r, bool) or not isinstance(r, int | float) or math.isnan(r) or r == 0 for r in self.radius):
            raise InputError(f"⟨screen.radius⟩ must be non-zero numbers of mm or inf, got {list(self.radius)}")
        if self.radius[0] != self.radius[1] and all(map(math.isfinite, self.radius)):
            raise InputError(
                "⟨screen.radius⟩ must be the same along x and y, of a sphere, or inf along one, of a cylinder,"
                f" got {self.radius[0]:g} and {self.radius[1]:g} mm; any other shape is for ⟨screen.shape_file⟩"
            )
        if self.sags is not None and self.rounded:
            raise InputError("⟨screen.radius⟩ and ⟨screen.shape_file⟩ are two shapes of one screen: give one of them")

    @property
    def rounded(self) -> bool:
        """Whether it is spherical or cylindrical."""
        return any(map(math.isfinite, self.radius))

    @property
    def curved(self) -> bool:
        """Whether it is not plane."""
        return self.rounded or self.sags is not None

    @property
    def rolled(self) -> bool:
        """Whether it is a cylinder, around which a sheet SHEET times as wide can be rolled."""
        bent = [(h, abs(r)) for h, r in zip(self.half_size, self.radius, strict=True) if math.isfinite(r)]
        return len(bent) == 1 and SHEET * bent[0][0] <= STEEPEST * bent[0][1]

    def unrolled(self, x: float, y: float) -> tuple[float, float]:
        """Where a point of its own coordinates, mm, lies on a sheet rolled around it, of a plane or a cylinder: at its arc length
        from the middle."""
        u, v = (c if math.isinf(r) else abs(r) * math.asin(c / abs(r)) for c, r in zip((x, y), self.radius, strict=True))
        return u, v

    @property
    def upright(self) -> bool:
        """Whether it is plane, perpendicular to the axis, at a finite distance and not seen in mirrors."""
        return not (self.curved or any(self.tilt) or self.windows or self.far)

    @property
    def unit(self) -> str:
        """Of lengths on it."""
        return "mrad" if self.far and abs(self.z) == FOCAL else "mm"

    @property
    def uncurved(self) -> Screen:
        """The tangent plane screen, with the same pixels."""
        return replace(self, radius=PLANE, sags=None) if self.curved else self

    def check_curvature(self) -> None:
        """Check that a spherical or cylindrical screen is no larger than its radius allows.

        Raises:
            InputError: giving the least radius.
        """
        bent = [(h, abs(r)) for h, r in zip(self.half_size, self.radius, strict=True) if math.isfinite(r)]
        if bent and (far := math.hypot(*(h for h, _ in bent))) > STEEPEST * bent[0][1]:
            raise InputError(
                f"⟨screen.radius⟩ must be at least {at_least(far / STEEPEST, 4)} mm either way for a screen of {self.size[0]:g} x"
                f" {self.size[1]:g} mm to lie on {'the sphere' if len(bent) == 2 else 'the cylinder'}, got {bent[0][1]:g} mm"
            )

    def check_facing(self, light: Vector) -> None:
        """Check that light along a unit vector meets its plane at an angle.

        Raises:
            InputError: it does not.
        """
        angle = math.degrees(math.asin(min(1.0, abs(sum(map(mul, light, self.axes[2]))))))
        if angle < GRAZING:
            raise InputError(
                f"⟨screen.tilt⟩ makes the screen nearly parallel to the light; {GRAZING:g} degrees between them are needed at"
                f" least, got {angle:.2g}"
            )

    def shape_words(self) -> str:
        """Its shape in words, such as "a sphere of radius 60 mm"."""
        if self.sags is not None:
            a, b = self.sags.values.shape
            return f"a measured shape of {a} x {b} heights"
        finite = [r for r in self.radius if math.isfinite(r)]
        if not finite:
            return "plane"
        return f"a {'sphere' if len(finite) == 2 else 'cylinder'} of radius {finite[0]:g} mm"

    @property
    def half_size(self) -> tuple[float, float]:
        """(R_x, R_y) mm."""
        return self.size[0] / 2.0, self.size[1] / 2.0

    @property
    def pixel(self) -> tuple[float, float]:
        """Width and height of a pixel (w_x, w_y), mm (eq. 4.4.1)."""
        return self.size[0] / self.resolution[0], self.size[1] / self.resolution[1]

    def grown(self, pixels: tuple[int, int]) -> Screen:
        """The screen padded by so many pixels on each side along x and y."""
        (wx, wy), (nx, ny), (ax, ay) = self.pixel, self.resolution, pixels
        return replace(self, size=(self.size[0] + 2 * ax * wx, self.size[1] + 2 * ay * wy), resolution=(nx + 2 * ax, ny + 2 * ay))

    @property
    def low(self) -> tuple[float, float]:
        """Lower edges along its own axes, measured from the optical axis, mm: -R + shift."""
        return self.shift[0] - self.half_size[0], self.shift[1] - self.half_size[1]

    @property
    def axes(self) -> tuple[Vector, Vector, Vector]:
        """Unit vectors along its x and y axes, and its unit normal."""
        x, y, z = (self.in_space(axis) for axis in tilted(self.tilt))
        return x, y, z

    @property
    def centre(self) -> Vector:
        """Its centre in the scene, mm."""
        return self.in_space((*self.shift, self.z))

    def scaled(self, factor: float) -> Screen:
        """The screen larger by a factor at as many times the distance, in the same directions: a far one is what it was."""
        if self.far:
            return self
        return replace(
            self,
            size=larger(self.size, factor),
            z=factor * self.z,
            shift=larger(self.shift, factor),
            radius=larger(self.radius, factor),
            sags=None if self.sags is None else self.sags.scaled(factor),
            windows=tuple(window.scaled(factor) for window in self.windows),
        )

    def in_space(self, own: Vector) -> Vector:
        """A vector in the scene, from its components along the axes of the screen before its tilt; and the other way round."""
        x, y = (-c if reversed else c for c, reversed in zip(own[:2], self.mirrored, strict=True))
        return x, y, own[2]


def tilted(tilt: Sequence[float]) -> tuple[Vector, Vector, Vector]:
    """The axes x, y, z after right-handed rotations about the fixed x axis by the first angle, then about the fixed y axis by the
    second, degrees, and before both about z by a third, if there is one: unit vectors."""
    (sa, ca), (sb, cb), *about_z = ((math.sin(t), math.cos(t)) for t in map(math.radians, tilt))
    x, y, z = (cb, 0.0, -sb), (sb * sa, ca, cb * sa), (sb * ca, -sa, cb * ca)
    for s, c in about_z:
        x, y = _combined(c, x, s, y), _combined(-s, x, c, y)
    return x, y, z


def tilt_to(x: Vector, z: Vector) -> tuple[float, float, float]:
    """The angles, degrees, by which `tilted` takes the axes to unit vectors x and z, perpendicular to each other; the second is 0
    where the third does the same."""
    a = math.asin(max(-1.0, min(1.0, -z[1])))
    b = math.atan2(z[0], z[2]) if math.hypot(z[0], z[2]) > PARALLEL else 0.0
    along_x, along_y, _ = tilted((math.degrees(a), math.degrees(b)))
    c = math.atan2(*(sum(map(mul, axis, x)) for axis in (along_y, along_x)))
    return math.degrees(a), math.degrees(b), math.degrees(c)


def _combined(a: float, u: Vector, b: float, v: Vector) -> Vector:
    x, y, z = (a * p + b * q for p, q in zip(u, v, strict=True))
    return x, y, z
