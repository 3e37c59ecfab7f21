"""The loss of a lens with two free-form surfaces: of its picture, and of a second picture or the ray directions behind it.

    loss = sqrt((t_1^2 + t_2^2) / 2) / pixels

t_1 is the error of the picture on the screen (`losses`); t_2 that of a second picture on a screen farther away, or the RMS angle
between the directions of the rays and the prescribed ones, weighted by power, over SHARP.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.inverse.losses import Loss
from caustic_cli.inverse.objective import CHUNK, Evaluation, penalty_of
from caustic_cli.optics.angular_error import squared_angular_error
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import ENTRANCE, EXIT
from caustic_cli.optics.trace import Parameters, Tracer, tracers
from caustic_cli.scene import Scene, Screen

#: Angle, rad, equivalent to a relative RMS error of 1.
SHARP = 2e-2
#: Most rays whose graph is kept for the gradient, 0.6 KiB each; more are traced twice.
WHOLE = 1 << 22


class TwoSidedObjective:
    """The loss as a function of the heights of entrance and exit, (2, n, m) mm.

    Args:
        scene: with a `second`; field: spline spaces of both sides; sampler: the rays, the same at every evaluation.
        targets: irradiance (n_x, n_y) on the scene's screen, and on that of its `second`, if it has one.
        filter, loss, blur, filter_target, apron, max_slope, min_radius, oversample, dtype: as of `Objective`.
    """

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        sampler: Rays,
        filter: Filter,
        targets: tuple[Tensor, ...],
        loss: str,
        *,
        blur: float = 0.0,
        filter_target: bool = True,
        apron: int = 0,
        max_slope: float = 0.0,
        min_radius: float = 0.0,
        oversample: int = 1,
        dtype: torch.dtype = torch.float32,
    ):
        assert scene.second is not None
        self.scene, self.field, self.sampler, self.filter, self.dtype = scene, field, sampler, filter, dtype
        self.device, self.apron, self.oversample = sampler.device, apron, oversample
        screens = [s for s in (scene.screen, scene.second.screen) if s is not None]
        self.screens = [self._grown(s) for s in screens]
        self.losses = []
        for target in targets:
            wide = torch.nn.functional.pad(target.double().to(self.device), (apron,) * 4)
            fine = wide.repeat_interleave(oversample, -2).repeat_interleave(oversample, -1)
            smooth = self._pool(filter.smooth(fine)) if filter_target else wide
            self.losses.append(Loss(loss, smooth, blur, apron, wide > 0))
        self.loss = self.losses[0]
        self.penalty = penalty_of(scene, field, loss, max_slope, min_radius, self.device)

    def _grown(self, screen: Screen) -> Screen:
        screen = screen.grown((self.apron, self.apron))
        return replace(screen, resolution=tuple(self.oversample * n for n in screen.resolution))

    def _pool(self, image: Tensor) -> Tensor:
        k, (n, m) = self.oversample, image.shape
        return image if k == 1 else image.view(n // k, k, m // k, k).sum((1, 3))

    def _tracers(self) -> Iterator[Tracer]:
        return tracers(self.scene, self.field, self.sampler, self.dtype, CHUNK)

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradients; more than WHOLE rays are traced twice, which bounds the memory.

        Raises:
            NoLight: no light reaches a screen.
        """
        parameters = {
            name: h.detach().to(self.device).clone().requires_grad_() for name, h in zip((ENTRANCE, EXIT), heights, strict=True)
        }
        leaves, whole = list(parameters.values()), self.sampler.count <= WHOLE
        kept, sums, entering = [], None, torch.zeros((), dtype=torch.float64)
        with torch.set_grad_enabled(whole):
            for traced in self._tracers():
                part = self._see(traced, parameters)
                kept += [part] if whole else []
                now = [p.detach() for p in part]
                sums = now if sums is None else [a + b for a, b in zip(sums, now, strict=True)]
                entering = entering + traced.entering.double()
        assert sums is not None
        sums = [s.requires_grad_() for s in sums]
        loss = self._loss(sums, entering, self._penalty(*leaves))
        *by, entrance, exit = torch.autograd.grad(loss, [*sums, *leaves], allow_unused=True)
        gradients = [torch.zeros_like(h) if g is None else g.clone() for h, g in zip(leaves, (entrance, exit), strict=True)]
        for part in kept or (self._see(traced, parameters) for traced in self._tracers()):
            pulled = [(value, pull) for value, pull in zip(part, by, strict=True) if pull is not None]
            live = [(value, pull.to(value.dtype)) for value, pull in pulled if value.requires_grad]
            values, pulls = zip(*live, strict=True)
            for gradient, more in zip(gradients, torch.autograd.grad(values, leaves, pulls, allow_unused=True), strict=True):
                if more is not None:
                    gradient += more
        a = self.apron
        inner = sums[0].detach()[a : sums[0].shape[0] - a, a : sums[0].shape[1] - a]
        return Evaluation(float(loss.detach()), dict(zip(parameters, gradients, strict=True)), float(inner.sum()), inner)

    def _see(self, traced: Tracer, parameters: Parameters) -> list[Tensor]:
        """Contribution of a chunk to each image, to the power that leaves the lens, and to the sum of power times squared angle."""
        states = traced(parameters)
        images = [traced.collect(states, screen, self.filter) for screen in self.screens]
        found = [self._pool(image.image) for image in images] + [images[0].leaving]
        if len(images) == 1:
            found.append(traced.weight * squared_angular_error(traced, states[0], self.scene))
        return found

    def _penalty(self, entrance: Tensor, exit: Tensor) -> Tensor | float:
        """Penalties of both surfaces, each from outside the glass."""
        return self.penalty(exit) + self.penalty(self.penalty.base - entrance) if self.penalty else 0.0

    def _loss(self, sums: list[Tensor], entering: Tensor, penalty: Tensor | float) -> Tensor:
        count = len(self.screens)
        leaving = sums[count]
        terms = [one(sums[k], leaving, entering=entering) * one.target.numel() for k, one in enumerate(self.losses)]
        squares = terms[0].square() + (terms[1].square() if count > 1 else sums[-1] / (leaving * SHARP**2))
        square, pixels = 0.5 * squares + penalty, self.loss.target.numel()
        if not float(square.detach()) > 0:
            return square / pixels  # zero loss: the square root has no derivative there, its square has
        return square.sqrt() / pixels
