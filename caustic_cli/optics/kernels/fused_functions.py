"""The fused kernels as differentiable torch functions, in reverse mode by the hand-written adjoint.

The surface at the rays (at a tensor product of points, at scattered points, or at intersections) is the input of one kernel that
refracts, transfers to the screen and splats.  Everything is float64, whatever the precision of the plain-torch reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import blocks, fused, pixels, random_points
from caustic_cli.optics.kernels.arguments import Exit, ParallelLight, Point, RowsOfRays, RowsOfSurface, ScreenFrame, Splat
from caustic_cli.optics.kernels.banded import AlongV
from caustic_cli.optics.kernels.fresnel import FRESNEL
from caustic_cli.optics.kernels.grid import rows_at
from caustic_cli.optics.kernels.ray_intersections import RayIntersections
from caustic_cli.optics.kernels.rows import WIDE, room
from caustic_cli.optics.kernels.splat import trimmed
from caustic_cli.optics.kernels.stage import KernelStage
from caustic_cli.optics.kernels.surface import FusedSurface, scattered_surface
from caustic_cli.optics.kernels.threads import ALL
from caustic_cli.optics.kernels.transfer import TargetPlane
from caustic_cli.optics.receiver import Receiver, dot
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.scene import Screen

if TYPE_CHECKING:
    from caustic_cli.optics.beam import Beam
    from caustic_cli.optics.pencil import Pencil

#: A source point, or parallel light at an angle to z; neither for other rays.
Light = tuple[Point | None, ParallelLight | None]


class _Workspace:
    """Arrays that the kernels overwrite, reused from call to call."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}

    def __call__(self, name: str, *shape: int) -> np.ndarray:
        array = self.arrays.get(name)
        if array is None or array.shape != shape:
            array = self.arrays[name] = np.zeros(shape)
        return array


class PlaneKernel:
    """The fused form of a height field at the rays of a plane wave, `interface.interact`, landing and `reconstruction.splat`.

    Args:
        spaces, half_size: of the height field; half widths in mm.
        u, v: the rays' parameters; with `tensor` all pairs of them, else pairwise.
        power: of each ray below the surface, scalar or of the rays' shape.
        origin: of the coordinates x and y, mm.
        like: the kernel of another sample, whose basis values along v serve again where v is the same tensor, and whose
            workspace serves both.
    """

    def __init__(
        self,
        spaces,
        half_size,
        u: Tensor,
        v: Tensor,
        tensor: bool,
        power: Tensor,
        like: PlaneKernel | None = None,
        origin: tuple[float, float] = (0.0, 0.0),
    ):
        (su, sv), (rx, ry) = spaces, half_size
        self.tensor, self.v = tensor, v
        self.workspace: _Workspace = _Workspace() if like is None else like.workspace
        if tensor:
            self.rows = rows_at(su, u, rx)
            self.along_v: AlongV = like.along_v if like is not None and like.v is v else AlongV(sv, v, 1.0 / (2.0 * ry))
            x, y, shape = u[:, None], v[None, :], (len(u), len(v))
        else:
            shape = _layout(len(u))
            short = shape[0] * shape[1] - len(u)  # rays without power fill the last row
            if short:
                power = torch.nn.functional.pad(power.expand(len(u)), (0, short))
                u, v = (torch.nn.functional.pad(t, (0, short), value=0.5) for t in (u, v))
            self.rows = np.arange(shape[0]), np.ones((shape[0], 1)), np.ones((shape[0], 1))
            self.points = (u.numpy(), v.numpy())
            self.surface: FusedSurface = FusedSurface(spaces, half_size) if like is None else like.surface
            x, y, power = u.view(shape), v.view(shape), power.view(shape) if power.ndim else power
        self.shape = shape
        coordinates = ((2.0 * x - 1.0) * rx - origin[0], (2.0 * y - 1.0) * ry - origin[1], power)
        own_x, own_y, flux = (_strided(np.broadcast_to(t.double().numpy(), shape)) for t in coordinates)
        self.rays = RowsOfRays(own_x, own_y, _NONE, _NONE, flux)

    def __call__(self, sag: Tensor, eta: float, fresnel: str, height: float, screen: Screen, filter: Filter):
        """Control heights (n, m) float64 relative to some plane, mm, and the screen's height above it, mm: see `_splat`."""
        return self._splatted(sag, (eta, fresnel), (0.0, height), screen, filter)

    def _splatted(
        self, sag: Tensor, interface: tuple[float, str], ends: tuple[float, float], screen: Screen, filter: Filter, *light
    ):
        """`_splat` of the surface at the rays; light: its last arguments."""
        nets: Sequence[Tensor]
        if self.tensor:
            net, net_y = self.along_v(sag)  # (n, m_v)
            nets = (net, net, net_y)
        else:
            nets = [t.view(self.shape) for t in scattered_surface(self.surface, sag, *self.points)]
        return _splat(nets, self.rows, not self.tensor, self.rays, interface, ends, screen, filter, self.workspace, *light)


