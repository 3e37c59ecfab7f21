"""The loss of a set of control heights and its derivative, over one fixed set of rays.

    Scene + heights -> trace -> landing points, weights -> reconstruct -> image -> loss

Everything that does not depend on the heights (basis matrices, filtered target, blur) is made once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from caustic_cli.inverse.losses import PENALTIES, ColorLoss, Loss, parse
from caustic_cli.inverse.penalties import Penalty
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.tracing import BandTracer, PlaneTracer, RayTracer, StepTracer, tracers
from caustic_cli.scene import Scene

#: Rays traced at a time, and the number up to which the prepared chunks are kept from one evaluation to the next.
CHUNK, KEPT_RAYS = 1 << 20, 1 << 22


@dataclass(frozen=True)
class Evaluation:
    """Loss (units of eq. 5.2.1), its gradient over the heights (n, m) per mm, and the part of the light on the screen."""

    loss: float
    gradient: Tensor
    on_screen: float


class Objective:
    """The loss as a function of the heights.

    Args:
        scene: its screen is the one the picture is judged on.
        field: spline spaces of the heights.
        sampler: the rays, the same at every evaluation.
        filter: reconstruction filter.
        target: (n_x, n_y) irradiance on the scene's screen, or (3, n_x, n_y) of a coloured scene.
        loss: weighted terms, see `losses.parse`.
        blur: pixels, see `Loss`.
        filter_target: filter the target as the render is filtered.
        apron: pixels by which the screen is widened on every side, dark in the target: light that has left the screen
            is seen there and pulled back.
        max_slope: limit of the lens' slope, 0 for none; min_radius: least radius of concave places, mm, 0 for any.
        oversample: the filter works on pixels so many times smaller along each axis, which are then added up: a render that
            is nearly a bincount, and yet smooth in the heights.
        dtype: precision of the rays.
    """

    def __init__(self, scene: Scene, field: HeightField, sampler: Rays, filter: Filter, target: Tensor, loss: str, *,
                 blur: float = 0.0, filter_target: bool = True, apron: int = 0, max_slope: float = 0.0, min_radius: float = 0.0,
                 oversample: int = 1, dtype: torch.dtype = torch.float32):
        self.device = sampler.device
        screen = scene.screen.grown((apron, apron))
        self.screen = replace(screen, resolution=tuple(oversample * n for n in screen.resolution))
        self.filter, self.apron, self.oversample = filter, apron, oversample
        wide = torch.nn.functional.pad(target.double().to(sampler.device), (apron, apron, apron, apron))
        smooth = wide
        if filter_target:
            fine = wide.repeat_interleave(oversample, -2).repeat_interleave(oversample, -1)
            smooth = self._pool(torch.stack([filter.smooth(c) for c in fine]) if scene.colored else filter.smooth(fine))
        self.loss = (ColorLoss if scene.colored else Loss)(loss, smooth, blur, apron, wide > 0)
        minded = [(weight, name) for weight, name in parse(loss) if name in PENALTIES and weight > 0]
        self.penalty = Penalty(scene, field, minded, max_slope, sampler.device, min_radius)
        self.scene, self.field, self.sampler, self.dtype = scene, field, sampler, dtype
        self.kept = list(self._tracers()) if sampler.count <= KEPT_RAYS else None
        # A kernel's graph holds the net or the surface at its rays, plain torch's every step on the way.
        light = [getattr(t, "kernel", None) is not None for t in self.kept or ()]
        self.whole = len(light) == 1 or (len(light) > 1 and all(light))

    def _pool(self, image: Tensor) -> Tensor:
        """Pixels of the screen from those of the render."""
        k, (*colors, n, m) = self.oversample, image.shape
        return image if k == 1 else image.view(*colors, n // k, k, m // k, k).sum((-3, -1))

    def _tracers(self) -> Iterator[PlaneTracer | RayTracer | StepTracer | BandTracer]:
        return tracers(self.scene, self.field, self.sampler, self.dtype, CHUNK)

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradient at heights (n, m) mm float64.

        The loss sees rays through the image alone.  So the image is accumulated chunk by chunk, the loss gives its
        derivative by the image, and each chunk is traced again to pull that back: memory does not grow with rays.
        Where there is little to keep, the graph is kept instead of tracing again.
        """
        heights = heights.detach().to(self.device).requires_grad_()
        image, leaving, penalty = 0.0, 0.0, self.penalty(heights) if self.penalty else torch.zeros((), device=self.device)
        with torch.set_grad_enabled(self.whole):
            for traced in self.kept or self._tracers():
                part = traced.expose(heights, self.screen, self.filter)
                image, leaving = image + self._pool(part.image).double(), leaving + part.leaving.double()
        if self.whole:
            loss = self.loss(image, leaving, penalty)
            gradient = torch.autograd.grad(loss, heights)[0] if loss.requires_grad else torch.zeros_like(heights)
        else:
            image, leaving = image.requires_grad_(), leaving.requires_grad_()
            loss = self.loss(image, leaving, penalty)
            wanted = (image, leaving, heights) if penalty.requires_grad else (image, leaving)
            by_image, by_leaving, *direct = torch.autograd.grad(loss, wanted, allow_unused=True)
            by_leaving = torch.zeros_like(leaving) if by_leaving is None else by_leaving
            gradient = direct[0] if direct else torch.zeros_like(heights)
            for traced in self.kept or self._tracers():
                part = traced.expose(heights, self.screen, self.filter)
                # Whole pixels, and what leaves a lens without reflections, do not depend on the heights at all.
                both = ((self._pool(part.image), by_image), (part.leaving, by_leaving))
                pulls = [(value, by.to(value.dtype)) for value, by in both if value.requires_grad]
                if pulls:
                    values, by = zip(*pulls, strict=True)
                    gradient += torch.autograd.grad(values, heights, by)[0]
        a = self.apron
        inner = image.detach()[..., a : image.shape[-2] - a, a : image.shape[-1] - a]
        return Evaluation(float(loss.detach()), gradient, float(inner.sum()))
