"""What errors of making and placing do to a picture: the sensitivity to each, and a Monte-Carlo over all of them.

Notation
    t           target over its own mean
    m           image of a draw over its own mean
    F           relative RMS error, F^2 = mean((m - t)^2); F_0 of the lens without errors
    s_k         standard deviation of parameter k
    g_k         derivative of m by it, from the images at +s_k and -s_k: (m_+ - m_-) / (2 s_k)
    c_k         what it adds, in squares: c_k^2 = (F_+^2 + F_-^2) / 2 - F_0^2

To second order F^2 is F_0^2 + 2 d <m_0 - t, g> + d^2 (|g|^2 + <m_0 - t, m''>) at an error d, whose term of first order has no mean;
so the mean of F^2 over all draws is about F_0^2 plus all c_k^2.  c_k holds both parts of the second order.

Draws of the parameters are a Latin hypercube: of each parameter, one in every one of as many equal parts of probability; the mean
of F^2, nearly a sum over parameters, is then told far more exactly than by independent draws.  Every draw traces the same points of
the lens.

Images are those of two independent halves of the rays, A and B, whose noise drops out of F^2 = mean((a - t) (b - t))
(`studies.noise`).  Of a lens that was refined on its wave image, the light that moves is that of the wave image: light at q goes
to q + u(q), with u the mean displacement of the rays that land near q.  Errors of the surface change what interferes, so that each
of a few realisations of them has its wave image, which the other errors then move.  Those bend the phase only a little over the
width of a detail; by how much the image of the 95 % draw is then wrong is measured by its own wave image, as far as index,
thickness, throw and source go, and said.

A decentred or tilted lens moves the picture as a whole, which a screen may be moved after: F is told as placed, and also after the
shift of the screen that suits each draw best.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, spline_filter
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.io.files import CREATED_BY, SOFTWARE, atomic_path, write_bytes
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.form_error import FormErrors, refined
from caustic_cli.optics.misalignment import LandingPoints, Misalignment, landing_points, reason_ignored
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SOBOL_RAYS, stream
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.tolerances import Parameter, Tolerances, hypercube
from caustic_cli.studies.noise import standard_error

#: Rays of a draw, both halves together.
RAYS = 200_000
#: Realisations of a random surface by which its contribution is told.
REALISATIONS = 4
#: Number of the first of those realisations: beyond all draws.
ALONE = 10**6
#: Realisations of the surface's errors that have a wave image; draws take them in turn.
REALISED = 8
#: Errors that a wave image of its own can have.
WAVED = ("index", "thickness", "throw", "source_shift", "source_distance", "source_size")
#: Part of the draws that count as the worst.
WORST = 0.05
#: Resamplings for the standard error of a percentile.
RESAMPLED = 400
#: Steps of the fixed point by which light is traced back to where the wave image has it.
BACK = 4
#: Pixels that its displacement is averaged over, at least.
NEAR = 1.5
#: Part of the rays that are enough for displacements, which are smooth.
FEWER = 5
#: Light, of its mean over all pixels, that is enough to tell its displacement.
LIT = 1e-3
#: So many times the rays of a draw judge the lens without errors, whose error is the smallest.
NOMINAL = 8
#: Slope of the exit, uniform over the lens, by which the effect of its roughness is told.
LEAN = 1e-5

Values = dict[tuple[str, int], float]


@dataclass(frozen=True)
class Judged:
    """A draw's figures: relative_rms as placed; shifted, after the best shift (x, y) mm of the screen; on_target, on_screen, parts
    of the source's power; noise, standard error of relative_rms, of its rays."""

    relative_rms: float
    shifted: float
    shift: tuple[float, float]
    on_target: float
    on_screen: float
    noise: float


