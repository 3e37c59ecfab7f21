"""Design of a flat gradient-index (GRIN) plate for a picture (thesis 7.2.1).

Notation
    x, T        a point of the plate, and the target point of its light: T = grad phi of the optimal transport
    t, D        thickness of the plate, and the distance from its exit to the screen, mm
    n, n_0      index, and the middle of its range

Axial light leaves a thin plate with the sine t grad n, so that n = n_0 + (phi - |x|^2 / 2) / (D t) to first order in all angles.
The displacement inside the plate, half of t / n times the sine, is added to D.  The required sines are not exactly integrable;
their least-squares potential, independent of z, is the initial index.

L-BFGS then optimises the control values of a B-spline volume, with the image from curved rays.  The values are kept within the
range of the material by tanh, in the coordinates of the inverse Laplacian of each layer (`parametrisation`), since the image
depends on the Laplacian of the index as it does on that of a surface.
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
from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.incidence import incident
from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.inverse.losses import NoLight
from caustic_cli.inverse.objective import Evaluation, Objective
from caustic_cli.inverse.parametrisation import FreeHeights
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.surface_from_map import integrate
from caustic_cli.inverse.transport import corners, solve
from caustic_cli.optics import ranks
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.gradient.fields import SplineIndex
from caustic_cli.optics.gradient.medium import GradientMedium, index_name
from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces import HeightField, Plane
from caustic_cli.optics.system import ENTRANCE, EXIT, Element, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability

INDEX_DESIGN = Capability(
    "design of a gradient index",
    {
        "far field": "⟨lens.gradient⟩ free is designed for a screen at a distance, not for ⟨+throw⟩ inf",
        "light not parallel": "⟨lens.gradient⟩ free is designed for light of ⟨source.type⟩ plane",
        **dict.fromkeys(("other elements", "folded axis"), "⟨lens.gradient⟩ free is designed for light that goes straight on"),
        "mirror": "⟨lens.gradient⟩ free is designed for lenses: no light enters a mirror",
        "coloured picture": "⟨lens.gradient⟩ free is designed for pictures without colours",
    },
    {"mirror": "no light enters it", "other elements": "index and rays are solved for along the axis"},
)
#: Fixed-point iterations of the initial sines.
SINES = 3
#: Rays per pixel of the optimisation; oversampling of the render along each axis.
RAYS_A_PIXEL, OVERSAMPLE = 16, 2
#: Width of the apron around the screen, in parts of its pixels.
APRON = 0.04
#: Relative margin of the initial index to the ends of its range.
INSIDE = 0.01
#: Called with the iteration, the loss, the fraction of the light on the screen and the image there.
OnIteration = Callable[[int, float, float, Tensor | None], None]


@dataclass(frozen=True, eq=False)
class GradientIndexDesign:
    """A designed gradient-index plate."""

    #: The designed field.
    index: SplineIndex
    #: The initial one.
    start: SplineIndex
    #: Loss, in units of eq. 5.2.1, and fraction of the light on the screen after each iteration.
    history: tuple[tuple[float, float], ...]


def plate_system(scene: Scene, index: SplineIndex, exit: HeightField | None = None) -> System:
    """System of a flat entrance, an exit, and the index field between them; exit: its spline spaces, None for a flat one at the
    thickness of the lens."""
    lens, aperture = scene.lens, scene.lens.opening
    inside = GradientMedium(lens.index, lens.absorption, lens.glass, gradient=index)
    behind = Pose((0.0, 0.0, lens.offset.thickness)) if exit is None else Pose()
    return System(
        (scene.source,),
        (
            Element(ENTRANCE, Plane(), aperture, behind=inside, pose=Pose((0.0, 0.0, lens.z_in)), fresnel=lens.fresnel),
            Element(EXIT, exit or Plane(), aperture, pose=behind, fresnel=lens.fresnel),
        ),
        (scene.screen,),
        scene.light,
        lit=scene.pupil,
    )


def design_gradient_index(
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
    begin: np.ndarray | None = None,
    on_iteration: OnIteration = lambda k, loss, on_screen, image: None,
    stop: Callable[[], bool] = lambda: False,
) -> GradientIndexDesign:
    """Design the index field for a picture.

    Args:
        scene: a plane wave, the plate (size, z_in, thickness of the offset, index n_0, fresnel) and the screen.
        target: (n_x, n_y) irradiance on the screen's pixels.
        control: control values along x and y; layers: along z.
        limits: least and largest control value; n_0 - 0.05 and n_0 + 0.05 unless given.
        cells: source cells of the transport along the longer side.
        iterations: of L-BFGS; rays: traced in each, None for RAYS_A_PIXEL per pixel; seed: of the rays.
        begin: initial control values (n, m, layers), such as those of an earlier design; from optimal transport unless given.
        on_iteration: called with the iteration, the loss, the fraction of the light on the screen and the image there.
        stop: called before every iteration; True ends the design.

    Raises:
        InputError: a source other than a plane wave, a mirror, or a range of index that is too small for the picture.
    """
    lens = scene.lens
    low, high = limits or (lens.index - 0.05, lens.index + 0.05)
    refuse_index_design(scene, (low, high))
    values = torch.from_numpy(begin) if begin is not None else _first_layer(scene, target, control, (low, high), cells)

    initial = volume(scene, values.reshape(*control, -1).expand(-1, -1, layers).contiguous())
    objective = IndexObjective(scene, target, initial, rays or RAYS_A_PIXEL * math.prod(scene.screen.resolution), seed)
    loss = _LossOfLayers(objective, initial.coefficients, (low, high))
    search = LBFGS(loss, torch.zeros(layers * math.prod(control), dtype=torch.float64))
    history: list[tuple[float, float]] = []

    def done(k: int, value: float, on_screen: float, image: Tensor | None) -> None:
        history.append((value, on_screen))
        on_iteration(k, value, on_screen, image)

    iterate(search, loss.evaluations, iterations, done, stop)
    with torch.no_grad():
        return GradientIndexDesign(volume(scene, loss.values(search.x)), initial, tuple(history))


def iterate(
    search: LBFGS, evaluations: dict[float, Evaluation], iterations: int, on_iteration: OnIteration, stop: Callable[[], bool]
) -> None:
    """At most so many iterations of a search, until it finds no progress or `stop` says so before one.

    evaluations: by their values, filled by the function that is minimised.
    """
    for k in range(iterations):
        evaluations.clear()
        if stop() or not search.step():
            break
        assert search.f is not None
        found = evaluations[search.f]
        on_iteration(k + 1, found.loss, found.on_screen, found.image)


class _LossOfLayers:
    """The loss as a function of unknowns x (layers n m,), which are 0 for the initial control values (n, m, layers)."""

    def __init__(self, objective: IndexObjective, initial: Tensor, limits: tuple[float, float]):
        layers = [layer.contiguous() for layer in initial.double().unbind(-1)]
        low, high = (torch.full_like(layers[0], limit) for limit in limits)
        self.objective, self.nets = objective, [FreeHeights(low, high, layer, laplacian=True) for layer in layers]
        #: By their loss.
        self.evaluations: dict[float, Evaluation] = {}
        self.is_lit = False

    def values(self, x: Tensor) -> Tensor:
        """The control values at x, within the limits."""
        for net, y in zip(self.nets, x.view(len(self.nets), *self.nets[0].y.shape), strict=True):
            net.y.data = y.clone()
        return torch.stack([net() for net in self.nets], -1)

    def __call__(self, x: Tensor) -> tuple[float, Tensor]:
        values, name = self.values(x), self.objective.name
        try:
            result = self.objective.evaluate({name: values.detach()})
        except NoLight:
            if not self.is_lit:
                raise
            return math.inf, torch.zeros_like(x)  # treated as too long by the line search
        self.evaluations[result.loss], self.is_lit = result, True
        by = pull_back([values], [net.y for net in self.nets], [result.gradients[name]])
        return result.loss, torch.stack(by).reshape(-1)


def volume(scene: Scene, values: Tensor) -> SplineIndex:
    """The field of control values (n, m, layers) over the aperture and the thickness of a lens."""
    return SplineIndex(values, scene.lens.half_size, scene.lens.offset.thickness - scene.lens.z_in)


def refuse_index_design(scene: Scene, limits: tuple[float, float]) -> None:
    """Refuse what has no such design; errors as of `design_gradient_index`."""
    lens, (low, high) = scene.lens, limits
    INDEX_DESIGN.refuse(scene)
    if not 1.0 <= low < high <= 5.0:
        raise InputError(f"⟨lens.index_range⟩ must ascend within 1 to 5, got [{low:g}, {high:g}]")
    if not lens.offset.thickness > lens.z_in:
        raise InputError(f"⟨lens.thickness⟩ must lie behind the entrance at {lens.z_in:g} mm, got {lens.offset.thickness:g} mm")


def _first_layer(scene: Scene, target: np.ndarray, control: tuple[int, int], limits: tuple[float, float], cells: int) -> Tensor:
    """Control values (n, m) of the initial index within its limits, independent of z; errors as of `design_gradient_index`."""
    lens, (low, high) = scene.lens, limits
    layer = transport_index(scene, target, control, cells) + 0.5 * (low + high)
    spread, room = float(layer.max() - layer.min()), high - low
    if spread > (1.0 - 2.0 * INSIDE) * room:
        raise InputError(
            f"⟨lens.index_range⟩ spans {room:.3g}, and this picture requires an index that varies by {spread:.3g};"
            f" a thickness of {(lens.offset.thickness - lens.z_in) * 1.1 * spread / room:.3g} mm, a smaller ⟨mag⟩, or"
            " ⟨+lens.with_surface⟩ needs no more"
        )
    return layer


class IndexObjective(Objective):
    """The loss as a function of the control values of the index, {name: (n, m, k)}; and of the heights of the exit, {EXIT: (n, m)}
    mm, where its spline spaces are given, within `limits`; how: the image is rendered, None as for a plate."""

    def __init__(
        self,
        scene: Scene,
        target: np.ndarray,
        index: SplineIndex,
        rays: int,
        seed: int,
        exit: HeightField | None = None,
        limits: Limits | None = None,
        how: LossImage | None = None,
    ):
        self.system = plate_system(scene, index, exit)
        self.name = index_name(self.system.elements[0])
        flat = HeightField.of(replace(scene.lens, control=(4, 4), degree=(3, 3), knots=None))
        apron = math.ceil(APRON * max(scene.screen.resolution))
        sampler = rays_of(scene, "grid", rays, stream(seed, "gradient blank"))
        super().__init__(
            scene,
            exit or flat,
            sampler,
            torch.from_numpy(np.ascontiguousarray(target, dtype=np.float64)),
            "rms-light",
            how or LossImage(apron=apron, oversample=OVERSAMPLE),
            limits,
            dtype=torch.float64,
        )

    def _tracers(self) -> Iterator[tuple[int, Tracer | None]]:
        """Tracers of the chunks of rays, None for those of other ranks."""
        traced = None
        for sample, own in zip(self.samplers[0].chunks(self.chunk), ranks.turns(self.share), strict=False):
            traced = Tracer(self.system, sample, torch.float64, like=traced) if own else traced
            yield 0, traced if own else None


def transport_index(scene: Scene, target: np.ndarray, control: tuple[int, int], cells: int) -> Tensor:
    """Control values (n, m) of an index that throws the picture, to first order in the thickness, less the middle of their range;
    cells: source cells of the transport along the longer side."""
    lens, screen = scene.lens, scene.screen
    net = HeightField.of(replace(lens, control=control, degree=(3, 3), knots=None, gradient=None))
    (a, b), t = lens.half_size, lens.offset.thickness - lens.z_in
    n, m = (max(4, round(cells * r / max(a, b))) for r in (a, b))
    x, y = corners(n, a), corners(m, b)
    light, _ = incident(scene, x, y, np.full((n + 1, m + 1), lens.offset.thickness))
    map_ = solve(light, target, (a, b), screen.half_size)
    away = map_.x + screen.shift[0] - x[:, None], map_.y + screen.shift[1] - y[None, :]
    throw = np.full_like(away[0], screen.z - lens.offset.thickness + 0.5 * t / lens.index)
    for _ in range(SINES):
        sines = [c / np.sqrt(throw**2 + away[0] ** 2 + away[1] ** 2) for c in away]
        # displacement inside: t / (2 n) times the sine; behind: the throw times the tangent
        tangents = [s / np.sqrt(1.0 - sines[0] ** 2 - sines[1] ** 2) for s in sines]
        behind = screen.z - lens.offset.thickness
        rest = [c - 0.5 * t / lens.index * s for c, s in zip(away, sines, strict=True)]
        throw = np.where(np.hypot(*tangents) > 1e-12, behind * np.hypot(*away) / np.maximum(np.hypot(*rest), 1e-300), throw)
    step = float(x[1] - x[0]), float(y[1] - y[0])
    values = integrate(sines[0] / t, sines[1] / t, step)
    spline = RectBivariateSpline(x, y, values)
    found = net.interpolated(torch.from_numpy(spline(*(c.numpy() for c in net.control_xy()))))
    return found - 0.5 * float(found.min() + found.max())
