"""Random form errors of a surface as control heights: a Gaussian random field of given power spectral density, and waviness.

    h(x, y) = sum over modes of sqrt(v_k) (a_k cos(2 pi f_k.(x, y)) + b_k sin(...)),    a_k, b_k normal,    v_k ~ |f_k|^-exponent

with sum v_k = rms^2.  The frequencies form a grid of spacing 1 / (PERIODS sizes), so the field is not periodic within the aperture.
The spline interpolates it at the Greville abscissae, on a net of at least A_WAVE spans per shortest wavelength: that of the lens,
or a refined one in which knot insertion reproduces the same surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import linalg
from torch import Tensor

from caustic_cli.errors import InputError, at_least
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import fixed_surface, freeform_of
from caustic_cli.scene import FreeForm, Scene
from caustic_cli.scene.tolerances import FormError, Waviness

#: Period of a realisation, in aperture sizes.
PERIODS = 2.0
#: Knot spans per shortest wavelength: a cubic spline then reproduces its slope to 1 %.
A_WAVE = 6.0
#: Largest number of control points of a refined net, and of modes, along an axis.
MOST_NET, MOST_MODES = 2048, 2048


def refined(field: HeightField, heights: Tensor, shortest: float) -> tuple[HeightField, Tensor]:
    """The same surface on a net that resolves wavelengths of `shortest` mm, by knot insertion.

    Raises:
        InputError: it would have more than MOST_NET control points along an axis.
    """
    spaces = []
    for space, half in zip(field.spaces, field.half_size, strict=True):
        widths = space.breaks.diff() * (2.0 * half)
        parts = max(1, math.ceil(A_WAVE * float(widths.max()) / shortest)) if math.isfinite(shortest) else 1
        if len(widths) * parts + space.degree > MOST_NET:
            least = A_WAVE * 2.0 * half / (MOST_NET - space.degree)
            raise InputError(
                "the shortest wavelength of an error of the surface must be at least"
                f" {least:.2g} mm on this lens, got {shortest:g} mm"
            )
        low, step = space.breaks[:-1, None], space.breaks.diff()[:, None] / parts
        more = (low + step * torch.arange(1, parts)).reshape(-1)
        knots = torch.cat([space.knots, more]).sort().values if parts > 1 else space.knots
        spaces.append(SplineSpace(space.degree, knots))
    if all(len(a.knots) == len(b.knots) for a, b in zip(spaces, field.spaces, strict=True)):
        return field, heights
    finer = HeightField((spaces[0], spaces[1]), field.half_size)
    tu, tv = (_carried(a, b) for a, b in zip(field.spaces, finer.spaces, strict=True))
    return finer, torch.from_numpy(tv(tu(heights.double().cpu().numpy()).T).T.copy())


def _carried(coarse: SplineSpace, finer: SplineSpace):
    """Change of basis by interpolation at the finer space's Greville abscissae, exact for splines of the coarser space."""
    solve, values = _Interpolation(finer), _collocation(coarse, finer.greville)
    return lambda net: solve(values @ net)


def _collocation(space: SplineSpace, at: Tensor) -> sparse.csr_array:
    first, values = space.basis(at)
    columns = (first[:, None] + torch.arange(space.degree + 1)).numpy()
    rows = np.repeat(np.arange(len(at)), space.degree + 1)
    return sparse.csr_array((values.numpy().ravel(), (rows, columns.ravel())), shape=(len(at), space.n))


@dataclass(frozen=True)
class _Interpolation:
    """A function: values at the Greville abscissae (n, ...) -> control heights."""

    space: SplineSpace

    @cached_property
    def _solve(self) -> Callable[[np.ndarray], np.ndarray]:
        return linalg.splu(sparse.csc_matrix(_collocation(self.space, self.space.greville))).solve

    def __call__(self, values: np.ndarray) -> np.ndarray:
        return self._solve(values)

    def __reduce__(self) -> tuple:  # SciPy's factors cannot be pickled
        return _Interpolation, (self.space,)