class Trials:
    """A lens whose picture is judged under given errors.

    Args:
        scene, field, heights: the lens; of a plan, with `requests`.
        target: (n_x, n_y) or, of a coloured scene, (3, n_x, n_y).
        tolerances: what may be off.
        waves: what gives the wave image of heights in a scene, of the target's shape; None to judge by rays.
        near: pixels over which displacements are averaged there.
    """

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        heights: Tensor,
        target: np.ndarray,
        tolerances: Tolerances,
        *,
        rays: int = RAYS,
        requests: Requests = NO_REQUESTS,
        waves: Callable[[Scene, HeightField, Tensor], np.ndarray] | None = None,
        near: float = NEAR,
    ):
        self.scene, self.requests, self.tolerances = scene, requests, tolerances
        self.field, self.heights = refined(field, heights.detach().double().cpu(), tolerances.shortest)
        self.target = target if target.ndim == 3 else target[None]
        self.waves = waves
        self.rays, self.near = max(2, rays // (2 if waves is None else FEWER)), max(near, NEAR)
        self.parameters = tuple(p for p in tolerances.parameters if not reason_ignored(scene, p.error))
        self.surfaces = FormErrors(self.field, tolerances.form, tolerances.waviness) if tolerances.surface else None
        self.gain: tuple[float, float] | None = None
        self.smooth: dict[tuple[int, tuple[str, ...]], list[np.ndarray]] = {}
        if waves is not None:
            self.begin = self._rays(Misalignment(), self.heights, 0)
            self.power = sum(float(part.power.sum()) for part in self.begin)

    def judge(self, values: Values, number: int | None = None, which: tuple[str, ...] | None = None) -> Judged:
        """Figures under errors by (name, axis), and the surface's errors of that realisation, all of them or just `which`."""
        return self.judged(*self.images(values, number, which))

    def images(
        self, values: Values, number: int | None = None, which: tuple[str, ...] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The two halves' images, (colours, n_x, n_y) each, parts of the source's power on the pixels; twice the same of waves."""
        errors, which = Misalignment.of(values), self.tolerances.surface if which is None else which
        which = which if number is not None else ()
        if self.waves is None:
            heights = self.heights + self.surface(number, which) if which and number is not None else self.heights
            pair = [self._image(self._rays(errors, heights, half)) for half in (0, 1)]
        else:
            light = self._wave_image(number % REALISED if which and number is not None else 0, which)
            pair = [self._moved(self._rays(errors, self.heights, 0), light)] * 2
        rough = abs(values.get(("roughness", 0), 0.0))
        if rough > 0:
            width = [rough * g / p for g, p in zip(self._gain(), self.scene.screen.pixel, strict=True)]
            pair = [np.stack([gaussian_filter(c, width, mode="constant") for c in one]) for one in pair]
        return pair[0], pair[1]

    def nominal(self) -> Judged:
        """Figures without errors; by rays, of NOMINAL times as many."""
        if self.waves is not None:
            return self.judge({})
        pairs = [[self._image(self._rays(Misalignment(), self.heights, 2 * k + half)) for k in range(NOMINAL)] for half in (0, 1)]
        return self.judged(np.mean(pairs[0], 0), np.mean(pairs[1], 0))

    def by_waves(self, values: Values, number: int | None) -> tuple[Judged, Judged]:
        """Figures under the errors of `values` that are of index, thickness, throw and source.

        By the light of the wave image moved as rays are, and by their own wave image.
        """
        assert self.waves is not None
        kept = {key: v for key, v in values.items() if key[0] in WAVED}
        errors, which = Misalignment.of(kept), self.tolerances.surface if number is not None else ()
        scene = errors.scene(self.scene)
        scene = replace(scene, screen=replace(scene.screen, z=scene.screen.z + errors.throw))
        surface = self.surface(number % REALISED, which) if which and number is not None else 0.0
        own = self._coloured(self.waves(scene, self.field, self.heights + errors.thickness + surface))
        return self.judge(kept, number), self.judged(own, own)

    def _coloured(self, image: np.ndarray) -> np.ndarray:
        return image if image.ndim == 3 else image[None]

    def _wave_image(self, number: int, which: tuple[str, ...]) -> list[np.ndarray]:
        """Spline coefficients of the wave image, colour by colour, of a realisation of the surface's errors."""
        assert self.waves is not None
        if (number, which) not in self.smooth:
            heights = self.heights + self.surface(number, which) if which else self.heights
            found = self._coloured(self.waves(self.scene, self.field, heights))
            self.smooth[number, which] = [spline_filter(c, order=3) for c in found]
        return self.smooth[number, which]

    def judged(self, one: np.ndarray, other: np.ndarray) -> Judged:
        """Figures of an image, from two halves of it."""
        squares, best, lit = [], [], [k for k, t in enumerate(self.target) if t.sum() > 0]
        together = 0.5 * (one + other)
        noise = 0.0
        for k in lit:
            t, a, b = (c / c.mean() if c.sum() > 0 else c for c in (self.target[k], one[k], other[k]))
            squares.append(float(np.mean((a - t) * (b - t))))
            level, shift = best_shift(0.5 * (a + b), t)
            best.append((float(np.mean(a * b) + np.mean(t * t)) - 2.0 * level, shift))
            if self.waves is None:
                noise += standard_error(one[k], other[k], self.target[k], math.sqrt(max(0.0, squares[-1]))) / len(lit)
        shift = tuple(float(np.mean([s[axis] for _, s in best]) * self.scene.screen.pixel[axis]) for axis in (0, 1))
        error, shifted = (float(np.mean(np.sqrt(np.maximum(0.0, s)))) for s in (squares, [s for s, _ in best]))
        return Judged(
            error, min(error, shifted), (shift[0], shift[1]), float(together[self.target > 0].sum()), float(together.sum()), noise
        )

    def surface(self, number: int, which: tuple[str, ...]) -> Tensor:
        """The realisation of those errors of the surface, control heights (n, m) mm."""
        assert self.surfaces is not None
        return self.surfaces.heights(np.random.default_rng([self.tolerances.seed, 1, number]), which)

    def _rays(self, errors: Misalignment, heights: Tensor, half: int) -> list[LandingPoints]:
        changed, even = errors.scene(self.scene), self.scene.source.collimated or self.rays > SOBOL_RAYS // 4
        kind, seed = "stratified" if even else "sobol", stream(self.tolerances.seed, f"tolerances {half}")
        rays = rays_of(changed.part(half % 2, 2), kind, self.rays, seed)
        return list(landing_points(self.scene, self.field, heights, rays, errors, self.requests))

    def _image(self, parts: Iterable[LandingPoints]) -> np.ndarray:
        image = np.zeros(self.target.shape)
        for part in parts:
            found, _ = backend_for("cpu").splat(*self._placed(part), part.power, self.scene.screen, Filter())
            image[part.channel or 0] += found.numpy()
        return image

    def _placed(self, part: LandingPoints) -> tuple[Tensor, Tensor]:
        """Landing points as a splat counts them, from the foot of the axis."""
        sx, sy = self.scene.screen.shift
        return part.x + sx, part.y + sy

    def _moved(self, now: list[LandingPoints], smooth: list[np.ndarray]) -> np.ndarray:
        """A wave image, by its splines, with its light moved as rays are."""
        shape, (wx, wy), (rx, ry) = self.target.shape[1:], self.scene.screen.pixel, self.scene.screen.half_size
        out = np.zeros(self.target.shape)
        scale = sum(float(part.power.sum()) for part in now) / self.power
        grid = np.meshgrid(*(np.arange(n, dtype=float) for n in shape), indexing="ij")
        for channel in range(len(out)):
            pairs = [(a, b) for a, b in zip(self.begin, now, strict=True) if (a.channel or 0) == channel]
            if not pairs:
                continue
            sums = np.zeros((3, *shape))
            for a, b in pairs:
                weight = torch.where(b.power > 0, a.power, 0.0)
                i, j = ((a.x + rx) / wx).floor().long(), ((a.y + ry) / wy).floor().long()
                inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1]) & (weight > 0)
                cell, w = (i * shape[1] + j)[inside], weight[inside]
                for k, value in enumerate((torch.ones_like(w), ((b.x - a.x) / wx)[inside], ((b.y - a.y) / wy)[inside])):
                    sums[k] += torch.bincount(cell, w * value, minlength=shape[0] * shape[1]).numpy().reshape(shape)
            ux, uy = displacement(sums, self.near)
            qx, qy = grid
            for _ in range(BACK):  # q + u(q) = p
                at = [qx, qy]
                qx, qy = (p - map_coordinates(u, at, order=1, mode="nearest") for p, u in zip(grid, (ux, uy), strict=True))
            (xx, xy), (yx, yy) = np.gradient(qx), np.gradient(qy)
            found = map_coordinates(smooth[channel], [qx, qy], order=3, mode="constant", prefilter=False)
            out[channel] = scale * np.maximum(found, 0.0) * np.abs(xx * yy - xy * yx)
        return out

    def _gain(self) -> tuple[float, float]:
        """How far, mm, light moves on the screen along x and y for a slope of 1 of the exit: root mean square over the light."""
        if self.gain is None:
            still = self._rays(Misalignment(), self.heights, 0)
            found = []
            for axis, at in enumerate(self.field.control_xy()):
                ramp = LEAN * (at[:, None] if axis == 0 else at[None, :])
                leant = self._rays(Misalignment(), self.heights + ramp, 0)
                square = power = 0.0
                for a, b in zip(still, leant, strict=True):
                    d, w = ((b.x - a.x) if axis == 0 else (b.y - a.y)), torch.where(b.power > 0, a.power, 0.0)
                    square, power = square + float((w * d * d).nan_to_num(0.0).sum()), power + float(w.sum())
                found.append(math.sqrt(square / power) / LEAN if power > 0 else 0.0)
            self.gain = found[0], found[1]
        return self.gain


