"""A flat blank whose index, not whose surface, throws the picture (thesis 7.2.1).

Notation
    x, T        a point of the blank, and where its light shall land: T = grad phi of the optimal transport
    t, D        thickness of the blank, and the way from its exit to the screen, mm
    n, n_0      index, and its middle

Light along the axis through a thin blank leaves with the sine t grad n, so that n = n_0 + (phi - |x|^2 / 2) / (D t) to first order
in all angles.  Within it has moved already, by half of t / n times that: D is counted from there.  The sines needed are not quite
a gradient; what is nearest to them in the least-squares sense is the start, the same at every z.

From there L-BFGS goes down on the control values of a B-spline volume, the image coming from rays that bend.  They are kept within
the range of a material by tanh, in the coordinates of the inverse Laplacian of each layer (`parametrisation`), since a picture
responds to the Laplacian of the index as it does to that of a surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import incident
from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.inverse.losses import NoLight
from caustic_cli.inverse.objective import Evaluation, Objective
from caustic_cli.inverse.parametrisation import FreeHeights
from caustic_cli.inverse.surface_from_map import integrate
from caustic_cli.inverse.transport import corners, solve
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.gradient.fields import SplineIndex
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces import HeightField, Plane
from caustic_cli.optics.system import ENTRANCE, EXIT, Element, Medium, System
from caustic_cli.optics.trace import Tracer, index_name
from caustic_cli.scene import Aperture, Scene

#: Repeats of the start's slopes, each with the sines of the last.
SINES = 3
#: Rays a pixel of the refinement; pixels of the render to one of the screen, along each axis, where so many rays fall there.
RAYS_A_PIXEL, OVERSAMPLE = 16, 2
#: Part of the screen's pixels around it on which stray light is still seen.
APRON = 0.04
#: Part of the range of the index from its ends that a start is kept within.
INSIDE = 0.01


@dataclass(frozen=True, eq=False)
class Blank:
    """A designed blank.

    index: its field; start: what the design began from; history: loss, in units of eq. 5.2.1, and part of the light on the screen,
    after each iteration.
    """

    index: SplineIndex
    start: SplineIndex
    history: tuple[tuple[float, float], ...]


def blank_system(scene: Scene, index: SplineIndex) -> System:
    """Flat entrance, flat exit at the lens' thickness, and the index between them."""
    lens, aperture = scene.lens, Aperture(scene.lens.half_size, scene.lens.round)
    inside = Medium(lens.index, lens.absorption, lens.glass, index)
    return System(
        (scene.source,),
        (
            Element(ENTRANCE, Plane(), aperture, behind=inside, pose=Pose((0.0, 0.0, lens.z_in)), fresnel=lens.fresnel),
            Element(EXIT, Plane(), aperture, pose=Pose((0.0, 0.0, lens.offset.thickness)), fresnel=lens.fresnel),
        ),
        (scene.screen,),
        scene.light,
        lit=scene.pupil,
    )


def design_blank(
    scene: Scene,
    target: np.ndarray,
    control: tuple[int, int],
    layers: int = 1,
    limits: tuple[float, float] | None = None,
    *,
    cells: int = 256,
    iterations: int = 25,
    rays: int | None = None,
    seed: int = 0,
    on_iteration: Callable[[int, float, float, Tensor | None], None] = lambda k, loss, on_screen, image: None,
    stop: Callable[[], bool] = lambda: False,
) -> Blank:
    """The index that throws a picture.

    Args:
        scene: a plane wave, the blank (size, z_in, thickness of the offset, index n_0, fresnel) and the screen.
        target: (n_x, n_y) irradiance on the screen's pixels.
        control: control values along x and y; layers: along z.
        limits: least and largest control value, n_0 less 0.05 and more unless given.
        cells: source cells of the transport along the longer side.
        iterations: of L-BFGS; rays: traced in each, None for RAYS_A_PIXEL a pixel; seed: of the rays.
        on_iteration: told the iteration, the loss, the part of the light on the screen and the image there.
        stop: asked before every iteration; True ends the design with what it has.

    Raises:
        InputError: other light than a plane wave, a mirror, or an index that the picture asks for and the limits exclude.
    """
    lens, screen = scene.lens, scene.screen
    low, high = limits or (lens.index - 0.05, lens.index + 0.05)
    if not scene.source.collimated:
        raise InputError("⟨lens.gradient⟩ free is designed for light of ⟨source.type⟩ plane")
    if lens.mirror or scene.colored:
        raise InputError("⟨lens.gradient⟩ free is designed for lenses, and for pictures without colours")
    if not 1.0 <= low < high <= 5.0:
        raise InputError(f"⟨lens.index_range⟩ must ascend within 1 to 5, got [{low:g}, {high:g}]")
    if not lens.offset.thickness > lens.z_in:
        raise InputError(f"⟨lens.thickness⟩ must lie behind the entrance at {lens.z_in:g} mm, got {lens.offset.thickness:g} mm")
    net = HeightField.of(replace(lens, control=control, degree=(3, 3), knots=None, gradient=None))
    layer = _start(scene, target, net, cells)
    layer = layer - 0.5 * float(layer.min() + layer.max()) + 0.5 * (low + high)
    spread, room = float(layer.max() - layer.min()), high - low
    if spread > (1.0 - 2.0 * INSIDE) * room:
        raise InputError(
            f"⟨lens.index_range⟩ spans {room:.3g}, and this picture requires an index that varies by {spread:.3g};"
            f" a thickness of {(lens.offset.thickness - lens.z_in) * 1.1 * spread / room:.3g} mm, or a smaller ⟨mag⟩, needs no more"
        )

    def volume(values: Tensor) -> SplineIndex:
        return SplineIndex(values, lens.half_size, lens.offset.thickness - lens.z_in)

    begun = volume(layer[:, :, None].expand(-1, -1, layers).contiguous())
    objective = _BlankObjective(scene, target, begun, rays or RAYS_A_PIXEL * math.prod(screen.resolution), seed)
    low_net, high_net = (torch.full(control, v, dtype=torch.float64) for v in (low, high))
    nets = [FreeHeights(low_net, high_net, layer, laplacian=True) for _ in range(layers)]
    seen: dict[float, Evaluation] = {}

    def controls(x: Tensor) -> Tensor:
        for one, y in zip(nets, x.view(layers, *control), strict=True):
            one.y.data = y.clone()
        return torch.stack([one() for one in nets], -1)

    def evaluate(x: Tensor) -> tuple[float, Tensor]:
        values = controls(x)
        try:
            found = objective.evaluate({objective.name: values.detach()})
        except NoLight:
            if search.f is None:
                raise
            return math.inf, torch.zeros_like(x)  # a step too far: the line search turns back
        seen[found.loss] = found
        by = torch.autograd.grad(values, [one.y for one in nets], found.gradients[objective.name])
        return found.loss, torch.stack(by).reshape(-1)

    search = LBFGS(evaluate, torch.zeros(layers * math.prod(control), dtype=torch.float64))
    history: list[tuple[float, float]] = []
    for k in range(iterations):
        seen.clear()
        if stop() or not search.step():
            break
        assert search.f is not None
        found = seen[search.f]
        history.append((search.f, found.on_screen))
        on_iteration(k + 1, search.f, found.on_screen, found.image)
    with torch.no_grad():
        return Blank(volume(controls(search.x)), begun, tuple(history))


