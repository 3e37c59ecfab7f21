"""Derivative of the image with respect to one control height, by forward-mode differentiation (thesis 6.1, erratum E11).

Notation
    J           image, (n_x, n_y), parts of the source's power per pixel
    P_ij        control height, mm;  N_i(u) N_j(v) its basis function
    dJ/dP_ij    (n_x, n_y), parts of the source's power per mm

The rays are constants and J = sum over rays, so the derivative of the image is the sum of those of chunks.  Rays that meet the
surface outside the support of N_i N_j have none at all: the kernels find where rays meet it, and plain torch, whose operations have
a forward mode, traces and differentiates the few that are left, through a varying index step by step.  A plane wave's rays behind a
flat entrance are sampled on the surface itself.  Pixels that no ray under the basis function can reach stay exactly 0.

Shares that a ray keeps within the frame sum to its weight, so dJ/dP_ij sums to 0 where nothing is reflected and no ray
crosses the frame's border.  Bincount has a derivative of 0 almost everywhere and is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.autograd import forward_ad

from caustic_cli.errors import InputError
from caustic_cli.io.files import SOFTWARE, atomic_file
from caustic_cli.optics.effects import Requests
from caustic_cli.optics.emission import Rays, of_member
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Scene, Screen
from caustic_cli.scene.traits import Capability

DERIVATIVE = Capability("gradmap", {})

#: Neither the rays' way to the surface nor plain torch needs a fused kernel.
STAGES = Requests(stages=True)
#: Margin of the support in u and v, for the rounding of where a ray meets the surface.
BESIDE = 1e-9
#: Least margin, pixels, around the non-zero part that a plot shows.
LEAST_BESIDE = 3.0
#: Pixels by which a central difference may move a landing point.  With d pixels the relative error is of order d^2 (the
#: truncation of a C1 filter) plus 1e-12 / d (slopes rounded to 1e-16, thrown over a few hundred mm onto pixels of some
#: 0.05 mm): measured least, 2e-8, between 1e-4 and 1e-3.  The lower end, because the part d of the rays that crosses a
#: kink of the truncated Gaussian is wrong by order 1.
DIFFERENCE_PIXELS = 1e-4
#: Least step, in parts of the largest height: ten thousand roundings.
LEAST_STEP = 2e-12


def gradient_image(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    control: tuple[int, int],
    *,
    sampler: Rays,
    filter: Filter,
    dtype: torch.dtype = torch.float64,
    chunk: int = 1 << 19,
) -> Tensor:
    """dJ/dP_ij for control = (i, j): (n_x, n_y) float64, parts of the source's power per mm.

    Args:
        heights: (n, m) control heights, mm.
        sampler: the rays; memory is that of one chunk of them.
        filter: gaussian or cosine, of size 3 or more along both axes.
        dtype: precision of the ray arithmetic; chunks are summed in float64.

    Raises:
        InputError: no such control point, or a filter without a derivative.
    """
    direction = _direction(field, control).to(sampler.device)
    refuse_steps(filter)
    heights = heights.detach().to(sampler.device, torch.float64)
    total = torch.zeros(scene.screen.resolution, dtype=torch.float64, device=sampler.device)
    for band in scene.bands:
        system = System.of(band.scene, field)
        for rays in of_member(sampler, band.member).chunks(chunk):
            few = _under(field, control, heights, scene, system, rays)
            if not few.count:
                continue
            traced = Tracer(system, few, dtype, STAGES)
            with forward_ad.dual_level():
                image = traced.expose({EXIT: forward_ad.make_dual(heights, direction)}, scene.screen, filter).image
                total += band.weight * forward_ad.unpack_dual(image).tangent.double()
    return total


def refuse_steps(filter: Filter) -> None:
    """Refuse a filter without a derivative.

    Raises:
        InputError: it is one.
    """
    if min(filter.reach) < 1:
        raise InputError(
            "the derivative of an image needs gaussian or cosine reconstruction with a filter size of 3 or"
            f" more along both axes, got {filter.kind} of size {filter.size[0]} x {filter.size[1]}, under"
            " which no pixel changes when a ray moves a little"
        )


def difference_step(scene: Scene, field: HeightField, control: tuple[int, int], pixels: float = DIFFERENCE_PIXELS) -> float:
    """Height in mm that moves no landing point by more than about `pixels` pixels.

    A ray turns by (n - 1) times the change of slope, at most |grad N_i N_j| per mm of height, over the throw.
    """
    slope = field.slope_bound(_direction(field, control))  # 1/mm of slope per mm of height
    throw = scene.screen.z - scene.lens.z_in
    return pixels * min(scene.screen.pixel) / (abs((scene.lens.effective_index - 1.0) * throw) * slope)


def _step(scene: Scene, field: HeightField, heights: Tensor, control: tuple[int, int]) -> float:
    """`difference_step`, bounded by the rounding of the heights and half the distance to the screen.

    The bounds matter for an index close to 1 and for a very distant screen.
    """
    least = LEAST_STEP * float(heights.abs().max())
    return min(max(difference_step(scene, field, control), least), 0.5 * float((scene.screen.z - heights).abs().min()))


def finite_difference(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    control: tuple[int, int],
    *,
    sampler: Rays,
    filter: Filter,
    step: float | None = None,
) -> Tensor:
    """The same derivative by central differences of two float64 renders with the same rays: (n_x, n_y), per mm.

    Every ray is traced by `expose`, by stages, independently of the selection and differentiation in `gradient_image`.  Float64
    whatever the render uses: in float32 the difference of two nearly equal images is rounding.

    Args:
        step: half the distance between the two heights, mm; None for `difference_step`.
    """
    step = _step(scene, field, heights, control) if step is None else step
    direction = _direction(field, control).to(heights.device)
    heights = heights.detach().double()
    above, below = heights + step * direction, heights - step * direction
    distance = float((above - below)[tuple(control)])  # not 2 step: a height near 5 mm has only so many digits
    images = [expose(scene, field, h, sampler, filter, requests=STAGES) for h in (above, below)]
    return (images[0].total - images[1].total) / distance


@dataclass(frozen=True)
class Comparison:
    """A derivative against central differences.

    relative_error = ||g - d||_2 / ||d||_2 over all pixels (0 where both vanish, None where only d does); largest_error,
    the largest absolute difference of a pixel, parts of the source's power per mm; step, mm.
    """

    relative_error: float | None
    largest_error: float
    step: float


def compare(
    gradient: Tensor,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    control: tuple[int, int],
    *,
    sampler: Rays,
    filter: Filter,
    step: float | None = None,
) -> Comparison:
    """How far `gradient` (of `gradient_image` with the same rays and filter) is from `finite_difference`.

    A few 1e-8 are left with the cosine filter in float64; the truncated Gaussian has kinks (it is only C0), and leaves
    up to 1e-3 when one of the brightest rays meets one.
    """
    step = _step(scene, field, heights, control) if step is None else step
    reference = finite_difference(scene, field, heights, control, sampler=sampler, filter=filter, step=step)
    error = gradient.double() - reference
    scale, distance = float(reference.norm()), float(error.norm())
    relative = distance / scale if scale > 0 else (0.0 if distance == 0 else None)
    if relative is not None and not math.isfinite(relative):
        relative = None
    return Comparison(relative, float(error.abs().max()), step)


def plot_gradient(path: str | Path, gradient: Tensor, screen: Screen, title: str, unit: str = "mm") -> None:
    """Draw dJ/dP_ij (n_x, n_y) as a PNG of the screen seen from +z: x to the right, y up; unit: of both.

    It shows the part of the screen where they are not zero (`shown_part`).  Colours diverge symmetrically about 0 and exact zeros
    are white, which shows how far the control point reaches.  The same numbers give the same bytes.

    Raises:
        InputError: the file cannot be written.
    """
    g = np.asarray(gradient.detach().cpu(), dtype=np.float64)
    limit = float(np.abs(g).max()) or 1.0
    (rx, ry), figure = screen.half_size, Figure(figsize=(6.4, 5.2), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    shown = axes.imshow(
        np.ma.masked_equal(g, 0.0).T,
        origin="lower",
        extent=(-rx, rx, -ry, ry),
        cmap="coolwarm",
        vmin=-limit,
        vmax=limit,
        interpolation="nearest",
    )  # the colour of 0 is grey: white stands out
    (low_x, high_x), (low_y, high_y) = shown_part(g, screen)
    axes.set(
        xlabel=f"x ({unit})",
        ylabel=f"y ({unit})",
        title=f"{title}\n({high_x - low_x:.3g} x {high_y - low_y:.3g} {unit} of the screen's {2 * rx:.3g} x {2 * ry:.3g})",
        facecolor="white",
        xlim=(low_x, high_x),
        ylim=(low_y, high_y),
    )
    figure.colorbar(shown, label="change of a pixel, parts of the source's power per mm of height")
    with atomic_file(path) as file:
        figure.savefig(file, format="png", metadata={"Software": SOFTWARE})


def shown_part(gradient: np.ndarray, screen: Screen) -> list[tuple[float, float]]:
    """Limits along x and y, mm, of a plot of this gradient (n_x, n_y): the non-zero part with a margin of a quarter of its size, at
    least `LEAST_BESIDE` pixels, square, within the screen."""
    spans, centres = [], []
    for axis in (0, 1):
        lit = np.flatnonzero((gradient != 0).any(1 - axis))
        low, high = (lit[0], lit[-1] + 1) if len(lit) else (0, gradient.shape[axis])
        beside = max(LEAST_BESIDE, 0.25 * (high - low))
        spans.append((high - low + 2.0 * beside) * screen.pixel[axis])
        centres.append(0.5 * (low + high) * screen.pixel[axis] - screen.half_size[axis])
    wide = max(spans)
    return [
        (max(-half, centre - 0.5 * wide), min(half, centre + 0.5 * wide))
        for centre, half in zip(centres, screen.half_size, strict=True)
    ]


def _direction(field: HeightField, control: tuple[int, int]) -> Tensor:
    """The unit net e_ij (n, m) float64."""
    for name, k, n in zip("IJ", control, field.shape, strict=True):
        if not 0 <= k < n:
            raise InputError(f"control point {name} must be a whole number 0 to {n - 1}, got {k}")
    unit = torch.zeros(field.shape, dtype=torch.float64)
    unit[tuple(control)] = 1.0
    return unit


@torch.no_grad()
def _under(
    field: HeightField, control: tuple[int, int], heights: Tensor, scene: Scene, system: System, rays: Sample | RayState
) -> RayState:
    """Those of the rays on the pupil that meet the exit in the support of a basis function."""
    pupil = system.pupil
    if isinstance(rays, Sample) and scene.axial:
        return RayState.on_axis(_sampled_under(field, control, rays), pupil.half_size, pupil.z)
    state = rays if isinstance(rays, RayState) else RayState.on_axis(rays, pupil.half_size, pupil.z)
    x, y = Tracer(system, state, requests=STAGES).at(EXIT, {EXIT: heights}).hit.local[:2]
    in_u, in_v = in_support(field, control, *(0.5 * (c / r + 1.0) for c, r in zip((x, y), field.half_size, strict=True)))
    return state.only(in_u & in_v)


def _sampled_under(field: HeightField, control: tuple[int, int], sample: Sample) -> Sample:
    """The rays of a sample of the exit itself in the support of a basis function."""
    (in_u, in_v), flux = in_support(field, control, sample.u, sample.v), sample.flux
    if sample.tensor:
        return Sample(sample.u[in_u], sample.v[in_v], True, flux[in_u][:, in_v] if flux.ndim else flux)
    both = in_u & in_v
    return Sample(sample.u[both], sample.v[both], False, flux[both] if flux.ndim else flux)


def in_support(field: HeightField, control: tuple[int, int], u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Which u and which v, in [0, 1], are in the closed support [t_i, t_{i+p+1}] x [t_j, t_{j+q+1}] of a basis function."""
    inside = []
    for space, k, at in zip(field.spaces, control, (u, v), strict=True):
        low, high = float(space.knots[k]), float(space.knots[k + space.degree + 1])
        inside.append((at >= low - BESIDE) & (at <= high + BESIDE))
    return inside[0], inside[1]