class OtherSurfaces:
    """Form errors of the designed surfaces of a scene beside the lens' exit: its entrance, and those of other elements.

    Args:
        scene: with their heights.
        form, waviness, shortest: the statistics of each, independent of the others.

    Raises:
        InputError: as of `FormErrors` and `refined`.
    """

    def __init__(self, scene: Scene, form: FormError | None, waviness: Waviness | None, shortest: float):
        self.scene, self.made = scene, dict[int, tuple[HeightField, Tensor, FormErrors]]()
        parts = [(scene.lens.entrance, scene.lens.half_size), *((s, e.half_size) for e in scene.elements for s in e.surfaces)]
        for surface, half in parts:
            if surface is not None:
                fixed = fixed_surface(surface, half)
                field, heights = refined(fixed.field, fixed.heights, shortest)
                self.made[id(surface)] = field, heights, FormErrors(field, form, waviness)

    def realised(self, rng: np.random.Generator, which: tuple[str, ...]) -> Scene:
        """The scene with a realisation of these errors, form_error, waviness or both, on each of the surfaces."""

        def erroneous(surface: FreeForm | None) -> FreeForm | None:
            if surface is None:
                return None
            field, heights, errors = self.made[id(surface)]
            return freeform_of(field, heights + errors.heights(rng, which))

        if not self.made:
            return self.scene
        lens = replace(self.scene.lens, entrance=erroneous(self.scene.lens.entrance))
        elements = tuple(
            replace(e, surfaces=(erroneous(e.surfaces[0]), erroneous(e.surfaces[1]))) if any(e.surfaces) else e
            for e in self.scene.elements
        )
        return replace(self.scene, lens=lens, elements=elements)


class FormErrors:
    """Realisations of a surface's form errors.

    Args:
        field: of the lens, on a net that resolves their shortest wavelength (`refined`).
        form, waviness: their statistics, None for none.

    Raises:
        InputError: no mode of the form error fits on the lens, or too many do.
    """

    def __init__(self, field: HeightField, form: FormError | None, waviness: Waviness | None):
        self.field, self.waviness, self.modes = field, waviness, None
        self.x, self.y = (c.numpy() for c in field.control_xy())
        self.solve = tuple(_Interpolation(s) for s in field.spaces)
        if form is not None and form.rms > 0:
            self.modes = self._modes(form)

    def _modes(self, form: FormError) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Frequencies along x and y, 1/mm, a half plane of them, and the standard deviation of each mode's cosine and sine."""
        sizes = [2.0 * r for r in self.field.half_size]
        longest, steps = form.longest or max(sizes), [1.0 / (PERIODS * size) for size in sizes]
        counts = [math.floor(1.0 / (form.shortest * step)) for step in steps]
        if max(counts) > MOST_MODES:
            least = PERIODS * max(sizes) / MOST_MODES
            raise InputError(
                f"[form_error] shortest must be at least {at_least(least, 2)} mm on this lens, got {form.shortest:g} mm"
            )
        fx, fy = steps[0] * np.arange(-counts[0], counts[0] + 1), steps[1] * np.arange(0, counts[1] + 1)
        f = np.hypot(fx[:, None], fy[None, :])
        inside = (f >= (1.0 - 1e-9) / longest) & (f <= (1.0 + 1e-9) / form.shortest)
        inside &= (fy[None, :] > 0) | (fx[:, None] > 0)
        if not inside.any():
            raise InputError(
                f"[form_error] must leave some wavelength between shortest, {form.shortest:g} mm, and longest, {longest:g} mm,"
                f" that fits on a lens of {max(sizes):g} mm"
            )
        density = np.where(inside, np.where(inside, f, 1.0) ** -form.exponent, 0.0)
        return fx, fy, form.rms * np.sqrt(density / density.sum())

    def form_values(self, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """A realisation of the form error at the points (x_i, y_j), mm: (len(x), len(y))."""
        assert self.modes is not None
        fx, fy, deviation = self.modes
        a = deviation * (rng.standard_normal(deviation.shape) - 1j * rng.standard_normal(deviation.shape))
        return np.real((np.exp(2j * np.pi * np.outer(x, fx)) @ a) @ np.exp(2j * np.pi * np.outer(fy, y)))

    def wave_values(self, rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """A realisation of the waviness there, with a uniformly random phase, mm."""
        assert self.waviness is not None
        w, turn = self.waviness, math.radians(self.waviness.direction)
        way = math.cos(turn) * x[:, None] + math.sin(turn) * y[None, :]
        return w.amplitude * np.sin(2.0 * np.pi * (way / w.period + rng.random()))

    def heights(self, rng: np.random.Generator, which: tuple[str, ...]) -> Tensor:
        """Control heights (n, m) mm of a realisation of form_error, waviness or both, to be added to the lens'."""
        values = np.zeros((len(self.x), len(self.y)))
        for name in which:
            values += (self.form_values if name == "form_error" else self.wave_values)(rng, self.x, self.y)
        return torch.from_numpy(self.solve[1](np.ascontiguousarray(self.solve[0](values).T)).T.copy())
