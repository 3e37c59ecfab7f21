"""The first surface of a design by transport: the heights that send what lights the exit surface onto the picture.

Light of a source close by can be lost: it leaves by the sides of a thick lens, and what reaches a thin one asks for more depth than
that has.  So where much is lost, surfaces of several heights are solved for, each cut off at the least thickness, and only from
the light that they do send to the picture: what falls on the cut, or cannot be refracted so far, counts for nothing.  The one is
taken that keeps most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import incident
from caustic_cli.inverse.projection import View
from caustic_cli.inverse.relay import Relayed
from caustic_cli.inverse.surface_from_map import OutOfReach, Seen, Start, finer, thrown
from caustic_cli.inverse.surface_from_map import surface as refracting_surface
from caustic_cli.inverse.transport import cell_lines, corners
from caustic_cli.optics.surfaces import Sphere
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Component, Lens, Scene
from caustic_cli.scene.elements import SIDES

#: Source cells along the lens' longer side: a picture of 250 x 250 pixels is resolved, and they are cheap.
CELLS = 256
#: Most of them for which transport is solved.  What needs more, which creases do, is solved on about so many, and then evaluated on
#: cells so many times finer.
SOLVED, COARSE = 1024, 512
#: Sites of the solution for a bright pixel where finer cells are; part of the cells then needed that are enough where these divide
#: the finer ones.
SITES, NEARLY = 2, 0.95
#: Light in the wrong cell, and Newton steps a level, where finer cells show that: 5e-3 left text with errors of 0.088 to 0.123.
EXACT, STEPS = 5e-4, 30
#: How much higher a net may be than the surface it was interpolated from.
OVERSHOOT = 2.0
#: Surfaces solved for in turn where the light depends on the surface it meets.
PASSES = 3
#: Light where a near source has none to give, in parts of the mean: it costs as much of the picture, and saves many steps.
DARKEST = 0.02
#: Cells on which the height of a near source's lens is chosen; one that sends this part of the light on it to the screen will do.
FEW_CELLS, WELL = 64, 0.7
#: Heights of the surface's middle that are tried where one sends less, in parts of the lens' thickness.
TRIED = (0.3, 0.45, 0.65, 1.5, 2.2, 3.3)
#: Cells along which light has nowhere to go that are left out at most before the picture counts as out of reach.
RETRIES = 4
#: Part of another lens' least thickness that each of its surfaces may take.
GLASS = 0.45
UNREACHED = (
    "no light of the source that meets the lens can be refracted to the picture by a surface over this aperture; a picture"
    " nearer the light's way, or a source farther away, is needed"
)


@dataclass(frozen=True, eq=False)
class InitialSurface:
    """A first surface: its control heights (n, m) mm float64, and the height of its middle, mm, where that was chosen, for a near
    source."""

    heights: Tensor
    middle: float | None = None


@dataclass(frozen=True, eq=False)
class _Grid:
    """Corners x (n + 1,), y (m + 1,) of source cells over the lens of a scene, and its target."""

    scene: Scene
    target: np.ndarray
    x: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, scene: Scene, target: np.ndarray, cells: int) -> _Grid:
        return cls(scene, target, *cell_lines(scene.lens.half_size, cells))

    @property
    def offset(self) -> np.ndarray:
        """Heights of the offset surface."""
        offset = self.scene.lens.offset
        return offset.thickness + offset.sag(self.x[:, None], self.y[None, :])

    @property
    def floor(self) -> float:
        """The least height that the lens may have."""
        return self.scene.lens.z_in + self.scene.lens.min_thickness

    def scaled(self, values: np.ndarray, onto: _Grid) -> np.ndarray:
        """What these corners have, at those of another grid."""
        return RectBivariateSpline(self.x, self.y, values)(onto.x, onto.y)

    def solved(self, light: np.ndarray, directions, mean: float, again: Start | None = None, **options) -> Start:
        """The surface of this mean height that sends the light to the picture."""
        scene = self.scene
        if not light.all() and (scene.before or not scene.source.distant):
            options["darkest"] = DARKEST
        view = self.view(mean)
        target, half, centre = (
            (self.target, scene.screen.half_size, scene.screen.shift) if view is None else view.picture(self.target)
        )
        return refracting_surface(
            light,
            target,
            scene.lens.half_size,
            half,
            scene.lens.effective_index,
            scene.screen.z,
            mean,
            directions,
            centre=centre,
            view=view,
            start=None if again is None else again.transport.potential,
            **options,
        )

    def sharper(self, found: Start, times: int) -> tuple[_Grid, np.ndarray]:
        """Corners of cells so many times finer, and heights there of a surface solved on these, its creases as much sharper."""
        scene, mean = self.scene, float(found.heights.mean())
        fine = _Grid(scene, self.target, *(corners(times * (len(c) - 1), c[-1]) for c in (self.x, self.y)))
        _, directions = incident(scene, fine.x, fine.y, self.scaled(found.heights, fine))
        view = self.view(mean)
        centre = scene.screen.shift if view is None else view.picture(self.target)[2]
        index = scene.lens.effective_index
        z = finer(found, times, scene.lens.half_size, index, scene.screen.z, directions, centre=centre, view=view)
        return fine, z

    def view(self, mean: float) -> Seen | None:
        """The screen as a surface of this mean height sees it, None of an upright one, which lies in its plane."""
        screen = self.scene.screen
        if self.scene.behind:
            return Relayed(self.scene, mean)
        return None if screen.upright else View(screen, mean, -1.0 if self.scene.lens.mirror else 1.0)

    def above(self, z: np.ndarray) -> np.ndarray:
        """Part of each cell's corners where the surface is not cut off."""
        return _mean((z > self.floor).astype(float))

    def kept(self, z: np.ndarray) -> float:
        """Part of the light on the lens that a surface, cut off at the least thickness, sends to the screen."""
        scene, lens, screen = self.scene, self.scene.lens, self.scene.screen
        z = np.maximum(z, self.floor)
        on_lens = incident(scene, self.x, self.y, np.full_like(z, lens.z_in))[0].sum()
        light, directions = incident(scene, self.x, self.y, z)
        surface = RectBivariateSpline(self.x, self.y, z)
        at = np.broadcast_arrays(self.x[:, None], self.y[None, :])
        view = self.view(float(z.mean()))
        u, v, part = thrown(
            *at,
            z,
            surface(self.x, self.y, dx=1),
            surface(self.x, self.y, dy=1),
            directions,
            lens.effective_index,
            screen.z,
            "none" if lens.fresnel == "none" else "exact",
            view,
        )
        u, v = (u - screen.shift[0], v - screen.shift[1]) if view is None else view.own(u, v)
        on = (np.abs(u) <= screen.half_size[0]) & (np.abs(v) <= screen.half_size[1])
        return float((light * self.above(z) * _mean(np.where(on, part, 0.0))).sum() / on_lens) if on_lens > 0 else 0.0

    def cut(self, z: np.ndarray, middle: float, passes: int) -> _Cut:
        """The surface of this height in its middle that sends what light it can to the picture, cut off at the least thickness.

        Args:
            z: heights to begin from.

        Raises:
            InputError: no light can be refracted to the picture.
        """
        reached, again = 1.0, None
        for _ in range(passes):
            z = np.maximum(z + middle - _middle(z), self.floor)
            light, directions = incident(self.scene, self.x, self.y, z)
            for left in range(RETRIES, -1, -1):
                lit = light * self.above(z) * reached
                if not lit.max() > 0:
                    raise InputError(UNREACHED)
                try:
                    again = self.solved(lit, directions, float(z.mean()), again)
                    break
                except OutOfReach as error:
                    if not left:
                        raise
                    reached = reached * _mean((~error.where).astype(float))
            z = again.heights
        z = z + middle - _middle(z)
        return _Cut(np.maximum(z, self.floor), middle, max(0.0, self.floor - float(z.min())))