@contextmanager
def one_thread() -> Iterator[None]:
    """Within the block torch works in one thread: a draw's arrays are small, and several threads wait for each other on a machine
    that has more to do."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def best_shift(image: np.ndarray, target: np.ndarray) -> tuple[float, tuple[float, float]]:
    """The largest mean product of a target and a shifted image, each over its own mean, and that shift of the screen in pixels.

    By a Fourier transform at whole pixels, and a parabola through the neighbours of the largest.
    """
    shape = [2 * n for n in image.shape]
    product = np.fft.irfft2(np.fft.rfft2(image, shape) * np.conj(np.fft.rfft2(target, shape)), shape) / image.size
    at = np.unravel_index(int(product.argmax()), product.shape)
    level, shift = float(product[at]), []
    for axis, n in enumerate(shape):
        ends = [float(np.take(product, (at[axis] + d) % n, axis)[at[1 - axis]]) for d in (-1, 1)]
        bend = ends[0] + ends[1] - 2.0 * float(product[at])
        part = 0.5 * (ends[0] - ends[1]) / bend if bend < 0 else 0.0
        level += -0.125 * (ends[0] - ends[1]) ** 2 / bend if bend < 0 else 0.0
        shift.append((at[axis] if at[axis] < n // 2 else at[axis] - n) + part)
    return level, (shift[0], shift[1])


def displacement(sums: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean displacement on every pixel from the sums (3, n_x, n_y) over its rays of power, and of power times displacement.

    It is averaged over `near` pixels; where there is too little light for that, it is that of the nearest pixel with enough.
    """
    weight, x, y = (gaussian_filter(s, near, mode="constant") for s in sums)
    enough = weight > LIT * sums[0].mean()
    if not enough.any():
        return np.zeros_like(x), np.zeros_like(y)
    at = tuple(distance_transform_edt(~enough, return_distances=False, return_indices=True))
    return (x[at] / weight[at]), (y[at] / weight[at])


