"""What a camera should record of a part: the image of its surface with a deviation, in codes of the photograph; derivatives.

Notation
    H           control heights of the exit as designed, (n, m) mm
    d           deviation of the part, mm: a sum of products of cosines and straight lines, of unit RMS over a rectangle somewhat
                larger than the aperture (`cosines`)
    s           scale of the relief, which is s times as high as it should be about its mean height
    c           amplitudes (9,) of the displacements of `camera.displacements`, half widths of the screen
    t           by how much the screen of a photograph is farther away than it is said to be, mm
    E           irradiance over its mean on the screen, on the pixels of a grid; on a curved screen per area of itself
    L           light on the sensor, gain E + background, of which 1 saturates it
    code        min(L, 1)^(1 / gamma), in [0, 1]

Rays lie on a regular lattice and are traced by the tracer of the project.  To first order a ray's landing point depends on the
surface through height and slope where it leaves: three traces, of a surface raised and tilted a little, give the derivatives with
respect to every mode.  The image, on the finest pixels of more rays than its derivatives, is a sum of quadratic B-splines (3 x 3
pixels) of the landing points, blurred by a Gaussian, and that of an extended source its convolution with the mean image of that
source through the lens (`optics.spread`); several sources have images of their own, which add up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.signal import fftconvolve
from scipy.sparse import csc_matrix
from torch import Tensor

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.screen_shape import shape_of
from caustic_cli.optics.spread import POINT, Spread, spread_at
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import Tracer, tracers
from caustic_cli.scene import Scene
from caustic_cli.studies.photograph.camera import Shape, displacements

#: Height and slope of the surfaces by which derivatives are found: displacements of rays of a thousandth of a pixel, well above
#: rounding.
RAISED, TILTED = 1e-4, 1e-6
#: Displacement of the screen for the same, mm.
FARTHER = 0.1
#: Rays of a prediction over those of its derivatives; most points of a source that have as many rays each.
MORE, MOST = 4, 8
#: Width by which the rectangle of the modes is larger than the aperture at each of its edges, over the aperture: the slopes of
#: cosines vanish at the edges of their rectangle, those of a part at its own do not.
BEYOND = 0.15
#: Pixels around the grid from which blur brings light.
AROUND = 8
#: Least light whose derivative is taken at face value: that of a root is infinite at 0.
DIM = 2e-3
#: Gaussians are cut at this many standard deviations.
CUT = 3.5


#: A part of the screen: its lower and upper X, and lower and upper Y.
Window = tuple[tuple[float, float], tuple[float, float]]
WHOLE: Window = ((-1.0, 1.0), (-1.0, 1.0))


@dataclass(frozen=True, eq=False)
class Response:
    """How a sensor responds: `log_gain`, `background`, `log_gamma`, and `log_blur` of the standard deviation in half widths."""

    log_gain: float = 0.0
    background: float = 0.02
    log_gamma: float = float(np.log(2.2))
    log_blur: float = float(np.log(0.01))

    @property
    def values(self) -> np.ndarray:
        """All four."""
        return np.array([self.log_gain, self.background, self.log_gamma, self.log_blur])

    def codes(self, E: np.ndarray) -> np.ndarray:
        """Codes of blurred irradiance."""
        return np.clip(np.exp(self.log_gain) * E + self.background, 0.0, 1.0) ** np.exp(-self.log_gamma)

    def slopes(self, E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative of the codes by L and by log gamma."""
        light = np.exp(self.log_gain) * E + self.background
        power, inside = np.exp(-self.log_gamma), (light > 0) & (light < 1.0)
        light = np.clip(light, DIM, 1.0)
        code = light**power
        return inside * power * code / light, -power * np.log(light) * code * inside

    def irradiance(self, codes: np.ndarray) -> np.ndarray:
        """E from codes."""
        return (np.clip(codes, 0.0, 1.0) ** np.exp(self.log_gamma) - self.background) * np.exp(-self.log_gain)


