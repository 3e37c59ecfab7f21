"""Tolerance analysis: sensitivity to manufacturing and alignment errors, and Monte-Carlo simulation of all of them.

Notation
    t           target over its own mean
    m           image of a draw over its own mean
    F           relative RMS error, F^2 = mean((m - t)^2); F_0 of the lens without errors
    s_k         standard deviation of parameter k
    g_k         derivative of m by it, from the images at +s_k and -s_k: (m_+ - m_-) / (2 s_k)
    c_k         its contribution, in quadrature: c_k^2 = (F_+^2 + F_-^2) / 2 - F_0^2

To second order F^2 is F_0^2 + 2 d <m_0 - t, g> + d^2 (|g|^2 + <m_0 - t, m''>) at an error d, whose first-order
term has zero mean; so the mean of F^2 over all draws is about F_0^2 plus the sum of c_k^2, which contain both second-order terms.

Draws of the parameters are a Latin hypercube: of each parameter, one in every one of as many equal parts of probability; the mean
of F^2, nearly a sum over parameters, then has a much smaller variance than with independent draws.  Every draw traces the same
points of the lens (common random numbers).

Images are those of two independent halves of the rays, A and B, whose noise drops out of F^2 = mean((a - t) (b - t))
(`studies.noise`).  A lens refined on its wave image is evaluated by that (`studies.tolerances_by_waves`).

A decentred or tilted lens displaces the picture as a whole, which a shift of the screen can compensate: F is given as placed, and
also after the best shift of the screen for each draw (compensator).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.io.files import CREATED_BY, SOFTWARE, atomic_file, write_bytes
from caustic_cli.optics import ranks
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.form_error import FormErrors, OtherSurfaces, refined
from caustic_cli.optics.misalignment import LandingPoints, Misalignment, landing_points, reason_ignored
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SOBOL_RAYS, stream
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.tolerances import Parameter, Tolerances, hypercube
from caustic_cli.studies.noise import standard_error

#: Rays of a draw, both halves included.
RAYS = 200_000
#: Realisations of a random surface error for its contribution.
REALISATIONS = 4
#: Number of the first of those realisations, beyond all draws.
ALONE = 10**6
#: Fraction of the draws that count as the worst.
WORST = 0.05
#: Bootstrap samples for the standard error of a percentile.
RESAMPLED = 400
#: Factor by which more rays are used for the lens without errors.
NOMINAL = 8
#: Uniform slope of the exit, a finite-difference step for the effect of roughness.
LEAN = 1e-5

#: Most errors in the plot, and the height of one, inch.
BARS, BAR_HEIGHT = 16, 0.33

Values = dict[tuple[str, int], float]


@dataclass(frozen=True)
class TrialFigures:
    """Figures of a draw: relative_rms as placed; shifted, after the best shift (x, y) mm of the screen; on_target, on_screen,
    fractions of the source's power; noise, standard error of relative_rms."""

    relative_rms: float
    shifted: float
    shift: tuple[float, float]
    on_target: float
    on_screen: float
    noise: float