@dataclass(frozen=True)
class Sensitivity:
    """What one error does alone.

    name, unit; sigma: its standard deviation; derivative: RMS of the image's derivative by it, of the image's mean, per unit, None
    of a random surface; below, above: relative RMS errors at -sigma and +sigma, of a random surface both their mean; adds: c_k.
    """

    name: str
    unit: str
    sigma: float
    derivative: float | None
    below: float
    above: float
    adds: float


def sensitivities(trials: Trials, told: Callable[[int], None] = lambda done: None) -> list[Sensitivity]:
    """Of every error alone, by what it adds, the worst first."""
    found, square = [], trials.judge({}).relative_rms ** 2  # of the same rays: their noise drops out of differences
    for p in trials.parameters:
        pairs = [trials.images({(p.error, p.axis): sign * p.sigma}) for sign in (-1.0, 1.0)]
        below, above = (trials.judged(*pair) for pair in pairs)
        slopes = [_slope(pairs[0][half], pairs[1][half], p.sigma) for half in (0, 1)]
        derivative = math.sqrt(max(0.0, float(np.mean(slopes[0] * slopes[1]))))
        adds = 0.5 * (below.relative_rms**2 + above.relative_rms**2) - square
        found.append(
            Sensitivity(p.name, p.unit, p.sigma, derivative, below.relative_rms, above.relative_rms, math.sqrt(max(0.0, adds)))
        )
        told(len(found))
    first = ALONE if len(trials.tolerances.surface) > 1 else 0  # one error alone is that of the first draws
    for name in trials.tolerances.surface:
        errors = [trials.judge({}, first + k, (name,)).relative_rms for k in range(REALISATIONS)]
        mean = math.sqrt(sum(e * e for e in errors) / len(errors))
        t = trials.tolerances
        sigma = t.form.rms if name == "form_error" and t.form else t.waviness.amplitude / math.sqrt(2.0) if t.waviness else 0.0
        found.append(Sensitivity(name, "mm", sigma, None, mean, mean, math.sqrt(max(0.0, mean**2 - square))))
        told(len(found))
    return sorted(found, key=lambda s: -s.adds)