@dataclass(frozen=True, eq=False)
class View:
    """Values of the unknowns of one photograph: response, c and t."""

    response: Response
    camera: np.ndarray
    throw: float = 0.0

    @property
    def values(self) -> np.ndarray:
        """All of them, (4 + 9 + 1,)."""
        return np.concatenate([self.response.values, self.camera, [self.throw]])


@dataclass(frozen=True, eq=False)
class Guess:
    """Values of all unknowns: those of each photograph, s - 1, and amplitudes (k, l) of the modes of d, mm."""

    views: tuple[View, ...]
    scale: float
    modes: np.ndarray

    def with_modes(self, count: int) -> Guess:
        """The same with `count` modes along each axis, further ones 0."""
        k = min(count, len(self.modes))
        modes = np.zeros((count, count))
        modes[:k, :k] = self.modes[:k, :k]
        return replace(self, modes=modes)


def cosines(u: np.ndarray, count: int) -> np.ndarray:
    """Modes of unit RMS over their rectangle at u in [0, 1] of the aperture, (N, count): cosines, but for the first after the
    constant a straight line, so that tilt is a mode."""
    k, at = np.arange(count), (u + BEYOND) / (1.0 + 2.0 * BEYOND)
    found = np.cos(np.pi * np.outer(at, k)) * np.where(k > 0, np.sqrt(2.0), 1.0)
    found[:, 1:2] = np.sqrt(3.0) * (1.0 - 2.0 * at)[:, None]
    return found


def slopes_of_cosines(u: np.ndarray, count: int) -> np.ndarray:
    """Derivatives of `cosines` by u."""
    k = np.arange(count) / (1.0 + 2.0 * BEYOND)
    found = -np.sin(np.pi * np.outer(u + BEYOND, k)) * (np.pi * k * np.sqrt(2.0))
    found[:, 1:2] = -2.0 * np.sqrt(3.0) / (1.0 + 2.0 * BEYOND)
    return found


def deviation(field: HeightField, modes: np.ndarray) -> Tensor:
    """Control heights (n, m), mm, of the deviation with these amplitudes."""
    x, y = (cosines(s.greville.numpy(), k) for s, k in zip(field.spaces, modes.shape, strict=True))
    return field.interpolated(torch.from_numpy(x @ modes @ y.T))