class Trials:
    """Evaluation of a lens under given errors, by ray images.

    Args:
        scene, field, heights, requests: of a plan; heights (n, m) mm.
        target: (n_x, n_y) or, of a coloured scene, (3, n_x, n_y).
        tolerances: distributions of the errors.
        rays: of a draw.
    """

    #: By what images: rays, or waves (`tolerances_by_waves`).
    by: ClassVar[str] = "rays"
    #: Divisor of the number of rays: 2, as there are two halves.
    divisor: ClassVar[int] = 2

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
    ):
        self.scene, self.requests, self.tolerances = scene, requests, tolerances
        self.field, self.heights = refined(field, heights.detach().double().cpu(), tolerances.shortest)
        self.target = target if target.ndim == 3 else target[None]
        self.rays = max(2, rays // self.divisor)
        self.parameters = tuple(p for p in tolerances.parameters if not reason_ignored(scene, p.error))
        statistics = tolerances.form, tolerances.waviness
        self.surfaces = FormErrors(self.field, *statistics) if tolerances.surface else None
        self.others = OtherSurfaces(scene, *statistics, tolerances.shortest) if tolerances.surface else None
        self.gain: tuple[float, float] | None = None

    def evaluate(self, values: Values, number: int | None = None, which: tuple[str, ...] | None = None) -> TrialFigures:
        """Figures under errors by (name, axis), and a realisation of the surface errors, all of them or only `which`."""
        return self.figures_of(*self.images(values, number, which))

    def images(
        self, values: Values, number: int | None = None, which: tuple[str, ...] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Images of the two halves of the rays, (colours, n_x, n_y) each, fractions of the source's power; twice the same for
        waves."""
        which = self.tolerances.surface if which is None else which
        pair = self._pair(Misalignment.of(values), number if which else None, which)
        rough = abs(values.get(("roughness", 0), 0.0))
        if rough > 0:
            width = [rough * g / p for g, p in zip(self._gain(), self.scene.screen.pixel, strict=True)]
            pair = [np.stack([gaussian_filter(c, width, mode="constant") for c in one]) for one in pair]
        return pair[0], pair[1]

    def _pair(self, errors: Misalignment, number: int | None, which: tuple[str, ...]) -> list[np.ndarray]:
        """The images without roughness; number: of the realisation of the surface errors `which`, None for none."""
        scene, heights = self.shaped(number, which)
        return [self._image(self._rays(errors, heights, half, scene)) for half in (0, 1)]

    def nominal(self) -> TrialFigures:
        """Figures without errors, with NOMINAL times as many rays."""
        pairs = [[self._image(self._rays(Misalignment(), self.heights, 2 * k + half)) for k in range(NOMINAL)] for half in (0, 1)]
        return self.figures_of(np.mean(pairs[0], 0), np.mean(pairs[1], 0))

    def check(self, values: Values, number: int) -> tuple[float, float] | None:
        """Relative RMS of a draw, by its image as obtained here and by its exact one, with the errors that this can include; None
        where both are the same."""
        return None

    def noise(self, one: np.ndarray, other: np.ndarray, target: np.ndarray, error: float) -> float:
        """Standard error of the error of an image (n_x, n_y), from two halves of it."""
        return standard_error(one, other, target, error)

    def figures_of(self, one: np.ndarray, other: np.ndarray) -> TrialFigures:
        """Figures of an image, from two halves of it."""
        squares, best, lit = [], [], [k for k, t in enumerate(self.target) if t.sum() > 0]
        together = 0.5 * (one + other)
        noise = 0.0
        for k in lit:
            t, a, b = (c / c.mean() if c.sum() > 0 else c for c in (self.target[k], one[k], other[k]))
            squares.append(float(np.mean((a - t) * (b - t))))
            level, shift = best_shift(0.5 * (a + b), t)
            best.append((float(np.mean(a * b) + np.mean(t * t)) - 2.0 * level, shift))
            noise += self.noise(one[k], other[k], self.target[k], math.sqrt(max(0.0, squares[-1]))) / len(lit)
        shift = tuple(float(np.mean([s[axis] for _, s in best]) * self.scene.screen.pixel[axis]) for axis in (0, 1))
        error, shifted = (float(np.mean(np.sqrt(np.maximum(0.0, s)))) for s in (squares, [s for s, _ in best]))
        return TrialFigures(
            error, min(error, shifted), (shift[0], shift[1]), float(together[self.target > 0].sum()), float(together.sum()), noise
        )

    def shaped(self, number: int | None, which: tuple[str, ...]) -> tuple[Scene, Tensor]:
        """The scene, and control heights (n, m) mm of the exit, with a realisation of these surface errors, None for none."""
        if number is None or not which or self.surfaces is None or self.others is None:
            return self.scene, self.heights
        rng = np.random.default_rng([self.tolerances.seed, 1, number])
        heights = self.heights + self.surfaces.heights(rng, which)
        return self.others.realised(rng, which), heights

    def _rays(self, errors: Misalignment, heights: Tensor, half: int, scene: Scene | None = None) -> list[LandingPoints]:
        scene = scene or self.scene
        changed, even = errors.scene(scene), self.scene.source.parallel or self.rays > SOBOL_RAYS // 4
        kind, seed = "stratified" if even else "sobol", stream(self.tolerances.seed, f"tolerances {half}")
        rays = rays_of(changed.batch(half % 2, 2), kind, self.rays, seed)
        return list(landing_points(scene, self.field, heights, rays, errors, self.requests))

    def _image(self, parts: Iterable[LandingPoints]) -> np.ndarray:
        image = np.zeros(self.target.shape)
        for part in parts:
            found, _ = backend_for("cpu").splat(*self._placed(part), part.power, self.scene.screen, Filter())
            image[part.channel or 0] += found.numpy()
        return image

    def _placed(self, part: LandingPoints) -> tuple[Tensor, Tensor]:
        """Landing points relative to the axis, as a splat takes them, mm."""
        sx, sy = self.scene.screen.shift
        return part.x + sx, part.y + sy

    def _gain(self) -> tuple[float, float]:
        """RMS displacement on the screen along x and y per unit slope of the exit, mm, weighted by power."""
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
    """Run torch single-threaded within the block: the arrays of a draw are small, and threads would wait for each other on a busy
    machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def best_shift(image: np.ndarray, target: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Image registration: the largest cross-correlation of target and shifted image, each over its own mean, and that shift in
    pixels.

    By Fourier transform at whole pixels, with parabolic interpolation of the peak.
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


@dataclass(frozen=True)
class Sensitivity:
    """Effect of a single error.

    name, unit; sigma: its standard deviation; derivative: RMS of the derivative of the image with respect to it, over the mean of
    the image, per unit, None for a random surface; below, above: relative RMS errors at -sigma and +sigma, for a random surface
    both their mean; adds: c_k.
    """

    name: str
    unit: str
    sigma: float
    derivative: float | None
    below: float
    above: float
    adds: float


def sensitivities(trials: Trials, progress: Callable[[int], None] = lambda done: None) -> list[Sensitivity]:
    """Sensitivities to all errors, the largest contribution first."""
    square = trials.evaluate({}).relative_rms ** 2  # with the same rays, so that the noise cancels in differences
    found = ranks.mapped(partial(_sensitivity, trials, square), trials.parameters, progress)
    first = ALONE if len(trials.tolerances.surface) > 1 else 0  # a single error has the realisations of the first draws
    for name in trials.tolerances.surface:
        errors = [trials.evaluate({}, first + k, (name,)).relative_rms for k in range(REALISATIONS)]
        mean = math.sqrt(sum(e * e for e in errors) / len(errors))
        t = trials.tolerances
        sigma = t.form.rms if name == "form_error" and t.form else t.waviness.amplitude / math.sqrt(2.0) if t.waviness else 0.0
        found.append(Sensitivity(name, "mm", sigma, None, mean, mean, math.sqrt(max(0.0, mean**2 - square))))
        progress(len(found))
    return sorted(found, key=lambda s: -s.adds)


def _sensitivity(trials: Trials, square: float, p: Parameter) -> Sensitivity:
    """Sensitivity to a parameter; square: F_0^2."""
    with one_thread():
        pairs = [trials.images({(p.error, p.axis): sign * p.sigma}) for sign in (-1.0, 1.0)]
        below, above = (trials.figures_of(*pair) for pair in pairs)
    slopes = [_slope(pairs[0][half], pairs[1][half], p.sigma) for half in (0, 1)]
    derivative = math.sqrt(max(0.0, float(np.mean(slopes[0] * slopes[1]))))
    adds = 0.5 * (below.relative_rms**2 + above.relative_rms**2) - square
    return Sensitivity(p.name, p.unit, p.sigma, derivative, below.relative_rms, above.relative_rms, math.sqrt(max(0.0, adds)))


def _slope(low: np.ndarray, high: np.ndarray, sigma: float) -> np.ndarray:
    """Derivative of the image over its mean, for the colours with light."""
    pairs = [(a, b) for a, b in zip(low, high, strict=True) if min(a.sum(), b.sum()) > 0]
    return np.stack([(b / b.mean() - a / a.mean()) / (2.0 * sigma) for a, b in pairs])


@dataclass(frozen=True)
class Study:
    """Result of a tolerance analysis.

    drawn, judged: parameters (draws, k) and figures of every draw; nominal: figures without errors; unused: errors that do not
    apply to the scene, and why; by: the images, of rays or waves; checked: relative RMS of the draw at 95 %, with only the
    errors WAVED, by the warped and by its own wave image.
    """

    parameters: tuple[Parameter, ...]
    drawn: np.ndarray
    judged: tuple[TrialFigures, ...]
    nominal: TrialFigures
    sensitivities: tuple[Sensitivity, ...]
    unused: dict[str, str]
    by: str
    seed: int
    checked: tuple[float, float] | None = None

    def of(self, name: str) -> np.ndarray:
        """One figure of every draw, (draws,)."""
        return np.array([getattr(j, name) for j in self.judged])


def study(trials: Trials, progress: Callable[[str, int, int], None] = lambda what, done, whole: None) -> Study:
    """Sensitivities, then all draws.

    Raises:
        InputError: no error of the tolerances applies to the scene, or one makes the scene invalid.
    """
    t = trials.tolerances
    unused = {e.name: why for e in t.errors if (why := reason_ignored(trials.scene, e.name))}
    if not (trials.parameters or t.surface):
        raise InputError(f"no error of the tolerances applies to this scene: {'; '.join(f'{k}: {v}' for k, v in unused.items())}")
    nominal = trials.nominal()
    kinds = len(trials.parameters) + len(t.surface)
    alone = sensitivities(trials, lambda done: progress("sensitivities", done, kinds))
    drawn = hypercube(trials.parameters, t.draws, t.seed)
    judged = ranks.mapped(partial(_drawn, trials, drawn), range(len(drawn)), lambda done: progress("draws", done, t.draws))
    at = int(np.argsort([j.relative_rms for j in judged])[math.ceil(0.95 * len(judged)) - 1])
    checked = trials.check(_values(trials, drawn[at]), at)
    return Study(trials.parameters, drawn, tuple(judged), nominal, tuple(alone), unused, trials.by, t.seed, checked)


def _values(trials: Trials, row: np.ndarray) -> Values:
    """Errors by (name, axis) of a draw (k,)."""
    return {(p.error, p.axis): float(v) for p, v in zip(trials.parameters, row, strict=True)}


def _drawn(trials: Trials, drawn: np.ndarray, number: int) -> TrialFigures:
    """Figures of a draw by its number."""
    with one_thread():
        return trials.evaluate(_values(trials, drawn[number]), number)


def percentile_error(values: np.ndarray, part: float) -> float:
    """Bootstrap standard error of a percentile of independent draws; that of a Latin hypercube is smaller."""
    rng = np.random.default_rng(0)
    return float(np.quantile(rng.choice(values, (RESAMPLED, len(values))), part, axis=1).std())


def offenders(found: Study) -> list[dict]:
    """Rank correlation of the magnitude of each parameter with the error, the strongest first.

    With the mean magnitude in the worst draws, in standard deviations (about 0.8 without correlation).
    """
    error = found.of("relative_rms")
    worst = np.argsort(error)[-max(1, math.ceil(WORST * len(error))) :]
    rows = []
    for p, column in zip(found.parameters, np.abs(found.drawn).T, strict=True):
        orders = [np.argsort(np.argsort(c)) for c in (column, error)]
        rows.append(
            {
                "name": p.name,
                "correlation": float(np.corrcoef(*orders)[0, 1]),
                "in_worst": float(column[worst].mean() / p.sigma),
            }
        )
    return sorted(rows, key=lambda row: -row["correlation"])


def figures(found: Study) -> dict:
    """Figures for JSON, under `tolerances`."""

    def spread(name: str) -> dict:
        values = found.of(name)
        return {f"p{q}": float(np.quantile(values, q / 100.0)) for q in (5, 50, 95)}

    error = found.of("relative_rms")
    adds = sum(s.adds**2 for s in found.sensitivities)
    spread_of_error = spread("relative_rms") | {
        "mean_square_root": float(np.sqrt(np.mean(error**2))),
        "p95_standard_error": percentile_error(error, 0.95),
    }
    return {
        "draws": len(found.judged),
        "seed": found.seed,
        "error": spread_of_error,
        "error_by": found.by,
        "judged_by": found.by,
        "nominal": {
            "error": found.nominal.relative_rms,
            "relative_rms": found.nominal.relative_rms,
            "on_target": found.nominal.on_target,
        },
        "relative_rms": spread_of_error,
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
    """The figures as rows of a table (name, text)."""
    error, placed, light = f["relative_rms"], f["shifted_relative_rms"], f["on_target"]
    noise = f", noise {f['noise']:.2g}" if f["noise"] else ""
    table = [
        ("evaluated", f"by {f['error_by']}, {f['draws']} draws"),
        (
            "without errors",
            f"relative RMS error {f['nominal']['relative_rms']:.4f}, light on the picture {f['nominal']['on_target']:.2%},"
            f" {100.0 * f['nominal']['of_source']:.3g}% of all the source emits",
        ),
        (
            "relative RMS error",
            f"{error['p50']:.4f} (median), {error['p95']:.4f} ± {error['p95_standard_error']:.4f} (95 %){noise}",
        ),
        ("after the best shift of the screen", f"{placed['p50']:.4f} (median), {placed['p95']:.4f} (95 %)"),
        ("light on the picture", f"{light['p50']:.2%} (median), at least {light['p5']:.2%} (95 %)"),
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
    """Write parameters and figures of all draws."""
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
    """Plot the distributions of error and light over the draws, and the contribution of each error."""
    import matplotlib  # noqa: PLC0415

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415
    from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

    from caustic_cli.studies.report import COLOURS  # noqa: PLC0415

    shown = found.sensitivities[:BARS][::-1]
    figure, (error, light, bars) = plt.subplots(
        1, 3, figsize=(17.0, max(5.6, 1.6 + BAR_HEIGHT * len(shown))), constrained_layout=True
    )
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
        (placed["p50"], COLOURS[0], "--", "median, as placed"),
        (placed["p95"], COLOURS[0], "-", "95 %, as placed"),
    ):
        error.axvline(value, color=color, ls=style, label=f"{label}: {value:.3f}")
    error.set(title=f"{len(found.judged)} draws, evaluated by {f['judged_by']}", xlabel="relative RMS error", ylabel="draws")
    light.axvline(f["nominal"]["on_target"], color="k", label=f"without errors: {f['nominal']['on_target']:.4f}")
    light.axvline(f["on_target"]["p5"], color=COLOURS[0], ls="--", label=f"95 % have at least {f['on_target']['p5']:.4f}")
    light.set(title="light on the picture", xlabel="part of the source's power", ylabel="draws")
    bars.barh([f"{s.name}\n{s.sigma:.3g} {s.unit}".strip() for s in shown], [s.adds for s in shown], color=COLOURS[2])
    bars.axvline(f["nominal"]["relative_rms"], color="k", ls=":", label="error without errors")
    bars.set(title="contribution of each error of one sigma,\nin quadrature", xlabel="relative RMS error")
    bars.tick_params(axis="y", labelsize=8)
    for axis in (error, light, bars):
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, fontsize=8, frameon=False)  # below all data
    for axis in (error, light):
        axis.yaxis.set_major_locator(MaxNLocator(integer=True))
        axis.xaxis.set_major_locator(MaxNLocator(6))
    with atomic_file(path) as file:
        figure.savefig(file, format="png", dpi=100, metadata={"Software": SOFTWARE})
    plt.close(figure)