def _slope(low: np.ndarray, high: np.ndarray, sigma: float) -> np.ndarray:
    """Derivative of the image over its mean, of the colours that there are."""
    pairs = [(a, b) for a, b in zip(low, high, strict=True) if min(a.sum(), b.sum()) > 0]
    return np.stack([(b / b.mean() - a / a.mean()) / (2.0 * sigma) for a, b in pairs])


@dataclass(frozen=True)
class Study:
    """All draws.

    drawn, judged: of every draw its parameters (draws, k) and its figures; nominal: of the lens without errors; unused: errors that
    mean nothing in the scene, and why; by_waves: judged by waves; checked: relative RMS of the draw at 95 %, with no more than the
    errors of WAVED, by light moved as rays are and by its own wave image.
    """

    parameters: tuple[Parameter, ...]
    drawn: np.ndarray
    judged: tuple[Judged, ...]
    nominal: Judged
    sensitivities: tuple[Sensitivity, ...]
    unused: dict[str, str]
    by_waves: bool
    seed: int
    checked: tuple[float, float] | None = None

    def of(self, name: str) -> np.ndarray:
        """A figure of every draw."""
        return np.array([getattr(j, name) for j in self.judged])


def study(trials: Trials, told: Callable[[str, int, int], None] = lambda what, done, whole: None) -> Study:
    """Sensitivities, then all draws.

    Raises:
        InputError: no error of the tolerances means anything in the scene, or one makes it impossible.
    """
    t = trials.tolerances
    unused = {e.name: why for e in t.errors if (why := reason_ignored(trials.scene, e.name))}
    if not (trials.parameters or t.surface):
        raise InputError(f"no error of the tolerances means anything here: {'; '.join(f'{k}: {v}' for k, v in unused.items())}")
    nominal = trials.nominal()
    kinds = len(trials.parameters) + len(t.surface)
    alone = sensitivities(trials, lambda done: told("sensitivities", done, kinds))
    drawn, judged = hypercube(trials.parameters, t.draws, t.seed), []
    for number, row in enumerate(drawn):
        values = {(p.error, p.axis): float(v) for p, v in zip(trials.parameters, row, strict=True)}
        judged.append(trials.judge(values, number))
        told("draws", number + 1, t.draws)
    checked = None
    if trials.waves is not None:
        at = int(np.argsort([j.relative_rms for j in judged])[math.ceil(0.95 * len(judged)) - 1])
        values = {(p.error, p.axis): float(v) for p, v in zip(trials.parameters, drawn[at], strict=True)}
        quick, own = trials.by_waves(values, at)
        checked = quick.relative_rms, own.relative_rms
    return Study(trials.parameters, drawn, tuple(judged), nominal, tuple(alone), unused, trials.waves is not None, t.seed, checked)