def heights_at(field: HeightField, heights: Tensor, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heights on the grid of x (a,) and y (b,), (a, b) mm."""
    at = [torch.from_numpy(0.5 * (c / r + 1.0)).clamp(0.0, 1.0) for c, r in zip((x, y), field.half_size, strict=True)]
    bu, bv = (s.matrix(c) for s, c in zip(field.spaces, at, strict=True))
    return (bu @ heights @ bv.T).numpy()


def scaled(heights: Tensor, scale: float) -> Tensor:
    """Control heights of a relief that is 1 + scale times as high about its mean."""
    middle = heights.mean()
    return middle + (1.0 + scale) * (heights - middle)


@dataclass(frozen=True, eq=False)
class Landing:
    """Rays on the screen: (X, Y) in half widths and power, (N,) each; those that do not arrive have none.  ends: of each light's
    rays, which follow each other."""

    x: np.ndarray
    y: np.ndarray
    power: np.ndarray
    ends: tuple[int, ...]

    @property
    def parts(self) -> list[slice]:
        """The rays of each light."""
        return [slice(a, b) for a, b in zip((0, *self.ends), self.ends, strict=False)]


@dataclass(frozen=True, eq=False)
class _SharpLight:
    """The light of one source without its extent, whose image blurs that of this light everywhere; fraction: of all light."""

    scene: Scene
    fraction: float
    spread: Spread

    @classmethod
    def of(cls, scene: Scene, fraction: float, field: HeightField, heights: Tensor) -> _SharpLight:
        """That of a source; with its extent where it has no image of its own, as separate points and the rays of a file."""
        spread = None if scene.source.apart else spread_at(scene, field, heights)
        return cls(scene if spread is None else replace(scene, source=scene.source.pointlike()), fraction, spread or POINT)

    def traced(self, field: HeightField, rays: int, channel: int | None) -> list[Tracer]:
        """Tracers of about so many rays, of several points of each; of a colour channel alone, if one is given."""
        source = self.scene.source
        points = 1 if source.distant or source.rays is not None else min(MOST, len(source.points()[0]))
        found = tracers(self.scene, field, rays_of(self.scene, "grid", points * rays), torch.float64, 1 << 24)
        return [one for one in found if channel in (None, one.channel)]


class PartModel:
    """The model of photographs of one part in one light on one screen.

    Args:
        scene, field, heights: the lens as it was designed, with the error known of it so far.
        rays: about how many of each source.
        wave: E of these heights as waves, (n, m) over the screen; diffraction is then the difference from rays that it makes of
            this surface, of the deviation's it is not known.
        channel: of the colours of the light, the one that is photographed.
    """

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        heights: Tensor,
        rays: int,
        wave: np.ndarray | None = None,
        channel: int | None = None,
    ):
        self.wave, self.scene, self.field, self.heights = wave, scene, field, heights.detach().double().cpu()
        self.lights = [
            _SharpLight.of(one, fraction, field, self.heights)
            for one, fraction in zip(scene.by_source, scene.source.fractions, strict=True)
        ]
        self._beyond = np.zeros((2, 1))
        self._bases: list[tuple[np.ndarray, np.ndarray]] | None = None
        self._tracers, self._more = ([one.traced(field, n, channel) for one in self.lights] for n in (rays, MORE * rays))
        parts = (1.0 if channel is None else one.scene.light.fractions[channel] for one in self.lights)
        #: Of the light, that of the channel.
        self._share = math.fsum(light.fraction * part for light, part in zip(self.lights, parts, strict=True))

    @property
    def spreads(self) -> list[Spread]:
        """The image of the source of each light."""
        return [one.spread for one in self.lights]

    def made(self, guess: Guess) -> Tensor:
        """Control heights of the part."""
        return scaled(self.heights, guess.scale) + deviation(self.field, guess.modes)

    def landing(self, guess: Guess, throw: float = 0.0) -> Landing:
        """The rays of a part on the screen, `throw` mm farther away, by derivatives from the surface traced last (`trace`)."""
        base = self.designed
        moved = self._moved(guess) + self._beyond
        moved = moved + throw * self.by_throw if throw else moved
        return replace(base, x=base.x + moved[0], y=base.y + moved[1])

    def trace(self, guess: Guess) -> None:
        """Trace the part itself, so that derivatives need only reach from here."""
        exact, base, moved = self.land(self.made(guess)), self.designed, self._moved(guess)
        self._beyond = np.nan_to_num(np.array([exact.x - base.x, exact.y - base.y]) - moved)

    def _moved(self, guess: Guess) -> np.ndarray:
        """Displacements on the screen by deviation and scale to first order, (2, N) half widths."""
        (cu, su), (cv, sv) = self.bases(len(guess.modes))
        modes = guess.modes.T.astype(cv.dtype)
        along = cv @ modes  # (N, k)
        local = [(cu * along).sum(1), (su * along).sum(1), (cu * (sv @ modes)).sum(1)]
        return np.einsum("sin,sn->in", self.responses, np.array(local)) + guess.scale * self.by_scale

    def light(self, guess: Guess, throw: float = 0.0) -> Landing:
        """MORE times as many rays of a part, traced themselves: few, on their lattice, leave stripes in light that is spread."""
        return self.land(self.made(guess), throw, self._more)

    def bases(self, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """`count` modes and their slopes per mm at the rays, along each axis, (N, count) float32 each: half of the time, and
        is exact to 1e-7 of a step."""
        if self._bases is None or self._bases[0][0].shape[1] != count:
            self._bases = [
                (cosines(c, count).astype(np.float32), (slopes_of_cosines(c, count) / (2 * r)).astype(np.float32))
                for c, r in zip(self.places, self.field.half_size, strict=True)
            ]
        return self._bases

    def land(self, heights: Tensor, throw: float = 0.0, through: list[list[Tracer]] | None = None) -> Landing:
        """The rays of a surface on the screen, which is `throw` farther away, mm, unless it is the far field; through: other
        tracers than its own."""
        screen, found, ends = self.scene.screen, [np.zeros((3, 0))], []
        if throw and not screen.far:
            screen = replace(screen, z=screen.z + throw * math.copysign(1.0, screen.z))
        for light, own in zip(self.lights, self._tracers if through is None else through, strict=True):
            for traced in own:
                with torch.no_grad():
                    x, y, power = _flat(traced.land({EXIT: heights}, screen)[0])
                found.append(np.stack([x, y, light.fraction / self._share * traced.weight * power]))
            ends.append(sum(one.shape[1] for one in found))
        x, y, power = np.concatenate(found, 1)
        (rx, ry), (sx, sy) = screen.half_size, screen.shift
        x, y, arrives = (x - sx) / rx, (y - sy) / ry, np.isfinite(x + y)
        if screen.curved:
            _, zx, zy = shape_of(screen).at(np.where(arrives, x, 0.0) * rx, np.where(arrives, y, 0.0) * ry)
            power = power / np.sqrt(1.0 + zx * zx + zy * zy)
        return Landing(x, y, np.where(arrives, power, 0.0), tuple(ends))

    @cached_property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the rays leave the designed surface, (u, v) in [0, 1], (N,) each."""
        (rx, ry), parameters = self.field.half_size, {EXIT: self.heights}
        with torch.no_grad():
            found = [_flat(traced.ends(parameters)[0].state) for own in self._tracers for traced in own]
        x, y, _ = np.concatenate(found, 1)
        return 0.5 * (x / rx + 1.0), 0.5 * (y / ry + 1.0)

    @cached_property
    def designed(self) -> Landing:
        """The rays of the designed surface."""
        return self.land(self.heights)

    def image(self, shape: tuple[int, int]) -> np.ndarray:
        """E of the designed surface by rays on n x m pixels of the screen, over the mean of all light."""
        at, edges, (rx, ry) = self.designed, [np.linspace(-1.0, 1.0, n + 1) for n in shape], self.scene.screen.half_size
        whole = np.zeros(shape)
        for part, spread in zip(at.parts, self.spreads, strict=True):
            light = np.histogram2d(at.x[part], at.y[part], edges, weights=at.power[part])[0]
            if max(spread.reach()) > 0:
                light = fftconvolve(light, spread.kernel((2 * rx / shape[0], 2 * ry / shape[1])), mode="same")
            whole += light
        return whole * whole.size

    @property
    def shape(self) -> Shape | None:
        """S of a curved screen at points (X, Y), half widths along X."""
        screen = self.scene.screen
        if not screen.curved:
            return None
        (rx, ry), shape = screen.half_size, shape_of(screen)
        return lambda x, y: shape.at(rx * x, ry * y)[0] / rx

    @cached_property
    def diffraction(self) -> np.ndarray | None:
        """What waves make of the image by rays, (n, m), None where that is not known."""
        return None if self.wave is None else self.wave - self.image((self.wave.shape[0], self.wave.shape[1]))

    @cached_property
    def responses(self) -> np.ndarray:
        """Derivatives of the landing points (X, Y) by height and by both slopes, (3, 2, N), per mm and per unit."""
        x, y = self.field.control_xy()
        shapes = [(torch.full(self.field.shape, 1.0).double(), RAISED), (x[:, None].expand(self.field.shape), TILTED)]
        shapes.append((y[None, :].expand(self.field.shape), TILTED))
        up, along_x, along_y = (self._derivative(shape, step) for shape, step in shapes)
        (u, v), (rx, ry) = self.places, self.field.half_size
        return np.array([up, along_x - (2 * u - 1) * rx * up, along_y - (2 * v - 1) * ry * up])

    @cached_property
    def by_scale(self) -> np.ndarray:
        """Derivatives of the landing points by the scale of the relief, (2, N)."""
        return self._derivative(self.heights - self.heights.mean(), 1e-4)

    @cached_property
    def by_throw(self) -> np.ndarray:
        """Derivatives of the landing points by the distance of the screen, (2, N) per mm."""
        more, less = (self.land(self.heights, sign * FARTHER) for sign in (1.0, -1.0))
        return np.nan_to_num(np.array([more.x - less.x, more.y - less.y]) / (2 * FARTHER))

    def _derivative(self, shape: Tensor, step: float) -> np.ndarray:
        """Derivative of the landing points by a multiple of a shape, control heights, (2, N)."""
        more, less = (self.land(self.heights + sign * step * shape) for sign in (1.0, -1.0))
        return np.nan_to_num(np.array([more.x - less.x, more.y - less.y]) / (2 * step))


def _flat(state: RayState) -> np.ndarray:
    """x, y and power of rays, (3, N)."""
    values = [torch.as_tensor(c) for c in (*state.origin[:2], state.power)]
    return torch.stack([c.double().reshape(-1) for c in torch.broadcast_tensors(*values)]).numpy()


def _gaussian(image: np.ndarray, blur: float) -> np.ndarray:
    """Images (..., n, m) blurred by this many pixels."""
    return gaussian_filter(image, (0.0,) * (image.ndim - 2) + (blur, blur), truncate=CUT, mode="nearest") if blur > 0 else image


class Grid:
    """The pixels on which a photograph is compared, n x m over a window of the screen; `smooth`: by how many both are blurred;
    model: for its image of the source; known: pixels (n, m) of which the photograph tells the light, all unless given."""

    def __init__(
        self,
        shape: tuple[int, int],
        smooth: float,
        window: Window = WHOLE,
        model: PartModel | None = None,
        known: np.ndarray | None = None,
    ):
        self.shape, self.smooth, self.window = shape, smooth, window
        self.known = np.ones(shape, dtype=bool) if known is None else known
        #: Pixels along a half width of the screen, and on the whole screen.
        self.finer = [n / (high - low) for n, (low, high) in zip(shape, window, strict=True)]
        self.pixels = 4.0 * self.finer[0] * self.finer[1]
        #: Of the light of each source.
        self.kernels: list[np.ndarray | None] = [None]
        if model is not None:
            half = model.scene.screen.half_size
            wide, high = ((b - a) * r / n for (a, b), r, n in zip(window, half, shape, strict=True))
            self.kernels = [one.kernel((wide, high)) if max(one.reach()) > 0 else None for one in model.spreads]
        self.around = AROUND + max(0 if kernel is None else max(kernel.shape) // 2 for kernel in self.kernels)
        self.wide = (shape[0] + 2 * self.around, shape[1] + 2 * self.around)

    def inner(self, image: np.ndarray) -> np.ndarray:
        """An image without what lies around the grid."""
        return image[..., self.around : -self.around, self.around : -self.around]

    def blurred(self, images: Sequence[np.ndarray], response: Response) -> np.ndarray:
        """Sharp images (..., n, m) of all lights as their sources and the camera blur them, summed up."""
        whole: Any = 0.0
        for image, kernel in zip(images, self.kernels, strict=True):
            if kernel is not None:
                image = fftconvolve(image, kernel[(None,) * (image.ndim - 2)], mode="same", axes=(-2, -1))
            whole = whole + image
        return _gaussian(whole, self.sensor_blur(response))

    def compared(self, image: np.ndarray) -> np.ndarray:
        """Images (..., n, m) of the grid as they are compared: smoothed, without what is not known."""
        return _gaussian(image * self.known, self.smooth)

    def sensor_blur(self, response: Response) -> float:
        """The blur of the camera, pixels."""
        (low, high), _ = self.window
        return float(np.exp(response.log_blur)) * self.shape[0] / (high - low)

    def sampled(self, image: np.ndarray | None, camera: np.ndarray) -> np.ndarray | float:
        """An image over the whole screen, as the camera displaces it, on the wide grid; 0 for None."""
        if image is None:
            return 0.0
        places = [
            low + (np.arange(n) - self.around + 0.5) * (high - low) / k
            for n, k, (low, high) in zip(self.wide, self.shape, self.window, strict=True)
        ]
        x, y = (c.ravel() for c in np.meshgrid(*places, indexing="ij"))
        moved = np.einsum("k,kin->in", camera, displacements(x, y))
        at = [(c - d + 1.0) * 0.5 * n - 0.5 for c, d, n in zip((x, y), moved, image.shape, strict=True)]
        return map_coordinates(image, at, order=1).reshape(self.wide)

    def _weights(self, landing: Landing, camera: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
        """Weights of rays in three pixels along each axis and their slopes, (3, N) each, and the nine pixels, (9, N)."""
        moved = np.einsum("k,kin->in", camera, displacements(landing.x, landing.y))
        seen = landing.x + moved[0], landing.y + moved[1]
        at = [(c - low) * k - 0.5 + self.around for c, k, (low, _) in zip(seen, self.finer, self.window, strict=True)]
        middle, inside = [], np.isfinite(at[0] + at[1])
        for c, n in zip(at, self.wide, strict=True):
            c[~inside] = 1.0
            nearest = np.floor(c + 0.5)
            inside &= (nearest >= 1) & (nearest < n - 1)
            middle.append(nearest)
        weights, slopes, index = [], [], []
        for c, nearest, n in zip(at, middle, self.wide, strict=True):
            t = c - nearest
            weights.append(np.array([0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2]) * inside)
            slopes.append(np.array([t - 0.5, -2.0 * t, t + 0.5]) * inside)
            index.append(np.clip(nearest, 1, n - 2).astype(np.int32) + np.array([-1, 0, 1], dtype=np.int32)[:, None])
        return weights, slopes, (index[0][:, None] * self.wide[1] + index[1][None]).reshape(9, -1)

    def counted(self, landing: Landing, camera: np.ndarray) -> np.ndarray:
        """E on the wide grid by each light, (lights, a, b)."""
        (x, y), _, pixels = self._weights(landing, camera)
        light = np.zeros((len(landing.ends), self.wide[0] * self.wide[1]))
        for k, (i, j) in enumerate(product(range(3), range(3))):
            power = x[i] * y[j] * landing.power
            for image, part in zip(light, landing.parts, strict=True):
                image += np.bincount(pixels[k, part], power[part], len(image))
        return self.pixels * light.reshape(-1, *self.wide)

    def splats(self, landing: Landing, camera: np.ndarray) -> tuple[csc_matrix, csc_matrix]:
        """Matrices (pixels of the wide grid, N), float32, from power times displacement along X and Y to the change of E of its
        light."""
        weights, slopes, pixels = self._weights(landing, camera)
        rows, pointers = pixels.T.ravel(), np.arange(0, 9 * len(landing.x) + 1, 9, dtype=np.int32)

        def matrix(along_x: np.ndarray, along_y: np.ndarray, factor: float) -> csc_matrix:
            values = (along_x[:, None] * along_y[None]).reshape(9, -1).T.ravel() * (factor * self.pixels)
            values = values.astype(np.float32)
            return csc_matrix((values, rows, pointers), shape=(self.wide[0] * self.wide[1], len(landing.x)))

        return matrix(slopes[0], weights[1], self.finer[0]), matrix(weights[0], slopes[1], self.finer[1])


@dataclass(eq=False)
class Prediction:
    """The codes (n, m) of a photograph predicted for a guess, with what their derivatives need; view: its unknowns."""

    model: PartModel
    grid: Grid
    guess: Guess
    view: View
    landing: Landing
    #: E on the wide grid: sharp, by each light, and blurred.
    sharp: np.ndarray
    blurred: np.ndarray

    @classmethod
    def of(cls, model: PartModel, grid: Grid, guess: Guess, number: int = 0, light: Landing | None = None) -> Prediction:
        """The prediction of one of the photographs, by its number; light: rays of the same surface for it other than those of the
        derivatives."""
        view = guess.views[number]
        landing = model.landing(guess, view.throw)
        sharp = grid.counted(landing if light is None else light, view.camera)
        sharp[0] += grid.sampled(model.diffraction, view.camera)
        return cls(model, grid, guess, view, landing, sharp, grid.blurred(sharp, view.response))

    @property
    def codes(self) -> np.ndarray:
        """On the grid, as they are compared."""
        return self.grid.compared(self.grid.inner(self.view.response.codes(self.blurred)))

    def by_response(self) -> np.ndarray:
        """Derivatives of the codes by the four values of the response, (4, n, m)."""
        r, grid = self.view.response, self.grid
        by_light, by_gamma = r.slopes(self.blurred)
        step = 1e-2
        wider = grid.blurred(self.sharp, replace(r, log_blur=r.log_blur + step))
        gain = np.exp(r.log_gain)
        stack = [by_light * gain * self.blurred, by_light, by_gamma, by_light * gain * (wider - self.blurred) / step]
        return grid.compared(grid.inner(np.array(stack))).astype(np.float32)

    def _displaced(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Derivatives of the codes (k, n, m) by displacements of the rays along X and Y times their power, (N, k) each."""
        r, grid, (by_x, by_y) = self.view.response, self.grid, self.splats
        each = [by_x[:, part] @ x[part] + by_y[:, part] @ y[part] for part in self.landing.parts]
        images = grid.blurred([np.ascontiguousarray(image.T).reshape(-1, *grid.wide) for image in each], r)
        images *= (r.slopes(self.blurred)[0] * np.exp(r.log_gain)).astype(images.dtype)
        return grid.compared(grid.inner(images))

    @cached_property
    def splats(self) -> tuple[csc_matrix, csc_matrix]:
        """As of the grid."""
        return self.grid.splats(self.landing, self.view.camera)

    def by_shape(self) -> Iterator[np.ndarray]:
        """Derivatives of the codes by c, (9, n, m); by t and s, (2, n, m); by the modes (k, .), (l, n, m) for each k."""
        power = self.landing.power
        fields = (displacements(self.landing.x, self.landing.y) * power).astype(np.float32)  # (9, 2, N)
        yield self._displaced(fields[:, 0].T, fields[:, 1].T)
        model, guess = self.model, self.guess
        dx, dy = (np.array([model.by_throw, model.by_scale]).swapaxes(0, 1) * power).astype(np.float32)  # (2, N) each
        yield self._displaced(dx.T, dy.T)
        (up, along_x, along_y), ((cu, su), (cv, sv)) = model.responses, model.bases(len(guess.modes))
        parts = [(power * c).astype(np.float32) for c in (*up, *along_x, *along_y)]  # up x, up y, slope x: x, y, slope y: x, y
        for k in range(len(guess.modes)):
            a, b = cu[:, k], su[:, k]
            of_value = [a * parts[0] + b * parts[2], a * parts[1] + b * parts[3]]
            of_slope = [a * parts[4], a * parts[5]]
            x, y = (of_value[i][:, None] * cv + of_slope[i][:, None] * sv for i in (0, 1))
            yield self._displaced(x, y)
