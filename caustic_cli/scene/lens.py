"""The lens: flat or B-spline entrance at z_in, a B-spline exit surface over a rectangular aperture (thesis 4.1).

Notation
    r_x, r_y     half widths of the aperture [-r_x, r_x] x [-r_y, r_y], mm
    f(x, y)      offset surface: what the control heights vary about, mm (eq. 5.1.2)
    rho          radius of curvature of a spherical offset; rho > 0 is concave towards the screen (it spreads light)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from caustic_cli.config import checks
from caustic_cli.config.table import TABLE, check, check_all, default
from caustic_cli.errors import InputError
from caustic_cli.scene.front import Front
from caustic_cli.scene.gradient import Gradient


@dataclass(frozen=True)
class Offset:
    """f(x, y) = thickness + sag_x(x) + sag_y(y), the surface that a height of zero stands for.

    Args:
        thickness: f(0, 0), mm.
        radius: (rho_x, rho_y) mm, inf for flat.  Equal and finite radii give the sphere of table 6.1,
            thickness + rho - sqrt(rho^2 - x^2 - y^2); different ones the sum of two circular profiles.
    """

    thickness: float = 5.0
    radius: tuple[float, float] = (math.inf, math.inf)

    def __post_init__(self):
        check("lens.thickness", self.thickness)
        for r in self.radius:
            if isinstance(r, bool) or not isinstance(r, int | float) or math.isnan(r) or r == 0:
                raise InputError(f"⟨lens.radius⟩ must be a non-zero number or inf, got {r!r}")

    @classmethod
    def for_magnification(
        cls, mag: tuple[float, float], index: float, throw: float, thickness: float, vergence: float = 0.0
    ) -> Offset:
        """The sphere that spreads light over `mag` times the aperture: rho = (n - 1) T / (mag - 1 - T V), T = z_screen - z_lens.

        For parallel light (V = 0) that is table 6.1's, erratum E12.  `throw` is z_screen, `thickness` is z_lens (mm);
        `vergence` V is one over the distance, behind the lens, from which the light seems to come (1/mm): paraxially a ray
        at height x lands at x (1 + T V + (n - 1) T / rho).
        """
        reach = throw - thickness
        powers = [(m - 1.0 - reach * vergence) / ((index - 1.0) * reach) for m in mag]
        rho_x, rho_y = (math.inf if p == 0 else 1.0 / p for p in powers)
        return cls(thickness, (rho_x, rho_y))

    def sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """f(x, y) - thickness at points x, y (broadcast), float64 mm.

        Raises:
            InputError: the sphere ends inside the aperture.
        """
        xx, yy = (np.square(np.asarray(c, float)) for c in (x, y))
        rx, ry = self.radius
        terms = [(xx + yy, rx)] if rx == ry else [(xx, rx), (yy, ry)]
        total = np.zeros(np.broadcast_shapes(xx.shape, yy.shape))
        for square, rho in terms:
            if math.isinf(rho):
                continue
            if square.max(initial=0.0) >= rho * rho:
                raise InputError(
                    f"⟨lens.radius⟩ must exceed the lens' own reach of {math.sqrt(square.max()):.4g} mm, got {abs(rho):.4g} mm"
                    " (a smaller ⟨mag⟩ or a longer ⟨throw⟩ gives a larger radius)"
                )
            # rho - sign sqrt(rho^2 - s) without its cancellation
            root = rho * rho - square
            np.sqrt(root, out=root)
            root *= math.copysign(1.0, rho)
            root += rho
            total += np.divide(square, root, out=root)
        return total


def array_control(n: int, degree: int, lenslets: int) -> int:
    """The least number of control points, n or more, that so many lenslets side by side of equally many spans have; see
    `open_knots`."""
    spans = max(1, math.ceil((n - 1) / lenslets) - degree + 1)
    return lenslets * (spans + degree - 1) + 1


@dataclass(frozen=True)
class Lens:
    """A lens of refractive index n with flat entrance and B-spline exit.

    Args:
        size: full width and height of the aperture, mm.
        z_in: position of the flat entrance surface, mm.
        index: refractive index (the surroundings have 1).
        control: control points along x and y.
        degree: spline degrees along x and y.
        knots: (knots_u, knots_v) on [0, 1], or None for open equispaced ones.
        min_thickness: least distance of every control height from z_in, mm (4.1.2).
        offset: the surface the heights vary about.
        height_range: least and largest departure from the offset, mm (5.1.1).
        fresnel: reflection losses at both surfaces: none, schlick or exact (unpolarised).
        absorption: absorption coefficient a of the glass, 1/mm: exp(-a t) passes t mm (Beer-Lambert).
        roughness: standard deviation, along either axis, of the slopes of the exit's microfacets about the surface's own.
        glass: a name of `materials`, whose index changes with the wavelength; None for `index` at every wavelength.
        aperture: rectangle, or circle, the largest that fits into the size; the spline goes on beyond it, light and glass do not.
        border: width of a dark rim around the aperture, which the exported solid has for its mount, mm.
        array: lenslets along x and y, side by side over the aperture, which meet in height; (1, 1) is one lens.
        gradient: how the index varies from place to place, `index` being that of its formula; None where it does not.
        mirror: the surface reflects, the light comes through air, and `index`, `fresnel` and `absorption` mean nothing.
        front: the entrance where it is free-form, None for the plane.
    """

    size: tuple[float, float] = default("lens.size")
    z_in: float = default("lens.z_in")
    index: float = default("lens.index")
    control: tuple[int, int] = (50, 50)
    degree: tuple[int, int] = default("lens.degree")
    knots: tuple[Sequence[float], Sequence[float]] | None = None
    min_thickness: float = 0.0
    offset: Offset = field(default_factory=Offset)
    height_range: tuple[float, float] = (-1.0, 1.0)
    fresnel: str = default("lens.fresnel")
    absorption: float = default("lens.absorption")
    roughness: float = default("lens.roughness")
    glass: str | None = None
    mirror: bool = default("lens.mirror")
    aperture: str = default("lens.aperture")
    border: float = default("lens.border")
    array: tuple[int, int] = default("lens.array")
    front: Front | None = None
    gradient: Gradient | None = None

    def __post_init__(self):
        check_all(
            "lens",
            self,
            "size",
            "z_in",
            "index",
            "degree",
            "min_thickness",
            "height_range",
            "fresnel",
            "absorption",
            "roughness",
            "aperture",
            "border",
            "array",
        )
        least = iter(self.degree)
        checks.pair("⟨lens.control⟩", self.control, lambda w, n: checks.whole(w, n, next(least) + 1, TABLE["lens.control"].high))
        if self.knots is not None:
            for axis, t, n, p in zip("uv", self.knots, self.control, self.degree, strict=True):
                if len(t) != n + p + 1:
                    raise InputError(f"⟨lens.knots_{axis}⟩ must have control + degree + 1 = {n + p + 1} entries, got {len(t)}")
        if self.arrayed:
            self._check_array()
        low, high = self.height_range
        if not low < high:
            raise InputError(f"⟨lens.height_range⟩ must ascend, got [{low:g}, {high:g}]")
        if self.gradient is not None and self.mirror:
            raise InputError("⟨lens.gradient⟩ needs a lens: light never enters a mirror")
        if self.round and self.size[0] != self.size[1]:
            raise InputError(
                f"⟨lens.size⟩ of a circular aperture must be its diameter, twice the same, got {self.size[0]:g} x {self.size[1]:g}"
            )

    def _check_array(self) -> None:
        if self.round:
            raise InputError("⟨lens.aperture⟩ of an array must be a rectangle, which its lenslets fill")
        if self.knots is not None:
            raise InputError("⟨lens.array⟩ has knots of its own: give no knots_u and knots_v")

    @property
    def cut_from(self) -> int:
        """The side from which a tool cuts the shaped surface: 1 from +z, or -1 from -z, from where light reaches a mirror."""
        return -1 if self.mirror else 1

    @property
    def arrayed(self) -> bool:
        """Whether it is an array of lenslets."""
        return max(self.array) > 1

    @property
    def half_size(self) -> tuple[float, float]:
        """(r_x, r_y) mm."""
        return self.size[0] / 2.0, self.size[1] / 2.0

    @property
    def round(self) -> bool:
        """Whether the aperture is a circle."""
        return self.aperture == "circle"

    @property
    def lowest(self) -> float:
        """z that no part of the entrance lies below, mm."""
        return self.z_in + (0.0 if self.front is None else min(0.0, float(self.front.heights.min())))

    @property
    def inside(self) -> float:
        """Refractive index before the free-form surface: the glass', or 1 before a mirror."""
        return 1.0 if self.mirror else self.index

    @property
    def effective_index(self) -> float:
        """n in "a slope turns light by n - 1 times itself": the index, or -1 for a mirror (Snell's law with index -1)."""
        return -1.0 if self.mirror else self.index

    def height_bounds(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest control height at control points x (n,), y (m,): two (n, m) float64, mm.

        Every height at least z_in + min_thickness keeps the whole surface there, by the convex hull property (4.1.2).

        Raises:
            InputError: the bounds leave no room.
        """
        f = self.offset.thickness + self.offset.sag(x[:, None], y[None, :])
        low = np.maximum(f + self.height_range[0], self.z_in + self.min_thickness)
        high = f + self.height_range[1]
        if not (low < high).all():
            raise InputError(
                f"⟨lens.min_thickness⟩ of {self.min_thickness:g} mm leaves the heights no room: offset plus height_range"
                f" reaches only {high.min() - self.z_in:.4g} mm above z_in; raise ⟨+lens.thickness⟩ or ⟨lens.height_range⟩"
            )
        return low, high