def percentile_error(values: np.ndarray, part: float) -> float:
    """Standard error of a percentile, by resampling; of independent draws, so that a Latin hypercube's is rather smaller."""
    rng = np.random.default_rng(0)
    return float(np.quantile(rng.choice(values, (RESAMPLED, len(values))), part, axis=1).std())


def offenders(found: Study) -> list[dict]:
    """How the size of each parameter goes with the error, the strongest first.

    That is its rank correlation over all draws, and its mean size in the worst ones, in standard deviations (of no offender it is
    about 0.8).
    """
    error = found.of("relative_rms")
    worst = np.argsort(error)[-max(1, math.ceil(WORST * len(error))) :]
    rows = []
    for p, column in zip(found.parameters, np.abs(found.drawn).T, strict=True):
        ranks = [np.argsort(np.argsort(c)) for c in (column, error)]
        rows.append(
            {
                "name": p.name,
                "correlation": float(np.corrcoef(*ranks)[0, 1]),
                "in_worst": float(column[worst].mean() / p.sigma),
            }
        )
    return sorted(rows, key=lambda row: -row["correlation"])


def figures(found: Study) -> dict:
    """For JSON, under `tolerances`."""

    def spread(name: str) -> dict:
        values = found.of(name)
        return {f"p{q}": float(np.quantile(values, q / 100.0)) for q in (5, 50, 95)}

    error = found.of("relative_rms")
    adds = sum(s.adds**2 for s in found.sensitivities)
    return {
        "draws": len(found.judged),
        "seed": found.seed,
        "judged_by": "waves" if found.by_waves else "rays",
        "nominal": {"relative_rms": found.nominal.relative_rms, "on_target": found.nominal.on_target},
        "relative_rms": spread("relative_rms")
        | {"mean_square_root": float(np.sqrt(np.mean(error**2))), "p95_standard_error": percentile_error(error, 0.95)},
        "shifted_relative_rms": spread("shifted"),
        "on_target": spread("on_target"),
        "noise": float(np.mean(found.of("noise"))),
        "predicted_mean_square_root": math.sqrt(found.nominal.relative_rms**2 + adds),
        "sensitivities": [
            {
                "name": s.name,
                "unit": s.unit,
                "sigma": s.sigma,
                "derivative": s.derivative,
                "relative_rms_below": s.below,
                "relative_rms_above": s.above,
                "adds": s.adds,
            }
            for s in found.sensitivities
        ],
        "offenders": offenders(found),
        "unused": found.unused,
    } | ({} if found.checked is None else {"wave_check": dict(zip(("moved", "own"), found.checked, strict=True))})


def rows(f: dict) -> list[tuple[str, str]]:
    """The figures as a person reads them."""
    error, placed, light = f["relative_rms"], f["shifted_relative_rms"], f["on_target"]
    noise = f", noise {f['noise']:.2g}" if f["noise"] else ""
    table = [
        ("judged", f"by {f['judged_by']}, {f['draws']} draws"),
        (
            "without errors",
            f"relative RMS error {f['nominal']['relative_rms']:.4f}, light on the picture {f['nominal']['on_target']:.2%}",
        ),
        (
            "relative RMS error",
            f"{error['p50']:.4f} (half of all), {error['p95']:.4f} ± {error['p95_standard_error']:.4f} (95 %){noise}",
        ),
        ("after the best shift of the screen", f"{placed['p50']:.4f} (half of all), {placed['p95']:.4f} (95 %)"),
        ("light on the picture", f"{light['p50']:.2%} (half of all), at least {light['p5']:.2%} (95 %)"),
        (
            "root mean square, and as predicted",
            f"{error['mean_square_root']:.4f}, {f['predicted_mean_square_root']:.4f} from the errors one by one",
        ),
    ]
    if "wave_check" in f:
        c = f["wave_check"]
        table.append(("the draw at 95 %, index to source", f"{c['moved']:.4f}, by its own wave image {c['own']:.4f}"))
    for s in f["sensitivities"]:
        slope = "" if s["derivative"] is None else f"; {s['derivative']:.3g} per {s['unit'] or 'unit'}"
        table.append(
            (
                f"{s['name']}, sigma {s['sigma']:.3g}{' ' if s['unit'] else ''}{s['unit']}",
                f"adds {s['adds']:.4f}{slope}; alone {s['relative_rms_below']:.4f} to {s['relative_rms_above']:.4f}",
            )
        )
    worst = ", ".join(f"{o['name']} {o['correlation']:.2f} ({o['in_worst']:.1f} sigma)" for o in f["offenders"][:4])
    if worst:
        table.append((f"in the worst {WORST:.0%}", worst))
    return table


