"""What is wrong with a part, from a photograph of its caustic: maximum a posteriori by Gauss-Newton, and its uncertainty.

Notation
    y           codes of the photograph on a grid of the screen, (n, m); r = y - code of the model
    sigma^2     variance of r times the number of pixels over which r is correlated
    a_kl        prior standard deviation of the amplitude of mode (k, l) of the deviation, mm: A (1 + (k^2 + l^2) / q^2)^(-p / 2),
                a Sobolev prior; piston has none
    J           derivatives of the codes by all unknowns, with modes counted in units of a_kl
    C           covariance of all unknowns, (J^T J / sigma^2 + P)^-1, with P the inverse of the prior covariance; or that by
                clustered misses, if it is larger

A, p and q are those of the largest evidence (MacKay, Bayesian interpolation, Neural Computation 4, 1992), with all other unknowns
integrated over.  The response of the camera is fitted alone before every level; jointly with the rest it follows too slowly.
Levels go from coarse pixels and few modes to fine pixels and all modes.  The camera is known from its marks up to a covariance,
which is its prior.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular
from scipy.ndimage import gaussian_filter

from caustic_cli.studies.photograph.model import Grid, Guess, PartModel, Prediction, Response, Window, cosines, heights_at

#: Pixels along the longer side, modes along each axis, blur in pixels and most steps of the levels; modes are capped by the last.
LEVELS = ((32, 6, 1.0, 4), (64, 12, 1.0, 4), (128, 20, 0.7, 4))
#: Part of the screen around the light of the lens that is compared, half widths; light below which the screen counts as dark, over
#: the mean.
MARGIN, DARK = 0.12, 0.02
#: Prior standard deviations: of s - 1, of the background, and of the logarithms of gain, gamma (about 2.2) and blur (about 1 %).
SCALE, BACKGROUND, GAIN, GAMMA, BLUR = 0.02, 0.2, 2.0, 0.4, 1.5
#: Sobolev priors that are compared: A in mm, p, q.
AMPLITUDES, POWERS, CORNERS = 10.0 ** np.arange(-6.0, -0.99, 0.25), (2.0, 3.0, 4.0, 6.0), (1.0, 2.0, 4.0, 8.0)
#: Points along each axis at which the deviation is summed up.
SAMPLES = 33
#: The prior at first.
FIRST = (3e-3, 3.0, 2.0)
#: Least standard deviation of a code: of 8 bits.
ROUNDING = 1.0 / 255.0 / np.sqrt(12.0)
#: Most pixels over which misses count as correlated while the part is fitted: before, they are correlated widely.
FEW = 9.0
#: Pixels along each side of the blocks over which misses are summed for the covariance.
BLOCK = 8
#: Halvings of a step that does not help, and relative change of the objective at which a level ends.
HALVINGS, ENOUGH = 4, 1e-3


@dataclass(frozen=True)
class Sobolev:
    """The prior of the deviation: A mm, p, q."""

    amplitude: float = FIRST[0]
    power: float = FIRST[1]
    corner: float = FIRST[2]

    def deviations(self, count: int) -> np.ndarray:
        """a_kl (count, count) mm; piston 0."""
        k = np.arange(count)
        a = self.amplitude * (1.0 + (k[:, None] ** 2 + k[None, :] ** 2) / self.corner**2) ** (-0.5 * self.power)
        a[0, 0] = 0.0
        return a


@dataclass(frozen=True, eq=False)
class Knowledge:
    """What is known of a camera before: mean and covariance of the amplitudes c, half widths of the screen."""

    covariance: np.ndarray
    shift: bool = True

    @property
    def precision(self) -> np.ndarray:
        """Inverse of the covariance, with rounding of 1e-5 half widths."""
        return np.linalg.inv(self.covariance + 1e-10 * np.eye(len(self.covariance)))


@dataclass(eq=False)
class Inference:
    """What was inferred."""

    model: PartModel
    guess: Guess
    prior: Sobolev
    #: Covariance of response (4), c (9), s (1) and the modes in mm, flattened.
    covariance: np.ndarray
    #: Standard deviation of r, and number of pixels over which it is correlated.
    residual: float
    correlated: float
    #: Fraction of the variance of the codes that the model explains.
    explained: float
    #: The photograph and the model on the last grid, (n, m) codes, and its window of the screen.
    seen: np.ndarray
    predicted: np.ndarray
    window: Window

    @property
    def scale(self) -> tuple[float, float]:
        """Relief scale and its standard deviation."""
        return 1.0 + self.guess.scale, float(np.sqrt(self.covariance[13, 13]))

    def draws(self, count: int, seed: int = 0) -> list[Guess]:
        """Guesses drawn from the posterior of the surface: scale and modes."""
        part = self.covariance[13:, 13:]
        values, vectors = np.linalg.eigh(part)
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        rng, found = np.random.default_rng(seed), []
        for _ in range(count):
            step = root @ rng.standard_normal(len(part))
            modes = self.guess.modes + step[1:].reshape(self.guess.modes.shape)
            found.append(replace(self.guess, scale=self.guess.scale + step[0], modes=modes))
        return found

    @cached_property
    def _values(self) -> np.ndarray:
        """The relief and the modes at points of the aperture, less their means, (SAMPLES^2, 1 + modes)."""
        at, field = np.linspace(0.0, 1.0, SAMPLES), self.model.field
        c = cosines(at, len(self.guess.modes))
        x, y = ((2.0 * at - 1.0) * r for r in field.half_size)
        relief = heights_at(field, self.model.heights, x, y).reshape(-1, 1)
        values = np.concatenate([relief, np.einsum("xk,yl->xykl", c, c).reshape(SAMPLES**2, -1)], 1)
        return values - values.mean(0)

    def rms(self) -> tuple[float, float]:
        """RMS over the aperture's rectangle of the deviation, that by the relief's scale included, about its mean, mm, and its
        standard deviation."""
        d = self._values @ np.append(self.guess.scale, self.guess.modes)
        size = float(np.sqrt((d * d).mean()))
        by_mode = self._values.T @ d / (len(d) * max(size, 1e-12))
        return size, float(np.sqrt(by_mode @ self.covariance[13:, 13:] @ by_mode))

    @cached_property
    def spread(self) -> np.ndarray:
        """Standard deviation of that deviation at points of the aperture, (SAMPLES, SAMPLES) mm."""
        variance = np.einsum("pi,pi->p", self._values @ self.covariance[13:, 13:], self._values)
        return np.sqrt(np.clip(variance, 0.0, None)).reshape(SAMPLES, SAMPLES)

    def uncertainty(self) -> float:
        """RMS over the aperture of the standard deviation of the deviation, mm."""
        return float(np.sqrt(np.square(self.spread).mean()))


def infer(
    model: PartModel,
    photograph: Callable[[tuple[int, int], Window], np.ndarray],
    camera: Knowledge,
    *,
    levels: tuple[tuple[int, int, float, int], ...] = LEVELS,
    shape_free: bool = True,
    show: Callable[[int, int], None] = lambda done, whole: None,
) -> Inference:
    """Infer the deviation of a part, the scale of its relief, and what remains unknown of the camera.

    Args:
        photograph: codes on n x m pixels of a window of the screen, NaN where they are not known.
        camera: what its marks leave unknown.
        shape_free: False fits the camera alone, for a part as designed.
        show: told of steps done, of how many.
    """
    guess = Guess(Response(), np.zeros(9), 0.0, np.zeros((levels[0][1],) * 2))
    prior, done, whole = Sobolev(), 0, sum(level[3] for level in levels)
    fit: _Fit | None = None
    window = lit(model)
    (rx, ry), (wide, high) = model.scene.screen.half_size, (b - a for a, b in window)
    aspect = high * ry / (wide * rx)
    for side, modes, smooth, steps in levels:
        shape = (side, max(8, round(side * aspect))) if aspect <= 1 else (max(8, round(side / aspect)), side)
        fit = _Fit(model, Grid(shape, smooth, window), photograph(shape, window), camera, shape_free, side > levels[0][0])
        model.trace(guess)
        guess = fit.with_response(guess.with_modes(modes if shape_free else 1))
        for k in range(steps):
            guess, prior, ends = fit.step(guess, prior)
            done += 1
            show(done, whole)
            if ends and k > 0:
                done += steps - k - 1
                break
    assert fit is not None
    return fit.result(guess, prior)


def lit(model: PartModel) -> Window:
    """The part of the screen where light of the designed surface is, with a margin."""
    at, found = model.designed, []
    light = np.histogram2d(at.x, at.y, [np.linspace(-1.0, 1.0, 65)] * 2, weights=at.power)[0]
    for axis in (0, 1):
        bright = np.flatnonzero((light > DARK * light.mean()).any(1 - axis))
        low, high = (2.0 * k / 64.0 - 1.0 for k in (bright[0], bright[-1] + 1))
        found.append((max(-1.0, low - MARGIN), min(1.0, high + MARGIN)))
    return found[0], found[1]


class _Fit:
    """Gauss-Newton on one grid."""

    def __init__(self, model: PartModel, grid: Grid, seen: np.ndarray, camera: Knowledge, shape_free: bool, by_evidence: bool):
        self.model, self.grid, self.free, self.by_evidence = model, grid, shape_free, by_evidence
        self.known = np.isfinite(seen)
        filled = np.where(self.known, seen, np.nanmean(seen))
        self.seen = gaussian_filter(filled, grid.smooth, mode="nearest", truncate=3.5)
        self.camera = camera.precision
        #: Pixels over which misses are correlated, and the standard deviation of a pixel times the root of that.
        self.correlated, self.sigma = 1.0, 0.05

    # Priors

    def _before(self, guess: Guess) -> tuple[np.ndarray, np.ndarray]:
        """Precision (14, 14) of response, c and s before, and their values relative to the mean."""
        start, precision = Response(), np.zeros((14, 14))
        precision[range(4), range(4)] = np.array([GAIN, BACKGROUND, GAMMA, BLUR]) ** -2.0
        precision[4:13, 4:13] = self.camera
        precision[13, 13] = SCALE**-2.0
        return precision, np.concatenate([guess.response.values - start.values, guess.camera, [guess.scale]])

    def _cost(self, prediction: Prediction, prior: Sobolev) -> float:
        """Negative logarithm of the posterior, up to a constant."""
        precision, values = self._before(prediction.guess)
        a, w = prior.deviations(len(prediction.guess.modes)), prediction.guess.modes
        return 0.5 * float(
            (self._misses(prediction) ** 2).sum() / self.sigma**2
            + values @ precision @ values
            + (np.divide(w, a, out=np.zeros_like(w), where=a > 0) ** 2).sum()
        )

    def _misses(self, prediction: Prediction) -> np.ndarray:
        return np.where(self.known, self.seen - prediction.codes, 0.0)

    # Steps

    def with_response(self, guess: Guess, steps: int = 8) -> Guess:
        """The guess with the response fitted alone."""
        prediction = Prediction.of(self.model, self.grid, guess)
        for _ in range(steps):
            self._estimate(prediction)
            J = prediction.by_response()[:, self.known]  # (4, N)
            precision, values = self._before(prediction.guess)
            A = J @ J.T / self.sigma**2 + precision[:4, :4]
            b = J @ self._misses(prediction)[self.known] / self.sigma**2 - precision[:4, :4] @ values[:4]
            before = self._cost(prediction, Sobolev())
            better = self._search(prediction, Sobolev(), np.concatenate([np.linalg.solve(A, b), np.zeros(10)]), None, before)
            if better is None:
                break
            after = self._cost(better, Sobolev())
            prediction = better
            if before - after < ENOUGH * before:
                break
        return prediction.guess

    def _moved(self, guess: Guess, step: np.ndarray, modes: np.ndarray | None, part: float) -> Guess:
        r = guess.response
        values = r.values + np.clip(part * step[:4], -1.0, 1.0)
        values[1] = np.clip(values[1], 0.0, 0.5)
        values[3] = np.clip(values[3], np.log(0.3 / 128), np.log(0.2))
        w = guess.modes if modes is None else guess.modes + part * modes
        return replace(
            guess,
            response=Response(*map(float, values)),
            camera=guess.camera + part * step[4:13],
            scale=guess.scale + part * step[13],
            modes=w,
        )

    def _search(
        self, prediction: Prediction, prior: Sobolev, step: np.ndarray, modes: np.ndarray | None, before: float
    ) -> Prediction | None:
        """The prediction after a step, or the largest half of it that lowers the cost; None if none does."""
        part = 1.0
        for _ in range(HALVINGS):
            guess = self._moved(prediction.guess, step, modes, part)
            same = modes is None and step[13] == 0
            tried = Prediction.of(self.model, self.grid, guess, prediction.landing if same else None)
            if self._cost(tried, prior) < before:
                return tried
            part *= 0.5
        return None

    def _estimate(self, prediction: Prediction, final: bool = False) -> None:
        """sigma from the misses of a prediction."""
        misses = self._misses(prediction)
        spectrum = np.abs(np.fft.rfft2(misses, [2 * n for n in misses.shape])) ** 2
        along = np.fft.irfft2(spectrum)[: misses.shape[0] // 2, : misses.shape[1] // 2]
        along = along / max(along[0, 0], 1e-300)
        # the area of the autocorrelation, along each axis until it falls below a tenth
        lengths = [
            1.0 + 2.0 * line[1 : 1 + int(np.argmax(np.append(line[1:], 0.0) < 0.1))].sum() for line in (along[:, 0], along[0])
        ]
        self.correlated = float(np.clip(lengths[0] * lengths[1], 1.0, np.inf if final else FEW))
        size = float(np.sqrt((misses**2).sum() / max(self.known.sum(), 1)))
        self.sigma = max(size, ROUNDING) * np.sqrt(self.correlated)

    def step(self, guess: Guess, prior: Sobolev) -> tuple[Guess, Sobolev, bool]:
        """A step of all unknowns; the guess, the prior of the largest evidence there, and whether the fit has converged."""
        prediction = Prediction.of(self.model, self.grid, guess)
        self._estimate(prediction)
        normal, pull = self._normal(prediction)
        if self.free and self.by_evidence:
            prior = self._best_prior(guess, normal, pull, prior)
        before = self._cost(prediction, prior)
        solution = self._solve(guess, normal, pull, prior)[0]
        step, modes = self._step_of(guess, solution)
        better = self._search(prediction, prior, step, modes, before)
        if better is None:
            return guess, prior, True
        return better.guess, prior, before - self._cost(better, prior) < ENOUGH * before

    def _derivatives(self, prediction: Prediction) -> np.ndarray:
        """Derivatives of the codes by all unknowns, (unknowns, n, m), 0 where the photograph is not known."""
        J = np.concatenate([prediction.by_response(), *prediction.by_shape()]) * self.known
        if not self.free:
            J[13:] = 0.0
        return J

    def _normal(self, prediction: Prediction) -> tuple[np.ndarray, np.ndarray]:
        """J^T J / sigma^2 by response, c, s and modes in mm, and J^T (r + J x) / sigma^2 with x their values, those of the response
        relative to the guess."""
        J, guess = self._derivatives(prediction)[:, self.known], prediction.guess  # (unknowns, N)
        x = np.concatenate([np.zeros(4), guess.camera, [guess.scale], guess.modes.ravel()])
        r = self._misses(prediction)[self.known] + x @ J
        return J @ J.T / self.sigma**2, J @ r / self.sigma**2

    def _system(
        self, guess: Guess, normal: np.ndarray, pull: np.ndarray, prior: Sobolev
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The regularised normal equations in units of the prior, their right-hand side, and those units."""
        precision, values = self._before(guess)
        unit = np.append(np.ones(14), prior.deviations(len(guess.modes)).ravel())
        A = normal * np.outer(unit, unit)
        A[14:, 14:][np.diag_indices(len(unit) - 14)] += 1.0
        A[:14, :14] += precision
        b = pull * unit
        b[:4] -= precision[:4, :4] @ values[:4]  # the response counts from the guess
        return A, b, unit

    def _solve(self, guess: Guess, normal: np.ndarray, pull: np.ndarray, prior: Sobolev) -> tuple[np.ndarray, float, tuple]:
        """Solution in natural units, logarithm of the evidence, and the factor with its units."""
        A, b, unit = self._system(guess, normal, pull, prior)
        factor = cho_factor(A, lower=True)
        half = solve_triangular(factor[0], b, lower=True)
        evidence = 0.5 * float(half @ half) - float(np.log(np.diag(factor[0])).sum())
        return cho_solve(factor, b) * unit, evidence, (factor, unit)

    def _step_of(self, guess: Guess, solution: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step = solution[:14].copy()
        step[4:13] -= guess.camera
        step[13] -= guess.scale
        return step, solution[14:].reshape(guess.modes.shape) - guess.modes

    def _best_prior(self, guess: Guess, normal: np.ndarray, pull: np.ndarray, now: Sobolev) -> Sobolev:
        """The prior of the largest evidence: over A, p and q near the present ones, and all of them coarsely."""
        best, most = now, -np.inf
        for amplitude, power, corner in product(AMPLITUDES[::2], POWERS, CORNERS):
            tried = Sobolev(float(amplitude), power, corner)
            try:
                evidence = self._solve(guess, normal, pull, tried)[1]
            except LinAlgError:
                continue
            if evidence > most:
                best, most = tried, evidence
        return best

    def _clustered(self, prediction: Prediction, covariance: np.ndarray, unit: np.ndarray) -> np.ndarray:
        """The covariance in units of the prior by misses where they are, summed over BLOCKs of pixels, not by a common variance:
        errors of the model gather where the derivatives are large (White, Econometrica 48, 817, 1980; Liang and Zeger, Biometrika
        73, 13, 1986)."""
        scores = self._derivatives(prediction) * self._misses(prediction) / self.sigma**2
        n, m = (size // BLOCK * BLOCK for size in self.grid.shape)
        blocks = scores[:, :n, :m].reshape(len(unit), n // BLOCK, BLOCK, m // BLOCK, BLOCK).sum((2, 4)).reshape(len(unit), -1)
        blocks = blocks * unit[:, None]
        middle = blocks @ blocks.T
        middle[14:, 14:][np.diag_indices(len(unit) - 14)] += 1.0
        middle[:14, :14] += self._before(prediction.guess)[0]
        return covariance @ middle @ covariance

    def result(self, guess: Guess, prior: Sobolev) -> Inference:
        """The inference at a guess."""
        prediction = Prediction.of(self.model, self.grid, guess)
        self._estimate(prediction, final=True)
        normal, pull = self._normal(prediction)
        _, _, (factor, unit) = self._solve(guess, normal, pull, prior)
        covariance = cho_solve(factor, np.eye(len(unit)))
        covariance = max(covariance, self._clustered(prediction, covariance, unit), key=np.trace) * np.outer(unit, unit)
        misses, seen = self._misses(prediction)[self.known], self.seen[self.known]
        return Inference(
            self.model,
            guess,
            prior,
            covariance,
            float(misses.std()),
            self.correlated,
            1.0 - float((misses**2).mean() / max(seen.var(), 1e-300)),
            self.seen,
            prediction.codes,
            self.grid.window,
        )