class BeamKernel(PlaneKernel):
    """The same for parallel rays at an angle to z, and a plane screen of any orientation: see `optics.beam`.

    Args:
        beam: the rays; entrance: its n and kind of Fresnel losses.
    """

    def __init__(self, spaces, half_size, beam: Beam, entrance: tuple[float, str], like: BeamKernel | None = None):
        sample = beam.sample
        super().__init__(spaces, half_size, sample.u, sample.v, sample.tensor, beam.areas, like)
        self.z_in, self.k, self.half_size = beam.z_in, beam.inside(entrance[0]), beam.aperture.half_size
        self.round, self.power = bool(beam.aperture.round), beam.irradiance * beam.transmittance(*entrance)

    def onto(self, sag: Tensor, eta: float, fresnel: str, reference: float, receiver: Receiver, filter: Filter):
        """Control heights (n, m) float64 relative to `reference`, mm: see `_splat`."""
        light, frame = (None, self._light(receiver, reference)), ScreenFrame.of(receiver.screen, receiver.low)
        ends = self.z_in - reference, 0.0
        return self._splatted(sag, (eta, fresnel), ends, receiver.screen, filter, light, frame)

    def _light(self, receiver: Receiver, reference: float) -> ParallelLight:
        (x, y, z), (rx, ry) = receiver.middle, self.half_size
        plane = TargetPlane.of((x, y, z - reference), receiver.axes, 1.0 if dot(receiver.axis, receiver.axes[2]) > 0 else -1.0)
        return ParallelLight(*self.k, self.power, 1.0 / rx, 1.0 / ry, self.round, plane)


class PencilKernel(PlaneKernel):
    """The same for the rays of a source point through a tensor product of points: see `optics.pencil`.

    Args:
        pencil: the rays; index: n of the entrance; emission: J, by `pencil.polynomial`, and the largest s.
    """

    def __init__(
        self, spaces, half_size, pencil: Pencil, index: float, emission: tuple[np.ndarray, float], like: PencilKernel | None = None
    ):
        sample, self.place = pencil.sample, pencil.position[:2]
        super().__init__(spaces, half_size, sample.u, sample.v, True, pencil.areas, like, self.place)
        self.pencil, self.index, (self.coefficients, most) = pencil, index, emission
        self.scale = 2.0 / most

    def __call__(self, sag: Tensor, eta: float, fresnel: str, reference: float, screen: Screen, filter: Filter):
        """Control heights (n, m) float64 relative to `reference`, mm: see `_splat`."""
        z_in = self.pencil.z_in
        steps = self.pencil.newton_steps(self.index, float(sag.detach().max()) + reference - z_in)
        point = Point(float(self.pencil.distance), float(self.index), steps, self.scale, self.coefficients)
        frame = ScreenFrame.of(screen, (screen.low[0] - self.place[0], screen.low[1] - self.place[1]))
        ends = z_in - reference, screen.z - reference
        return self._splatted(sag, (eta, fresnel), ends, screen, filter, (point, None), frame)


