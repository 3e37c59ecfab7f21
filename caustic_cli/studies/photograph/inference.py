"""What is wrong with a part, from photographs of its caustic: maximum a posteriori by Gauss-Newton, and its uncertainty.

Notation
    y           codes of the photograph on a grid of the screen, (n, m); r = y - code of the model
    sigma^2     variance of r times the number of pixels over which r is correlated
    a_kl        prior standard deviation of the amplitude of mode (k, l) of the deviation, mm: A (1 + (k^2 + l^2) / q^2)^(-p / 2),
                a Sobolev prior; that of tilt is as of a part that is mounted, piston has none
    J           derivatives of the codes by all unknowns, with modes counted in units of a_kl
    C           covariance of all unknowns, (J^T J / sigma^2 + P)^-1, with P the inverse of the prior covariance; and that by
                clustered misses, of each unknown the larger variance

A, p and q are those of the largest evidence (MacKay, Bayesian interpolation, Neural Computation 4, 1992), with all other unknowns
integrated over.  The response of the camera is fitted alone before every level; jointly with the rest it follows too slowly.
Levels go from coarse pixels and few modes to fine pixels and as many modes as the prior asks for.  The finest leave out pixels of
which a part is saturated: the mean of what was cut off is not the mean of the light.  The camera is known from its marks up to a
covariance, which is its prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

from caustic_cli.studies.photograph.model import (
    Grid,
    Guess,
    Landing,
    PartModel,
    Prediction,
    Response,
    View,
    Window,
    cosines,
    heights_at,
)

#: Pixels along the longer side, modes along each axis, blur in pixels and most steps of the levels; modes are capped by the last.
LEVELS = ((32, 6, 1.0, 4), (64, 12, 1.0, 4), (128, 20, 0.7, 8), (128, 32, 0.7, 6))
#: Part of the variance of the deviation's curvature beyond the modes of a level from which on the next one takes more for the same
#: pixels.
LEFT = 0.01
#: Part of the screen around the light of the lens that is compared, half widths; light below which the screen counts as dark, over
#: the mean.
MARGIN, DARK = 0.12, 0.02
#: Prior standard deviations: of s - 1, of the background, and of the logarithms of gain, gamma (about 2.2) and blur (about 1 %).
SCALE, BACKGROUND, GAIN, GAMMA, BLUR = 0.02, 0.2, 2.0, 0.4, 1.5
#: The same of the place of the part along the axis, over the throw, and of each measured throw, mm; part by which throws differ at
#: least in order to tell the place from the scale of the relief.
PLACE, MEASURED, APART = 0.02, 0.5, 0.02
#: Pixels of a grid by which the model itself may displace an image, as by the shape of its pixels: standard deviation of each of B.
OFF = 0.02
#: Number of unknowns of each photograph: response, c and t.
OWN = 14
#: Sobolev priors that are compared: A in mm, p, q.
AMPLITUDES, POWERS, CORNERS = 10.0 ** np.arange(-6.0, -0.99, 0.5), (2.0, 3.0, 4.0, 6.0), (1.0, 2.0, 4.0, 8.0, 16.0)
#: Modes along each axis beyond which only priors next to the present one are compared.
FINE = 24
#: Prior standard deviation of tilt, mm.
TILT = 0.02
#: Points along each axis at which the deviation is summed up.
SAMPLES = 33
#: The prior at first.
FIRST = (3e-3, 3.0, 2.0)
#: Least standard deviation of a code: of 8 bits.
ROUNDING = 1.0 / 255.0 / np.sqrt(12.0)
#: Most pixels over which misses count as correlated in a fit: those of a model that does not fit yet are correlated widely.
FEW = 9.0
#: Blocks along the longer side over whose pixels misses are summed for the covariance, of 8 pixels each on the last grid.
BLOCKS = 16
#: Least part of its misses that a block of pixels keeps in a fit to it.
LEVERAGE = 0.02
#: Modes follow the relief but for its finest details, so that those tell its scale, for which the model's contrast has to be right:
#: factor of the standard deviation of s and what is added to it, so that they cover 100 parts (tests/benchmarks).
EXCHANGED, CONTRAST = 2.0, 4e-3
#: Part of a photograph's variance that the part's own deviation explains: of 30 random parts with marks (0.5 to 6 µm over 0.08 to
#: 0.4 of a lens of 10 mm) the 23 whose surface was within what is said explained 99.955 % and more, the 7 others, off by 2.5 to 6
#: times what is said, 99.8 % at most.
FOUND = 0.9995
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
        if count > 1:  # neither says anything of how the part is mounted
            a[0, 1] = a[1, 0] = max(TILT, a[0, 1])
        return a


@dataclass(frozen=True, eq=False)
class Observation:
    """A photograph of the part: the model of its light and screen; its codes on n x m pixels of a window of the screen, averaged as
    light by this gamma and B-splines, NaN where they are not known, or, without the last argument, not even about; and the
    covariance (9, 9) of the amplitudes c that its marks leave, half widths of the screen."""

    model: PartModel
    photograph: Callable[[tuple[int, int], Window, float, bool], np.ndarray]
    covariance: np.ndarray

    def precision(self, side: int) -> np.ndarray:
        """Inverse of the covariance, with what the model is off by itself on a grid of `side` pixels."""
        return np.linalg.inv(self.covariance + (2.0 * OFF / side) ** 2 * np.eye(len(self.covariance)))


@dataclass(frozen=True, eq=False)
class Fitted:
    """How the model fits a photograph."""

    #: Standard deviation of r, and number of pixels over which it is correlated.
    residual: float
    correlated: float
    #: Fraction of the variance of the codes that the model explains.
    explained: float
    #: The photograph and the model on the last grid, (n, m) codes, and its window of the screen.
    seen: np.ndarray
    predicted: np.ndarray
    window: Window


@dataclass(eq=False)
class Inference:
    """What was inferred."""

    #: That of the first photograph.
    model: PartModel
    guess: Guess
    prior: Sobolev
    #: Covariance of the unknowns of each photograph, response (4), c (9) and t; s (1) and the modes in mm, flattened.
    covariance: np.ndarray
    #: Of each photograph.
    fits: tuple[Fitted, ...]

    @property
    def explained(self) -> float:
        """Least fraction of the variance of a photograph that the model explains."""
        return min(fit.explained for fit in self.fits)

    @property
    def ended(self) -> bool:
        """Whether the fit ended on the part's own deviation: Gauss-Newton from the design need not, where light is folded finely,
        and its uncertainty is then that of another surface."""
        return self.explained >= FOUND

    @property
    def throws_free(self) -> bool:
        """Whether the throws are fitted."""
        return bool((self.covariance.diagonal()[OWN - 1 : OWN * len(self.fits) : OWN] > 1e-11).any())

    @property
    def of_part(self) -> np.ndarray:
        """Covariance of s and the modes."""
        shared = OWN * len(self.guess.views)
        return self.covariance[shared:, shared:]

    def of_view(self, number: int) -> np.ndarray:
        """Standard deviations of the unknowns of a photograph, (OWN,)."""
        return np.sqrt(np.diag(self.covariance)[OWN * number : OWN * (number + 1)])

    @property
    def scale(self) -> tuple[float, float]:
        """Relief scale and its standard deviation."""
        return 1.0 + self.guess.scale, float(np.sqrt(self.of_part[0, 0]))

    def draws(self, count: int, seed: int = 0) -> list[Guess]:
        """Guesses drawn from the posterior of the surface: scale and modes."""
        part = self.of_part
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
        return size, float(np.sqrt(by_mode @ self.of_part @ by_mode))

    @cached_property
    def spread(self) -> np.ndarray:
        """Standard deviation of that deviation at points of the aperture, (SAMPLES, SAMPLES) mm."""
        variance = np.einsum("pi,pi->p", self._values @ self.of_part, self._values)
        return np.sqrt(np.clip(variance, 0.0, None)).reshape(SAMPLES, SAMPLES)

    def uncertainty(self) -> float:
        """RMS over the aperture of the standard deviation of the deviation, mm."""
        return float(np.sqrt(np.square(self.spread).mean()))


def infer(
    observations: Sequence[Observation],
    *,
    levels: tuple[tuple[int, int, float, int], ...] | None = None,
    show: Callable[[int, int], None] = lambda done, whole: None,
) -> Inference:
    """Infer the deviation of a part, the scale of its relief, and what remains unknown of each photograph.

    Args:
        observations: photographs of the part, at least one.
        levels: as of LEVELS, which are the default.
        show: told of steps done, of how many.
    """
    levels = levels or LEVELS
    views = tuple(View(Response(), np.zeros(9)) for _ in observations)
    guess = Guess(views, 0.0, np.zeros((levels[0][1],) * 2))
    prior, done, whole = Sobolev(), 0, sum(level[3] for level in levels)
    fit: _Fit | None = None
    windows = [lit(one.model) for one in observations]
    for k, (side, modes, smooth, steps) in enumerate(levels):
        if k > 0 and side == levels[k - 1][0] and not asked(prior, levels[k - 1][1], modes):
            done += steps
            continue
        fit = _Fit(
            [
                _Seen(one, side, smooth, window, view.response, side == levels[-1][0])
                for one, window, view in zip(observations, windows, guess.views, strict=True)
            ],
            side > levels[0][0],
        )
        guess = fit.with_response(fit.traced(guess).with_modes(modes))
        for step in range(steps):
            guess, prior, ends = fit.step(guess, prior)
            done += 1
            show(done, whole)
            if ends and step > 0:
                done += steps - step - 1
                break
    assert fit is not None
    return fit.result(guess, prior)


def near(every: Sequence[float], at: float, only: bool) -> list[float]:
    """All of some values, or only the closest one to `at` and its neighbours."""
    k = int(np.argmin([abs(np.log(value / at)) for value in every])) if only else 0
    return list(every[max(0, k - 1) : k + 2] if only else every)


def asked(prior: Sobolev, count: int, more: int) -> bool:
    """Whether a prior expects more than LEFT of the variance of curvature, by which light is concentrated, beyond `count` modes."""
    k2 = np.add.outer(np.arange(more) ** 2, np.arange(more) ** 2)
    variance = np.square(prior.deviations(more) * k2)
    return bool(1.0 - variance[:count, :count].sum() / variance.sum() > LEFT)


def throws_before(models: Sequence[PartModel]) -> np.ndarray:
    """Covariance (N, N) of t, mm^2: of the place of the part, the same for all, and of each measurement; 0 but for rounding for
    photographs at one distance, which tell it from the scale of the relief no more than a single one does."""
    screens = [model.scene.screen for model in models]
    z = np.array([screen.z for screen in screens])
    free = float(np.ptp(z) > APART * np.abs(z).max() and not any(screen.far for screen in screens))
    return free * ((PLACE * z.mean()) ** 2 + MEASURED**2 * np.eye(len(z))) + 1e-12 * np.eye(len(z))


def lit(model: PartModel) -> Window:
    """The part of the screen where light of the designed surface is, with a margin."""
    at, found = model.designed, []
    light = np.histogram2d(at.x, at.y, [np.linspace(-1.0, 1.0, 65)] * 2, weights=at.power)[0]
    for axis in (0, 1):
        bright = np.flatnonzero((light > DARK * light.mean()).any(1 - axis))
        low, high = (2.0 * k / 64.0 - 1.0 for k in (bright[0], bright[-1] + 1))
        found.append((max(-1.0, low - MARGIN), min(1.0, high + MARGIN)))
    return found[0], found[1]


class _Seen:
    """A photograph on one grid; exact: with more rays, and without pixels that are known about only, which coarse fits need to find
    their way."""

    def __init__(self, observation: Observation, side: int, smooth: float, window: Window, response: Response, exact: bool = True):
        self.model, self.camera, self.exact = observation.model, observation.precision(side), exact
        (rx, ry), (wide, high) = self.model.scene.screen.half_size, (b - a for a, b in window)
        aspect = high * ry / (wide * rx)
        shape = (side, max(8, round(side * aspect))) if aspect <= 1 else (max(8, round(side / aspect)), side)
        seen = observation.photograph(shape, window, float(np.exp(response.log_gamma)), exact)
        self.known = np.isfinite(seen)
        self.grid = Grid(shape, smooth, window, self.model, self.known)
        self.seen = self.grid.compared(np.nan_to_num(seen))
        #: Pixels over which misses are correlated, and the standard deviation of a pixel times the root of that.
        self.correlated, self.sigma = 1.0, 0.05

    def light(self, guess: Guess, number: int) -> Landing | None:
        """Rays of a prediction, None for those of its derivatives."""
        return self.model.light(guess, guess.views[number].throw) if self.exact else None

    def misses(self, prediction: Prediction) -> np.ndarray:
        """r, 0 where it is not known."""
        return np.where(self.known, self.seen - prediction.codes, 0.0)

    def estimate(self, prediction: Prediction, most: float = FEW) -> None:
        """sigma from the misses of a prediction, which count as correlated over so many pixels at most."""
        misses = self.misses(prediction)
        spectrum = np.abs(np.fft.rfft2(misses, [2 * n for n in misses.shape])) ** 2
        along = np.fft.irfft2(spectrum)[: misses.shape[0] // 2, : misses.shape[1] // 2]
        along = along / max(along[0, 0], 1e-300)
        # the area of the autocorrelation, along each axis until it falls below a tenth
        lengths = [
            1.0 + 2.0 * line[1 : 1 + int(np.argmax(np.append(line[1:], 0.0) < 0.1))].sum() for line in (along[:, 0], along[0])
        ]
        self.correlated = float(np.clip(lengths[0] * lengths[1], 1.0, most))
        size = float(np.sqrt((misses**2).sum() / max(self.known.sum(), 1)))
        self.sigma = max(size, ROUNDING) * np.sqrt(self.correlated)

    def fitted(self, prediction: Prediction) -> Fitted:
        """How well a prediction fits."""
        misses, seen = self.misses(prediction)[self.known], self.seen[self.known]
        explained = 1.0 - float((misses**2).mean() / max(seen.var(), 1e-300))
        return Fitted(float(misses.std()), self.correlated, explained, self.seen, prediction.codes, self.grid.window)


class _Fit:
    """Gauss-Newton on one grid for each photograph."""

    def __init__(self, seen: Sequence[_Seen], by_evidence: bool):
        self.seen, self.by_evidence, self.shared = seen, by_evidence, OWN * len(seen)

    def traced(self, guess: Guess) -> Guess:
        """The guess, whose surface is then traced itself."""
        for model in {id(one.model): one.model for one in self.seen}.values():
            model.trace(guess)
        return guess

    def predictions(self, guess: Guess) -> list[Prediction]:
        """Of all photographs."""
        return [Prediction.of(one.model, one.grid, guess, k, one.light(guess, k)) for k, one in enumerate(self.seen)]

    def _at(self, number: int, modes: int) -> np.ndarray:
        """Indices of the unknowns on which a photograph depends, in the order of its derivatives."""
        return np.concatenate([OWN * number + np.arange(OWN), self.shared + np.arange(1 + modes)])

    # Priors

    def _before(self, guess: Guess) -> tuple[np.ndarray, np.ndarray]:
        """Precision of all unknowns but the modes before, and their values relative to the mean."""
        start, precision = View(Response(), np.zeros(9)).values, np.zeros((self.shared + 1,) * 2)
        for k, one in enumerate(self.seen):
            i = OWN * k
            precision[range(i, i + 4), range(i, i + 4)] = np.array([GAIN, BACKGROUND, GAMMA, BLUR]) ** -2.0
            precision[i + 4 : i + 13, i + 4 : i + 13] = one.camera
        throws = OWN * np.arange(len(self.seen)) + OWN - 1
        precision[np.ix_(throws, throws)] = np.linalg.inv(throws_before([one.model for one in self.seen]))
        precision[-1, -1] = SCALE**-2.0
        return precision, np.concatenate([*(view.values - start for view in guess.views), [guess.scale]])

    def _cost(self, predictions: Sequence[Prediction], prior: Sobolev) -> float:
        """Negative logarithm of the posterior, up to a constant."""
        guess = predictions[0].guess
        precision, values = self._before(guess)
        a, w = prior.deviations(len(guess.modes)), guess.modes
        fit = sum(float((one.misses(p) ** 2).sum() / one.sigma**2) for one, p in zip(self.seen, predictions, strict=True))
        return 0.5 * float(fit + values @ precision @ values + (np.divide(w, a, out=np.zeros_like(w), where=a > 0) ** 2).sum())

    # Steps

    def with_response(self, guess: Guess, steps: int = 8) -> Guess:
        """The guess with the responses fitted alone."""
        light = [one.light(guess, k) for k, one in enumerate(self.seen)]

        def predicted(guess: Guess) -> list[Prediction]:
            return [Prediction.of(one.model, one.grid, guess, k, light[k]) for k, one in enumerate(self.seen)]

        predictions = predicted(guess)
        for _ in range(steps):
            precision, values = self._before(guess)
            step = np.zeros(self.shared + 1)
            for k, (one, prediction) in enumerate(zip(self.seen, predictions, strict=True)):
                one.estimate(prediction)
                J, i = prediction.by_response()[:, one.known], slice(OWN * k, OWN * k + 4)  # (4, N)
                A = J @ J.T / one.sigma**2 + precision[i, i]
                step[i] = np.linalg.solve(A, J @ one.misses(prediction)[one.known] / one.sigma**2 - precision[i, i] @ values[i])
            before = self._cost(predictions, Sobolev())
            better = self._search(guess, step, None, before, Sobolev(), predicted)
            if better is None:
                break
            predictions, guess = better, better[0].guess
            if before - self._cost(predictions, Sobolev()) < ENOUGH * before:
                break
        return guess

    def _moved(self, guess: Guess, step: np.ndarray, modes: np.ndarray | None, part: float) -> Guess:
        views = []
        for k, view in enumerate(guess.views):
            own = part * step[OWN * k : OWN * (k + 1)]
            values = view.response.values + np.clip(own[:4], -1.0, 1.0)
            values[1] = np.clip(values[1], 0.0, 0.5)
            values[3] = np.clip(values[3], np.log(0.3 / 128), np.log(0.2))
            views.append(View(Response(*map(float, values)), view.camera + own[4:13], view.throw + float(own[13])))
        w = guess.modes if modes is None else guess.modes + part * modes
        return Guess(tuple(views), guess.scale + part * step[-1], w)

    def _search(
        self,
        guess: Guess,
        step: np.ndarray,
        modes: np.ndarray | None,
        before: float,
        prior: Sobolev,
        predicted: Callable[[Guess], list[Prediction]],
    ) -> list[Prediction] | None:
        """The predictions after a step, or the largest half of it that lowers the cost; None if none does."""
        part = 1.0
        for _ in range(HALVINGS):
            tried = predicted(self._moved(guess, step, modes, part))
            if self._cost(tried, prior) < before:
                return tried
            part *= 0.5
        return None

    def step(self, guess: Guess, prior: Sobolev) -> tuple[Guess, Sobolev, bool]:
        """A step of all unknowns; the guess, the prior of the largest evidence there, and whether the fit has converged."""
        predictions = self.predictions(self.traced(guess))
        for one, prediction in zip(self.seen, predictions, strict=True):
            one.estimate(prediction)
        normal, pull = self._normal(predictions)
        if self.by_evidence:
            prior = self._best_prior(guess, normal, pull, prior)
        before = self._cost(predictions, prior)
        solution = self._solve(guess, normal, pull, prior)[0]
        step, modes = self._step_of(guess, solution)
        better = self._search(guess, step, modes, before, prior, self.predictions)
        if better is None:
            return guess, prior, True
        return better[0].guess, prior, before - self._cost(better, prior) < ENOUGH * before

    def _derivatives(self, number: int, prediction: Prediction) -> np.ndarray:
        """Derivatives of the codes of a photograph by its unknowns and the shared ones, (unknowns, n, m) float32, 0 where not
        known."""
        found = np.concatenate([prediction.by_response(), *prediction.by_shape()])
        found *= self.seen[number].known
        return found

    def _normal(self, predictions: Sequence[Prediction]) -> tuple[np.ndarray, np.ndarray]:
        """J^T J / sigma^2 by all unknowns, with modes in mm, and J^T (r + J x) / sigma^2 with x their values, those of responses
        relative to the guess."""
        count = predictions[0].guess.modes.size
        normal, pull = np.zeros((self.shared + 1 + count,) * 2), np.zeros(self.shared + 1 + count)
        for k, (one, prediction) in enumerate(zip(self.seen, predictions, strict=True)):
            J = self._derivatives(k, prediction)[:, one.known].astype(float)  # (unknowns, N)
            guess, view = prediction.guess, prediction.view
            x = np.concatenate([np.zeros(4), view.camera, [view.throw, guess.scale], guess.modes.ravel()])
            at = self._at(k, count)
            normal[np.ix_(at, at)] += J @ J.T / one.sigma**2
            pull[at] += J @ (one.misses(prediction)[one.known] + x @ J) / one.sigma**2
        return normal, pull

    def _system(
        self, guess: Guess, normal: np.ndarray, pull: np.ndarray, prior: Sobolev
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The regularised normal equations in units of the prior, their right-hand side, and those units."""
        precision, values = self._before(guess)
        first = self.shared + 1
        unit = np.append(np.ones(first), prior.deviations(len(guess.modes)).ravel())
        A = normal * np.outer(unit, unit)
        A[first:, first:][np.diag_indices(len(unit) - first)] += 1.0
        A[:first, :first] += precision
        b = pull * unit
        for i in range(0, self.shared, OWN):  # responses count from the guess
            b[i : i + 4] -= precision[i : i + 4, i : i + 4] @ values[i : i + 4]
        return A, b, unit

    def _solve(self, guess: Guess, normal: np.ndarray, pull: np.ndarray, prior: Sobolev) -> tuple[np.ndarray, float, tuple]:
        """Solution in natural units, logarithm of the evidence, and the factor with its units."""
        A, b, unit = self._system(guess, normal, pull, prior)
        factor = cho_factor(A, lower=True)
        half = solve_triangular(factor[0], b, lower=True)
        evidence = 0.5 * float(half @ half) - float(np.log(np.diag(factor[0])).sum())
        return cho_solve(factor, b) * unit, evidence, (factor, unit)

    def _step_of(self, guess: Guess, solution: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first = self.shared + 1
        now = np.concatenate([*(np.append(np.zeros(4), view.values[4:]) for view in guess.views), [guess.scale]])
        return solution[:first] - now, solution[first:].reshape(guess.modes.shape) - guess.modes

    def _best_prior(self, guess: Guess, normal: np.ndarray, pull: np.ndarray, now: Sobolev) -> Sobolev:
        """The prior of the largest evidence, of all that are compared; of many modes, of those next to the present one."""
        best, most = now, -np.inf
        for amplitude, power, corner in product(
            *(
                near(every, at, len(guess.modes) > FINE)
                for every, at in zip((AMPLITUDES, POWERS, CORNERS), (now.amplitude, now.power, now.corner), strict=True)
            )
        ):
            tried = Sobolev(float(amplitude), power, corner)
            try:
                evidence = self._solve(guess, normal, pull, tried)[1]
            except LinAlgError:
                continue
            if evidence > most:
                best, most = tried, evidence
        return best

    def _clustered(self, predictions: Sequence[Prediction], covariance: np.ndarray, unit: np.ndarray) -> np.ndarray:
        """The covariance in units of the prior by misses where they are, not by a common variance: errors of the model gather where
        the derivatives are large.  From blocks of pixels, each with the misses of a fit without it (White, Econometrica 48, 817,
        1980; Liang and Zeger, Biometrika 73, 13, 1986; the jackknife of Bell and McCaffrey, Survey Methodology 28, 169, 2002):

            C (P + sum_g s_g s_g^T) C,  s_g = J_g^T (1 - J_g C J_g^T / sigma^2)^-1 r_g / sigma^2
        """
        guess, first = predictions[0].guess, self.shared + 1
        middle = np.diag(np.append(np.zeros(first), np.ones(len(unit) - first)))
        middle[:first, :first] = self._before(guess)[0]
        for k, (one, prediction) in enumerate(zip(self.seen, predictions, strict=True)):
            at = self._at(k, guess.modes.size)
            J = self._derivatives(k, prediction)
            J *= (unit[at, None, None] / one.sigma).astype(np.float32)
            r, C = one.misses(prediction) / one.sigma, covariance[np.ix_(at, at)].astype(np.float32)
            (n, m), scores = one.grid.shape, []
            side = -(-max(n, m) // BLOCKS)
            for i, j in product(range(0, n, side), range(0, m, side)):
                block = J[:, i : i + side, j : j + side].reshape(len(at), -1)  # (unknowns, pixels)
                kept = np.eye(block.shape[1]) - block.T @ (C @ block)
                kept[np.diag_indices(len(kept))] += LEVERAGE
                scores.append(block @ np.linalg.solve(kept, r[i : i + side, j : j + side].ravel()))
            middle[np.ix_(at, at)] += np.array(scores).T @ np.array(scores)
        return covariance @ middle @ covariance

    def result(self, guess: Guess, prior: Sobolev) -> Inference:
        """The inference at a guess."""
        predictions = self.predictions(self.traced(guess))
        for one, prediction in zip(self.seen, predictions, strict=True):
            one.estimate(prediction, np.inf)
        normal, pull = self._normal(predictions)
        _, _, (factor, unit) = self._solve(guess, normal, pull, prior)
        covariance = cho_solve(factor, np.eye(len(unit)))
        by_curvature, by_misses = covariance, self._clustered(predictions, covariance, unit)
        covariance, other = (by_misses, by_curvature) if np.trace(by_misses) > np.trace(by_curvature) else (by_curvature, by_misses)
        larger = np.sqrt(np.maximum(1.0, np.diag(other) / np.maximum(np.diag(covariance), 1e-300)))
        covariance = _exchanged(covariance * np.outer(larger * unit, larger * unit), self.shared)
        fits = tuple(one.fitted(prediction) for one, prediction in zip(self.seen, predictions, strict=True))
        return Inference(self.seen[0].model, guess, prior, covariance, fits)


def _exchanged(covariance: np.ndarray, at: int) -> np.ndarray:
    """The covariance with a larger variance of the scale, unknown number `at`, for which all others compensate as in the fit."""
    along, variance = covariance[:, at], covariance[at, at]
    more = EXCHANGED**2 - 1.0 + CONTRAST**2 / variance
    return covariance + more / variance * np.outer(along, along)