class _BlankObjective(Objective):
    """The loss as a function of the control values of the index, {name: (n, m, k)}."""

    def __init__(self, scene: Scene, target: np.ndarray, index: SplineIndex, rays: int, seed: int):
        self.system = blank_system(scene, index)
        self.name = index_name(self.system.elements[0])
        flat = HeightField.of(replace(scene.lens, control=(4, 4), degree=(3, 3), knots=None))
        apron = math.ceil(APRON * max(scene.screen.resolution))
        sampler = rays_of(scene, "grid", rays, stream(seed, "gradient blank"))
        super().__init__(
            scene,
            flat,
            sampler,
            Filter("cosine", (3, 3)),
            torch.from_numpy(np.ascontiguousarray(target, dtype=np.float64)),
            "rms-light",
            apron=apron,
            oversample=OVERSAMPLE,
            dtype=torch.float64,
        )

    def _tracers(self) -> Iterator[tuple[int, Tracer]]:
        """Chunks of rays through the blank."""
        traced = None
        for sample in self.samplers[0].chunks(self.chunk):
            traced = Tracer(self.system, sample, torch.float64, like=traced)
            yield 0, traced


def _start(scene: Scene, target: np.ndarray, net: HeightField, cells: int) -> Tensor:
    """Control values (n, m) of the index that sends thin light to the picture; its mean is any."""
    lens, screen = scene.lens, scene.screen
    (a, b), t = lens.half_size, lens.offset.thickness - lens.z_in
    n, m = (max(4, round(cells * r / max(a, b))) for r in (a, b))
    x, y = corners(n, a), corners(m, b)
    light, _ = incident(scene, x, y, np.full((n + 1, m + 1), lens.offset.thickness))
    map_ = solve(light, target, (a, b), screen.half_size)
    away = map_.x + screen.shift[0] - x[:, None], map_.y + screen.shift[1] - y[None, :]
    throw = np.full_like(away[0], screen.z - lens.offset.thickness + 0.5 * t / lens.index)
    for _ in range(SINES):
        sines = [c / np.sqrt(throw**2 + away[0] ** 2 + away[1] ** 2) for c in away]
        # within, light moves by t / (2 n) times its sine; behind, by the throw times its tangent
        tangents = [s / np.sqrt(1.0 - sines[0] ** 2 - sines[1] ** 2) for s in sines]
        behind = screen.z - lens.offset.thickness
        rest = [c - 0.5 * t / lens.index * s for c, s in zip(away, sines, strict=True)]
        throw = np.where(np.hypot(*tangents) > 1e-12, behind * np.hypot(*away) / np.maximum(np.hypot(*rest), 1e-300), throw)
    step = float(x[1] - x[0]), float(y[1] - y[0])
    values = integrate(sines[0] / t, sines[1] / t, step)
    spline = RectBivariateSpline(x, y, values)
    return net.interpolated(torch.from_numpy(spline(*(c.numpy() for c in net.control_xy()))))