class RayKernel:
    """The fused form of `intersection`, `interface.interact`, landing and `reconstruction.splat` for rays of any direction.

    Args:
        spaces, half_size: of the height field; half widths in mm.
        origin, direction, power: of the rays below the surface, whose lines may start outside the aperture; z of all origins is
            one number, mm.
        radius: of a circular aperture, mm, or None.
        like: the kernel of another bundle through the same field, whose workspace serves both.
    """

    def __init__(self, spaces, half_size, origin, direction, power: Tensor, radius: float | None, like: RayKernel | None = None):
        count = len(power)
        self.surface: FusedSurface = FusedSurface(spaces, half_size) if like is None else like.surface
        self.workspace: _Workspace = _Workspace() if like is None else like.workspace
        self.shape = _layout(count)
        short = self.shape[0] * self.shape[1] - count
        # The image is a sum, so the rays come in the order in which their hits are found; without power they fill the last row.
        order = torch.from_numpy(self.surface.order(*origin[:2])[0]).long()
        order = torch.cat([order, order[-1:].expand(short)])
        x, y, *direction = (t.double()[order] for t in (*origin[:2], *direction))
        power = power.double()[order]
        power[count:] = 0.0
        self.hits, self.z = RayIntersections(self.surface, (x, y, origin[2]), direction, radius, enter_first=True), origin[2]
        self.rays = RowsOfRays(*(_strided(t.view(self.shape).numpy()) for t in (x, y, *direction[:2], power)))
        self.rows = np.arange(self.shape[0]), *np.ones((2, self.shape[0], 1))

    def __call__(self, heights: Tensor, eta: float, fresnel: str, reference: float, screen: Screen, filter: Filter):
        """Control heights (n, m) mm float64; `reference` is where the screen's height is counted from, mm: see `_splat`."""
        reach, *slopes = self.hits(heights)
        reach = torch.where(reach >= 0.0, reach + torch.from_numpy(self.hits.way), reach)
        nets = [t.view(self.shape) for t in (reach, *slopes)]
        heights_of = self.z - reference, screen.z - reference
        return _splat(nets, self.rows, True, self.rays, (eta, fresnel), heights_of, screen, filter, self.workspace)


