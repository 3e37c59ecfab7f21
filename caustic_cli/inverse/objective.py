"""The loss of a set of control heights and its derivative, over one fixed set of rays.

    Scene + heights -> trace -> landing points, weights -> reconstruct -> image -> loss

Everything that does not depend on the heights (basis matrices, filtered target, blur) is made once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from caustic_cli.inverse import ranks
from caustic_cli.inverse.losses import PENALTIES, ColorLoss, Loss, parse
from caustic_cli.inverse.penalties import Penalty
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.shortage import smaller
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
        self.chunk, self.kept = CHUNK, None
        if sampler.count <= KEPT_RAYS:
            try:
                self.kept = list(self._tracers())
            except (MemoryError, RuntimeError) as error:
                self.chunk = smaller(self.chunk, error)

    @property
    def whole(self) -> bool:
        """Whether chunks keep their graphs: a kernel's holds the net or the surface at its rays, plain torch's every step."""
        return self.kept is not None and (len(self.kept) == 1 or all(getattr(t, "kernel", None) is not None for t in self.kept))

    def _pool(self, image: Tensor) -> Tensor:
        """Pixels of the screen from those of the render."""
        k, (*colors, n, m) = self.oversample, image.shape
        return image if k == 1 else image.view(*colors, n // k, k, m // k, k).sum((-3, -1))

    def _tracers(self) -> Iterator[PlaneTracer | RayTracer | StepTracer | BandTracer]:
        """This rank's chunks, ready to be traced."""
        rank, count = ranks.place()
        size = min(self.chunk, math.ceil(self.sampler.count / count)) if count > 1 else self.chunk
        return tracers(self.scene, self.field, self.sampler, self.dtype, size, part=(rank, count))

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradient at heights (n, m) mm float64.

        The loss sees rays through the image alone.  So the image is accumulated chunk by chunk, the loss gives its
        derivative by the image, and each chunk is traced again to pull that back: memory does not grow with rays.
        Where there is little to keep, the graph is kept instead of tracing again.  Where memory runs out, smaller chunks are tried.

        Raises:
            CausticError: out of memory, or no light reaches the screen.
        """
        while True:
            try:
                return self._evaluate(heights)
            except (MemoryError, RuntimeError) as error:
                if ranks.place()[1] > 1:  # the others wait for this chunk's image
                    raise
                problem = error.with_traceback(None)  # which would hold all that was allocated
            self.chunk, self.kept = smaller(self.chunk, problem), None

    def _evaluate(self, heights: Tensor) -> Evaluation:
        heights = heights.detach().to(self.device).clone()
        ranks.share(heights)
        heights.requires_grad_()
        penalty = self.penalty(heights) if self.penalty else torch.zeros((), device=self.device)
        shape = (3, *self.loss.target.shape) if self.scene.colored else self.loss.target.shape
        image = torch.zeros(shape, dtype=torch.float64, device=self.device)
        leaving, parts = image.new_zeros(image.shape[:-2]), []  # one for each colour
        with torch.set_grad_enabled(self.whole):
            for traced in self.kept or self._tracers():
                part = self._see(traced, heights)
                image, leaving = image + part[0].detach().double(), leaving + part[1].detach().double()
                if self.whole:
                    parts.append(part)
        ranks.add(image, leaving)
        image, leaving = image.requires_grad_(), leaving.requires_grad_()
        loss = self.loss(image, leaving, penalty)
        wanted = (image, leaving, heights) if penalty.requires_grad else (image, leaving)
        by_image, by_leaving, *direct = torch.autograd.grad(loss, wanted, allow_unused=True)
        gradient = torch.zeros_like(heights)
        for part in parts or (self._see(traced, heights) for traced in self.kept or self._tracers()):
            # Whole pixels, and what leaves a lens without reflections, do not depend on the heights at all.
            pulls = [(value, by.to(value.dtype)) for value, by in zip(part, (by_image, by_leaving), strict=True)
                     if value.requires_grad and by is not None]
            if pulls:
                values, by = zip(*pulls, strict=True)
                gradient += torch.autograd.grad(values, heights, by)[0]
        ranks.add(gradient)
        if direct:
            gradient += direct[0]
        a = self.apron
        inner = image.detach()[..., a : image.shape[-2] - a, a : image.shape[-1] - a]
        return Evaluation(float(loss.detach()), gradient, float(inner.sum()))

    def _see(self, traced, heights: Tensor) -> tuple[Tensor, Tensor]:
        """What a chunk adds to the image, and to the power that leaves the lens."""
        part = traced.expose(heights, self.screen, self.filter)
        return self._pool(part.image), part.leaving