@dataclass(frozen=True, eq=False)
class _Cut:
    """Heights of a cut surface, that of its middle, and how far it would reach below the cut, mm."""

    z: np.ndarray
    middle: float
    short: float


def first_surface(scene: Scene, target: np.ndarray, field: HeightField, cells: int = CELLS, fixed: bool = False) -> InitialSurface:
    """A lens that throws the picture, from the light of the source's centre.

    Args:
        scene: source, lens and screen.
        target: (n_x, n_y) irradiance on its screen.
        field: spline spaces of the heights.
        cells: source cells along the lens' longer side; more than SOLVED make creases sharper, of light from afar.
        fixed: the thickness is the user's own, and none other is tried.

    Raises:
        InputError: the picture is out of reach of refraction.
    """
    times, options = _times(cells, target) if scene.source.distant else 1, {}
    cells = min(cells, SOLVED * times)
    if times > 1:
        options = {"tolerance": EXACT, "most": STEPS}
    grid, lens = _Grid.of(scene, target, cells // times), scene.lens
    z = grid.offset
    if scene.source.distant or lens.mirror or scene.elements:
        found = None
        for _ in range(1 if scene.source.distant and not scene.before else PASSES):
            found = grid.solved(*incident(scene, grid.x, grid.y, z), float(grid.offset.mean()), found, **options)
            z = found.heights
        if times > 1:
            grid, z = grid.sharper(found, times)
        return InitialSurface(net_of(grid.x, grid.y, z, field))
    few = _Grid.of(scene, target, min(cells, FEW_CELLS))
    best = _best(few, lens.offset.thickness, fixed)
    found = grid.cut(few.scaled(best.z, grid), best.middle, PASSES - 1)
    net = net_of(grid.x, grid.y, found.z, field)
    return InitialSurface(net.clamp_min(grid.floor), best.middle)  # a spline through a kink undershoots


def _times(cells: int, target: np.ndarray) -> int:
    """How many times finer than those that transport is solved on so many cells are, 1 where it is solved on these, or on SOLVED.

    A map on finer cells sends the light of a site to a point, so that the sites have to be finer than the bright pixels.
    """
    needed = max(COARSE, math.sqrt(SITES * np.count_nonzero(target)))
    if cells <= SOLVED or needed > SOLVED:
        return 1
    whole = max(t for t in range(1, cells) if cells % t == 0 and cells >= NEARLY * needed * t)
    return whole if cells <= SOLVED * whole else -(-cells // COARSE)


def _best(grid: _Grid, middle: float, fixed: bool) -> _Cut:
    """The cut surface that keeps most light: of this height in its middle, or of others where it is not fixed."""
    tried: list[tuple[float, _Cut]] = []

    def attempt(middle: float) -> _Cut | None:
        try:
            found = grid.cut(grid.offset, middle, PASSES)
        except InputError as error:
            problems.append(error)
            return None
        tried.append((grid.kept(found.z), found))
        return found

    problems: list[InputError] = []
    found = attempt(middle)
    if not fixed:
        if found is not None and found.short:
            attempt(middle + found.short)
        if max((kept for kept, _ in tried), default=0.0) < WELL:
            low = grid.scene.lens.z_in
            for part in TRIED:
                attempt(low + part * (middle - low))
    if not any(kept > 0 for kept, _ in tried):
        raise problems[0] if problems else InputError(UNREACHED)
    return max(tried, key=lambda t: t[0])[1]


def net_of(x: np.ndarray, y: np.ndarray, z: np.ndarray, field: HeightField) -> Tensor:
    """Control heights (n, m) of the surface with these heights at corners x (k,), y (l,): z (k, l), mm."""
    spline = RectBivariateSpline(x, y, z)
    values = torch.from_numpy(spline(*(c.numpy() for c in field.control_xy())))
    net = field.interpolated(values)
    # Through points, a spline of high degree over knots that repeat overshoots; one that has them as its net never does.
    return net if float(net.max() - net.min()) <= OVERSHOOT * float(values.max() - values.min()) else values


def sphere_net(element: Component, side: str, field: HeightField) -> Tensor:
    """Control heights (n, m) of the sphere that a side of another lens or mirror is, on the exit's spline spaces over its aperture,
    from its vertex' plane, mm."""
    x, y = (corners(2 * n, h) for n, h in zip(field.shape, element.half_size, strict=True))
    radius = element.radius[SIDES.index(side)]
    points = (torch.from_numpy(c) for c in np.broadcast_arrays(x[:, None], y[None, :]))
    z = Sphere(radius, element.reach).at(None, *points, orders=((0, 0),))[0] if np.isfinite(radius) else torch.zeros(len(x), len(y))
    return net_of(x, y, z.numpy(), replace(field, half_size=element.half_size))


def room_of(element: Component, lens: Lens) -> float:
    """How far a design may take a surface of another lens or mirror from its sphere, mm: as far as the exit from its own, and never
    through the glass."""
    thinnest = element.thickness + min(0.0, element.sag("back") - element.sag("front")) if not element.mirror else np.inf
    return min(lens.height_range[1], GLASS * thinnest)


def _mean(v: np.ndarray) -> np.ndarray:
    """Of the four corners of each cell."""
    return 0.25 * (v[1:, 1:] + v[:-1, 1:] + v[1:, :-1] + v[:-1, :-1])


def _middle(z: np.ndarray) -> float:
    """Height in the middle of the lens."""
    n, m = z.shape
    return float(z[(n - 1) // 2 : n // 2 + 1, (m - 1) // 2 : m // 2 + 1].mean())