def _splat(
    nets,
    rows,
    apart: bool,
    rays: RowsOfRays,
    interface: tuple[float, str],
    ends: tuple[float, float],
    screen: Screen,
    filter: Filter,
    workspace: _Workspace,
    light: Light = (None, None),
    frame: ScreenFrame | None = None,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Call the kernel.  interface: n_in / n_out and the kind of Fresnel losses; ends: heights of oblique rays' origins
    and of the screen, mm; light: of rays from a point, or parallel ones; frame: of the pixels, if not that of an upright screen.

    Returns:
        image (n_x, n_y) and the power behind the lens (), float64, differentiable; losses by name.
    """
    arguments = _arguments(rays, interface, ends, frame or ScreenFrame.of(screen), filter, light)
    padded, leaving, ledger = _IMAGE((rows, apart, arguments, workspace), *nets)
    image, beside = trimmed(padded, screen, filter)
    lost = {"missed_surface": ledger[fused.MISSED]} if rays.along_x is not _NONE else {}
    lost |= {"fresnel": ledger[fused.LOST_BY_FRESNEL], "total_internal_reflection": ledger[fused.REFLECTED]}
    return image, leaving, lost | {"off_screen": ledger[fused.OFF_SCREEN] + beside.detach()}


def _arguments(
    rays: RowsOfRays,
    interface: tuple[float, str],
    ends: tuple[float, float],
    frame: ScreenFrame,
    filter: Filter,
    light: Light = (None, None),
) -> tuple:
    """The arguments of the `fused` kernels after the surface."""
    eta, fresnel = interface
    exit_ = Exit(float(eta), FRESNEL[fresnel], *map(float, ends))
    return rays, exit_, frame, Splat.of(filter), None if rays.along_x is _NONE else True, *light


def _layout(count: int) -> tuple[int, int]:
    """Rows and columns for so many scattered rays: at least two rows, since a single one is always contiguous, see `_strided`."""
    rows = max(2, -(-count // WIDE))
    return rows, -(-count // rows)


def _strided(array: np.ndarray) -> np.ndarray:
    """The same values as a read-only, non-contiguous array: tensor-product and scattered rays then share one compiled kernel."""
    if array.flags.c_contiguous:
        wide = np.empty((array.shape[0], array.shape[1] + 1), array.dtype)
        wide[:, :-1] = array
        array = np.broadcast_to(wide[:, :-1], array.shape)
    return array


#: Placeholder for directions where all rays are parallel to z.
_NONE = _strided(np.zeros((2, 2)))


def compile_surface() -> None:
    """Compile the evaluation of the surface at rays of a plane wave, and its adjoint."""
    space, at = SplineSpace.uniform(4, 3), torch.linspace(0.0, 1.0, WIDE, dtype=torch.float64)
    heights = torch.zeros(4, 4, dtype=torch.float64, requires_grad=True)
    net, slope = AlongV(space, at, 0.5)(heights)
    found = scattered_surface(FusedSurface((space, space), (1.0, 1.0)), heights, at.numpy(), at.numpy())
    torch.stack([t.sum() for t in (net, slope, *found)]).sum().backward()


def compile_image() -> None:
    """Compile the fused refraction, transfer and splat, and the points of scattered rays."""
    _IMAGE(*_example())
    scattered_points((0, 0), (0, 0), 0, 1, 1, 1, True)


def compile_adjoint() -> None:
    """Compile the adjoint of the kernel of `compile_image`."""
    parameters, *nets = _example()
    _, _, frame, splat, *_ = parameters[2]
    image = np.zeros(splat.padded(frame))
    _adjoint(parameters, [t.numpy() for t in nets], (), (image, 1.0), (True, True, True))


def _example() -> tuple:
    """Arguments of `_IMAGE` for a few rays."""
    space, at = SplineSpace.uniform(4, 3), torch.linspace(0.0, 1.0, 2, dtype=torch.float64)
    kernel = PlaneKernel((space, space), (1.0, 1.0), at, at, True, torch.tensor(0.25, dtype=torch.float64))
    net, screen = torch.zeros(4, 2, dtype=torch.float64), Screen((10.0, 10.0), 10.0, (4, 4))
    arguments = _arguments(kernel.rays, (1.5, "exact"), (0.0, 10.0), ScreenFrame.of(screen), Filter("cosine", (3, 3)))
    return (kernel.rows, False, arguments, kernel.workspace), net, net, net


def _forward(parameters: tuple, *nets):
    """Padded image, power behind the lens (), ledger, from nets (n, b)."""
    rows, _, arguments, workspace = parameters
    _, _, frame, splat, *_ = arguments
    images = workspace("images", blocks(), *splat.padded(frame))
    ledgers = np.empty((len(images), fused.COLUMNS))
    fused.forward(ALL, images, ledgers, workspace("scratch", *room(splat, len(images))), RowsOfSurface(*rows, *nets), *arguments)
    ledger = ledgers.sum(0)
    return pixels.total(images), ledger[fused.LEAVING], ledger


def _adjoint(parameters: tuple, nets, _kept, by, _wanted):
    rows, apart, arguments, workspace = parameters
    count, shape = blocks(), nets[0].shape
    sums = np.empty((3, 1, *shape)) if apart else workspace("nets", 3, count, *shape)
    scratch = workspace("scratch", *room(arguments[3], count))
    fused.backward(ALL, by[0], float(by[1]), apart, sums, scratch, RowsOfSurface(*rows, *nets), *arguments)
    return [s[0] if apart else pixels.total(s) for s in sums]


_IMAGE = KernelStage(_forward, _adjoint, 2)


def scattered_points(keys, salts, start: int, stop: int, nu: int, nv: int, stratified: bool) -> tuple[Tensor, Tensor]:
    """The points u, v of rays start..stop of a stratified or uniform `Sampler`: (stop - start,) float64 each."""
    blocks()
    keys, salts = (tuple(np.uint64(k) for k in pair) for pair in (keys, salts))
    u, v = (torch.from_numpy(a) for a in random_points.scatter(keys, salts, start, stop, nu, nv, stratified))
    return u, v