def write_csv(path: Path, found: Study) -> None:
    """All draws: their parameters and their figures."""
    text = io.StringIO(f"# {CREATED_BY} {__version__}\n")
    text.seek(0, io.SEEK_END)
    out = csv.writer(text, lineterminator="\n")
    names = [f"{p.name} ({p.unit})" if p.unit else p.name for p in found.parameters]
    out.writerow(
        ["draw", *names, "relative_rms", "shifted_relative_rms", "shift x (mm)", "shift y (mm)", "on_target", "on_screen", "noise"]
    )
    for number, (row, j) in enumerate(zip(found.drawn, found.judged, strict=True)):
        out.writerow([number, *map(repr, map(float, row)), j.relative_rms, j.shifted, *j.shift, j.on_target, j.on_screen, j.noise])
    write_bytes(path, text.getvalue().encode())


def write_plot(path: Path, found: Study) -> None:
    """Distributions of error and light over the draws, and what each error adds alone."""
    import matplotlib  # noqa: PLC0415

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415
    from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

    from caustic_cli.studies.report import COLOURS  # noqa: PLC0415

    figure, (error, light, bars) = plt.subplots(1, 3, figsize=(15.0, 5.6), constrained_layout=True)
    f = figures(found)
    placing = {"as placed": found.of("relative_rms"), "after the best shift": found.of("shifted")}
    bins, both = min(40, max(8, len(found.judged) // 8)), np.concatenate(list(placing.values()))
    for (label, values), colour, filled in zip(placing.items(), COLOURS[:2], (True, False), strict=True):
        style = {"histtype": "stepfilled", "alpha": 0.4} if filled else {"histtype": "step", "lw": 1.6}
        error.hist(values, np.histogram_bin_edges(both, bins), color=colour, label=label, **style)
    light.hist(found.of("on_target"), bins, color=COLOURS[0], alpha=0.4, histtype="stepfilled")
    placed = f["relative_rms"]
    for value, color, style, label in (
        (f["nominal"]["relative_rms"], "k", "-", "without errors"),
        (placed["p50"], COLOURS[0], "--", "half, as placed"),
        (placed["p95"], COLOURS[0], "-", "95 %, as placed"),
    ):
        error.axvline(value, color=color, ls=style, label=f"{label}: {value:.3f}")
    error.set(title=f"{len(found.judged)} draws, judged by {f['judged_by']}", xlabel="relative RMS error", ylabel="draws")
    light.axvline(f["nominal"]["on_target"], color="k", label=f"without errors: {f['nominal']['on_target']:.4f}")
    light.axvline(f["on_target"]["p5"], color=COLOURS[0], ls="--", label=f"95 % have at least {f['on_target']['p5']:.4f}")
    light.set(title="light on the picture", xlabel="part of the source's power", ylabel="draws")
    shown = found.sensitivities[:16][::-1]
    bars.barh([f"{s.name}\n{s.sigma:.3g} {s.unit}".strip() for s in shown], [s.adds for s in shown], color=COLOURS[2])
    bars.axvline(f["nominal"]["relative_rms"], color="k", ls=":", label="error without errors")
    bars.set(title="what each error of one sigma adds, in squares", xlabel="relative RMS error")
    bars.tick_params(axis="y", labelsize=8)
    for axis in (error, light, bars):
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, fontsize=8, frameon=False)  # below all data
    for axis in (error, light):
        axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100, metadata={"Software": SOFTWARE})
    plt.close(figure)
