"""The free-form lens: plane or B-spline entrance at z_in, B-spline exit over a rectangular or circular aperture (thesis 4.1).

Notation
    r_x, r_y     half widths of the aperture [-r_x, r_x] x [-r_y, r_y], mm
    f(x, y)      offset surface (base surface): control heights are bounded relative to it, mm (eq. 5.1.2)
    rho          radius of curvature of a spherical offset; rho > 0 is concave towards the screen, a diverging surface
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.loading import OnDemand
from caustic_cli.scene.aperture import Aperture, Pupil, aperture_of, larger
from caustic_cli.scene.freeform import FreeForm
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.interaction import Interior, Reflecting, Refracting, interaction_of
from caustic_cli.schema import checks
from caustic_cli.schema.table import TABLE, check, check_all, default

if TYPE_CHECKING:
    from caustic_cli.scene.cells import Cells

packings = OnDemand("caustic_cli.scene.packing")
#: Rows of a grid that are computed at a time, so that intermediate arrays fit in the cache.
ROWS = 64


@dataclass(frozen=True)
class Offset:
    """The base surface f(x, y) = thickness + sag_x(x) + sag_y(y)."""

    #: f(0, 0), mm.
    thickness: float = 5.0
    #: (rho_x, rho_y) mm, inf for flat.  Equal and finite radii give the sphere of table 6.1, thickness + rho - sqrt(rho^2 - x^2 -
    #: y^2); different ones the sum of two circular profiles.
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
        """The sphere that spreads the light over `mag` times the aperture: rho = (n - 1) T / (mag - 1 - T V), T = z_screen -
        z_lens.

        For parallel light (V = 0) this is the sphere of table 6.1, erratum E12.  `throw` is z_screen, `thickness` is z_lens (mm).
        `vergence` V is the reciprocal of the distance from the apparent source, behind the lens, to the lens (1/mm): paraxially a
        ray at height x lands at x (1 + T V + (n - 1) T / rho).
        """
        reach = throw - thickness
        powers = [(m - 1.0 - reach * vergence) / ((index - 1.0) * reach) for m in mag]
        rho_x, rho_y = (math.inf if p == 0 else 1.0 / p for p in powers)
        return cls(thickness, (rho_x, rho_y))

    def sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """f(x, y) - thickness at points x, y (broadcast), float64 mm.

        Raises:
            InputError: the aperture is larger than the sphere.
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
                    f"⟨lens.radius⟩ must exceed the lens' semi-aperture of {math.sqrt(square.max()):.4g} mm, got {abs(rho):.4g} mm"
                    " (where it is derived, a smaller ⟨mag⟩ or a longer ⟨throw⟩ gives a larger radius)"
                )
            # s / (rho + sign sqrt(rho^2 - s)), which is rho - sign sqrt(rho^2 - s) without cancellation
            root = rho * rho - square
            np.sqrt(root, out=root)
            root *= math.copysign(1.0, rho)
            root += rho
            total += np.divide(square, root, out=root)
        return total

    def slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Slopes of f along x and y at points x, y of one shape; raises as `sag`."""
        (rx, ry), _ = self.radius, self.sag(x, y)
        across, along = (x * x + y * y,) * 2 if rx == ry else (x * x, y * y)
        sx, sy = (
            np.zeros_like(c) if math.isinf(rho) else math.copysign(1.0, rho) * c / np.sqrt(rho * rho - square)
            for c, square, rho in ((x, across, rx), (y, along, ry))
        )
        return sx, sy

    def check_size(self, size: tuple[float, float]) -> None:
        """Check that it covers a lens of this size, mm: radii are checked where heights are taken."""

    def scaled(self, factor: float) -> Offset:
        """Larger by a factor."""
        return Offset(factor * self.thickness, larger(self.radius, factor))

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """f on the grid of points x (n,), y (m,): (n, m) float64 mm; raises as `sag`."""
        self.sag(np.array([x.min(), x.max()])[:, None], np.array([y.min(), y.max()]))  # refuses all at once
        f = np.empty((len(x), len(y)))
        for k in range(0, len(x), ROWS):
            np.add(self.thickness, self.sag(x[k : k + ROWS, None], y), out=f[k : k + ROWS])
        return f


def array_control(n: int, degree: int, lenslets: int) -> int:
    """The least number of control points, at least n, for which all lenslets of a row have equally many knot spans; see
    `open_knots`."""
    spans = max(1, math.ceil((n - 1) / lenslets) - degree + 1)
    return lenslets * (spans + degree - 1) + 1


@dataclass(frozen=True)
class Lens:
    """A lens with a plane or free-form entrance and a B-spline exit, in air; or a free-form mirror.

    Raises:
        InputError: a value is out of range, or two contradict each other.
    """

    #: Full width and height of the aperture, mm.
    size: tuple[float, float] = default("lens.size")
    #: Position of the plane entrance, or of the reference plane of a free-form one, mm.
    z_in: float = default("lens.z_in")
    #: Refractive index (the surroundings have 1).
    index: float = default("lens.index")
    #: Control points along x and y.
    control: tuple[int, int] = (50, 50)
    #: Spline degrees along x and y.
    degree: tuple[int, int] = default("lens.degree")
    #: (knots_u, knots_v) on [0, 1], or None for open equispaced ones.
    knots: tuple[Sequence[float], Sequence[float]] | None = None
    #: Least distance of every control height of a lens from z_in, mm (4.1.2).
    min_thickness: float = 0.0
    #: Base surface.
    offset: Offset = field(default_factory=Offset)
    #: Least and largest height above the base surface, mm (5.1.1).
    height_range: tuple[float, float] = (-1.0, 1.0)
    #: Reflection losses at both surfaces: none, schlick or exact (unpolarised).
    fresnel: str = default("lens.fresnel")
    #: Absorption coefficient a of the glass, 1/mm; the transmittance of t mm is exp(-a t) (Beer-Lambert).
    absorption: float = default("lens.absorption")
    #: Standard deviation, along either axis, of the slopes of the exit's microfacets relative to the smooth surface.
    roughness: float = default("lens.roughness")
    #: A dispersive material, by its name in `materials`; None for `index` at every wavelength.
    glass: str | None = None
    #: The free-form surface reflects, in air; `index`, `fresnel` and `absorption` are ignored.
    mirror: bool = default("lens.mirror")
    #: rectangle, or circle, the largest that fits into the size; the spline is defined beyond it, light and glass end there.
    aperture: str = default("lens.aperture")
    #: Width of a dark rim around the aperture, which the exported solid has for its mount, mm.
    border: float = default("lens.border")
    #: Numbers of lenslets along x and y, whose surfaces are continuous across their borders; (1, 1) is a single lens.
    array: tuple[int, int] = default("lens.array")
    #: How they are packed, square or hexagonal; and whether they are filled, or round ones in an opaque mask.
    packing: str = default("lens.packing")
    lenslets: str = default("lens.lenslets")
    #: The free-form entrance; None for a plane one.
    entrance: FreeForm | None = None
    #: Gradient-index distribution, with `index` for n_0 of its formula; None for a homogeneous lens.
    gradient: Gradient | None = None
    #: Of the two surfaces that send light to a picture, the one behind which it crosses over.
    crossing: bool = default("lens.crossing")
    #: What is clear of the exit of a lens that is a lenslet of an array; None for all, or for the lenslets of an array.
    outline: Aperture | None = None

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
            "packing",
            "lenslets",
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
        _ = self.opening

    def _check_array(self) -> None:
        if self.aperture != Aperture.name:
            raise InputError("⟨lens.aperture⟩ of an array must be a rectangle, which its lenslets fill")
        if self.knots is not None:
            raise InputError("⟨lens.array⟩ has knots of its own: give no knots_u and knots_v")
        _ = self.cells

    @property
    def interaction(self) -> Refracting | Reflecting:
        """What its surface does with light."""
        return interaction_of(self.mirror)

    @property
    def kind(self) -> str:
        """lens or mirror."""
        return self.interaction.kind

    @property
    def cut_from(self) -> int:
        """The side from which a tool machines the free-form surface: 1 from +z, or -1 from -z for a mirror, the side of its
        light."""
        return self.interaction.side

    @property
    def arrayed(self) -> bool:
        """Whether it is an array of lenslets."""
        return max(self.array) > 1

    @cached_property
    def cells(self) -> Cells:
        """Where the lenslets of an array are."""
        return packings.cells_of(self.packing, self.array, self.size, equal=not self.round_lenslets)

    @property
    def pieces(self) -> tuple[int, int]:
        """Pieces of its spline along x and y, between which creases may lie."""
        return self.cells.pieces if self.arrayed else (1, 1)

    @property
    def half_size(self) -> tuple[float, float]:
        """(r_x, r_y) mm."""
        return self.size[0] / 2.0, self.size[1] / 2.0

    @cached_property
    def opening(self) -> Aperture:
        """Its aperture."""
        return aperture_of(self.aperture, self.size, "lens.size")

    @cached_property
    def clear(self) -> Aperture:
        """What of its exit is clear: its aperture, or round lenslets."""
        if self.outline is not None:
            return self.outline
        return packings.RoundLenslets(self.half_size, self.cells) if self.round_lenslets else self.opening

    @property
    def round_lenslets(self) -> bool:
        """Whether it is an array of round lenslets in an opaque mask."""
        return self.arrayed and self.lenslets == "round"

    @cached_property
    def pupil(self) -> Pupil:
        """Its aperture where light meets it first: at the entrance, or at the mean height of the edge of a mirror."""
        return Pupil(self.opening, self.interaction.first(self.z_in, self._edge))

    def _edge(self) -> float:
        """Mean height of the edge of the base surface, mm, to second order."""
        x, y = (np.array([c]) for c in self.opening.on_edge)
        return self.offset.thickness + float(self.offset.sag(x, y)[0])

    @property
    def lowest(self) -> float:
        """Lower bound of z over the surface that light meets first, the entrance or a mirror, mm."""
        entrance = 0.0 if self.entrance is None else min(0.0, float(self.entrance.heights.min()))
        return self.interaction.first(self.z_in + entrance, self._lowest_of_surface)

    def _lowest_of_surface(self) -> float:
        corner = (np.array([c]) for c in self.half_size)
        return self.offset.thickness + min(0.0, float(self.offset.sag(*corner).min())) + self.height_range[0]

    @property
    def floor(self) -> float:
        """z that no control height must fall below, mm: by the least thickness of a lens with a flat entrance; a mirror has
        none."""
        return self.interaction.base(self.z_in) + self.min_thickness

    def floors(self, x: np.ndarray, y: np.ndarray) -> np.ndarray | float:
        """The same at control points x (n,), y (m,), mm: the least thickness above the entrance there, or one for all, (n, m)."""
        if self.entrance is None:
            return self.floor
        return self.floor + self.entrance.at(x / self.half_size[0], y / self.half_size[1])

    @property
    def interior(self) -> Interior:
        """What light crosses in front of the exit."""
        return self.interaction.interior(Interior(self.index, self.absorption, self.fresnel, self.glass))

    @property
    def inside(self) -> float:
        """Refractive index of the medium in front of the exit: that of the glass, or 1 for a mirror."""
        return self.interior.index

    @property
    def effective_index(self) -> float:
        """n of the paraxial deflection (n - 1) times the slope: the index, or -1 for a mirror (Snell's law with index -1)."""
        return self.interaction.effective_index(self.index)

    def denser(self, by: float) -> Lens:
        """The lens with an index that is larger by this everywhere."""
        return replace(self, index=self.index + by, gradient=None if self.gradient is None else self.gradient.denser(by))

    def scaled(self, factor: float) -> Lens:
        """The lens larger by a factor, with the same angles, index and transmittance."""
        parts: dict[str, Any] = {"entrance": self.entrance, "gradient": self.gradient, "outline": self.outline}
        return replace(
            self,
            size=larger(self.size, factor),
            z_in=factor * self.z_in,
            min_thickness=factor * self.min_thickness,
            offset=self.offset.scaled(factor),
            height_range=larger(self.height_range, factor),
            absorption=self.absorption / factor,
            border=factor * self.border,
            **{name: part.scaled(factor) for name, part in parts.items() if part is not None},
        )

    def height_bounds(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the control heights at control points x (n,), y (m,): two (n, m) float64, mm.

        With every height at least `floor` the whole surface is, too, by the convex hull property (4.1.2); above a curved
        entrance, as far as the control points follow it.

        Raises:
            InputError: the lower bound exceeds the upper one somewhere.
        """
        f = self.offset.heights(x, y)
        low = np.maximum(f + self.height_range[0], self.floors(x, y))
        high = f + self.height_range[1]
        if not (low < high).all():
            raise InputError(
                f"⟨lens.min_thickness⟩ of {self.min_thickness:g} mm leaves no room for the heights: base surface plus height_range"
                f" reaches only {high.min() - self.z_in:.4g} mm above z_in; raise ⟨+lens.thickness⟩ or ⟨lens.height_range⟩"
            )
        return low, high
