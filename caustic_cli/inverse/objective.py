"""The objective function: the loss of control heights and its gradient, for a fixed set of rays.

    Scene + heights -> trace -> landing points, weights -> reconstruct -> image -> loss

Everything that does not depend on the heights (basis matrices, filtered target, blur) is made once.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from caustic_cli.inverse import ranks
from caustic_cli.inverse.loss_terms import PENALTIES, parse
from caustic_cli.inverse.losses import ColorLoss, Loss
from caustic_cli.inverse.penalties import Penalty
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.memory import smaller_chunk
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.spread import Convolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import Parameters, Tracer, tracers
from caustic_cli.scene import Scene

#: Rays traced at a time, and most rays whose prepared chunks are kept between evaluations; and the same for tensor grids of axial
#: rays, which need little memory per ray: 8e6 on 2000 x 2000 pixels take 0.6 s, by 2^20 at a time 3 s.
CHUNK, KEPT_RAYS = 1 << 20, 1 << 22
CHUNK_OF_ROWS, KEPT_OF_ROWS = 1 << 24, 1 << 25


@dataclass(frozen=True)
class Evaluation:
    """Loss (units of eq. 5.2.1), its gradients with respect to the heights of each surface (n, m) per mm, the fraction of the light
    on the screen, and the image there, power per pixel, (n_x, n_y) or (3, n_x, n_y)."""

    loss: float
    gradients: dict[str, Tensor]
    on_screen: float
    image: Tensor

    @property
    def gradient(self) -> Tensor:
        """Gradient of the exit (n, m), or of all surfaces, (k, n, m)."""
        return torch.stack([*self.gradients.values()]) if len(self.gradients) > 1 else self.gradients[EXIT]


def penalty_of(
    scene: Scene, field: HeightField, loss: str, max_slope: float, min_radius: float, device: str | torch.device
) -> Penalty:
    """The penalty terms of the surface, from a loss and the limits."""
    terms = [(weight, name) for weight, name in parse(loss) if name in PENALTIES and weight > 0]
    return Penalty(scene, field, terms, max_slope, device, min_radius)


class Objective:
    """The loss as a function of the heights.

    Args:
        scene: with the screen of the picture.
        field: spline spaces of the heights.
        sampler: the rays, the same at every evaluation; or a list with those of several points of the source.
        filter: reconstruction filter.
        target: (n_x, n_y) irradiance on the scene's screen, or (3, n_x, n_y) of a coloured scene.
        loss: weighted terms, see `losses.parse`.
        blur: pixels, see `Loss`.
        filter_target: filter the target as the render is filtered.
        apron: pixels of a dark guard band around the target, in which light beside the screen contributes to the loss.
        max_slope: limit of the lens' slope, 0 for none; min_radius: least radius of concave regions, mm, 0 for any.
        oversample: the filter is applied on pixels smaller by this factor along each axis, which are then summed: a render
            close to a bincount, and yet differentiable with respect to the heights.
        spread: convolution for the image of each point, with the section of the source that it represents; empty for rays of the
            whole source.  The image is then traced on a margin from which light is spread onto screen and apron.
        expected: fraction of the light that can be on screen and apron behind the blur of the source.
        dtype: precision of the rays.
    """

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        sampler: Rays | Sequence[Rays],
        filter: Filter,
        target: Tensor,
        loss: str,
        *,
        blur: float = 0.0,
        filter_target: bool = True,
        apron: int = 0,
        max_slope: float = 0.0,
        min_radius: float = 0.0,
        oversample: int = 1,
        spread: Sequence[Convolution] = (),
        expected: float = 1.0,
        dtype: torch.dtype = torch.float32,
    ):
        self.samplers = list(sampler) if isinstance(sampler, Sequence) else [sampler]
        self.device = self.samplers[0].device
        self.spread, self.cut = list(spread), spread[0].cut if spread else 1
        beside = (n // self.cut for n in spread[0].beside) if spread else (0, 0)
        screen = scene.screen.grown(tuple(apron + n for n in beside))
        self.screen = replace(screen, resolution=tuple(oversample * n for n in screen.resolution))
        self.filter, self.apron, self.oversample = filter, apron, oversample
        wide = torch.nn.functional.pad(target.double().to(self.device), (apron, apron, apron, apron))
        smooth = wide
        if filter_target:
            fine = wide.repeat_interleave(oversample, -2).repeat_interleave(oversample, -1)
            smooth = self._pool(torch.stack([filter.smooth(c) for c in fine]) if scene.colored else filter.smooth(fine))
        self.loss = (ColorLoss if scene.colored else Loss)(loss, smooth, blur, apron, wide > 0)
        self.penalty = penalty_of(scene, field, loss, max_slope, min_radius, self.device)
        self.scene, self.field, self.dtype = scene, field, dtype
        self.expected, self.chunk, self.kept, kept = expected, CHUNK, None, KEPT_RAYS
        try:
            if self._rows():
                self.chunk, kept = CHUNK_OF_ROWS, KEPT_OF_ROWS
            if sum(s.count for s in self.samplers) <= kept:
                self.kept = list(self._tracers())
        except (MemoryError, RuntimeError) as error:
            self.chunk = smaller_chunk(self.chunk, error)

    def moved(self, scene: Scene, rays: Rays) -> Objective:
        """The same objective for another position of screen or source and other rays, sharing the filtered target."""
        other = copy.copy(self)
        other.scene, other.screen, other.samplers = scene, replace(self.screen, z=scene.screen.z), [rays]
        other.kept = None if self.kept is None else list(other._tracers())
        return other

    @property
    def whole(self) -> bool:
        """Whether the graphs of all chunks are kept: a fused kernel stores the net or the surface at its rays, a staged trace every
        ray after each stage."""
        return self.kept is not None and (sum(t.fused is None for _, t in self.kept) <= 1)

    def _rows(self) -> bool:
        """Whether the rays are a tensor grid of an axial plane wave, for which there is a fused kernel."""
        if not (self.screen.upright and all(isinstance(s, Sampler) and s.tensor for s in self.samplers)):
            return False
        _, first = next(self._tracers(), (0, None))
        return first is not None and first.fused is not None and first.start.along_axis

    def _pool(self, image: Tensor, cut: int = 1) -> Tensor:
        """Pixels of the screen, each subdivided by `cut` along each axis, from those of the render, by summation."""
        k, (*colors, n, m) = self.oversample // cut, image.shape
        if k == 1:
            return image
        return avg_pool2d(image.view(-1, n, m), k, divisor_override=1).view(*colors, n // k, m // k)  # sums; faster than .sum

    def _spread_out(self, images: Tensor) -> Tensor:
        """The image on screen and apron of the whole source, from those of its points."""
        if not self.spread:
            return images[0]
        return sum(
            torch.stack([spread(c) for c in image]) if image.ndim == 3 else spread(image)
            for spread, image in zip(self.spread, images, strict=True)
        )

    def _expected_power(self, seen: Tensor, leaving: Tensor) -> Tensor:
        """Power to which the loss normalises an image: all that leaves the lens; with a blur that in the image, but at least what
        can be expected there."""
        return torch.maximum(seen.sum((-2, -1)), self.expected * leaving) if self.spread else leaving

    def _tracers(self) -> Iterator[tuple[int, Tracer]]:
        """Tracers of the chunks of this rank, each with the index of its source point."""
        rank, count = ranks.rank_and_size()
        for k, sampler in enumerate(self.samplers):
            size = min(self.chunk, math.ceil(sampler.count / count)) if count > 1 else self.chunk
            for traced in tracers(self.scene, self.field, sampler, self.dtype, size, part=(rank, count)):
                yield k, traced

    def __call__(self, heights: Tensor) -> Evaluation:
        """`evaluate` at the heights (n, m) mm float64 of the exit, or of all surfaces that are `shaped`, (k, n, m)."""
        return self.evaluate({EXIT: heights} if heights.ndim == 2 else dict(zip(self.scene.free_surfaces, heights, strict=True)))

    def evaluate(self, parameters: Parameters) -> Evaluation:
        """Value and gradients at heights {name of a surface: (n, m) mm float64}.

        The loss depends on the rays through the image alone.  So the image is accumulated chunk by chunk, the loss is
        differentiated with respect to the image, and each chunk is traced again for the vector-Jacobian product: memory does not
        grow with the number of rays.  Small graphs are kept instead of tracing again.  When memory runs out, smaller chunks are
        tried.

        Raises:
            CausticError: out of memory, or no light reaches the screen.
        """
        while True:
            try:
                return self._evaluate(parameters)
            except (MemoryError, RuntimeError) as error:
                if ranks.rank_and_size()[1] > 1:  # the other ranks wait for the image of this chunk
                    raise
                problem = error.with_traceback(None)  # the traceback would keep all allocations alive
            self.chunk, self.kept = smaller_chunk(self.chunk, problem), None

    def _evaluate(self, given: Parameters) -> Evaluation:
        parameters = {name: heights.detach().to(self.device).clone() for name, heights in given.items()}
        for heights in parameters.values():
            ranks.broadcast(heights)
            heights.requires_grad_()
        leaves = list(parameters.values())
        penalty = self.penalty(parameters[EXIT]) if self.penalty else torch.zeros((), device=self.device)
        shape = tuple(n // (self.oversample // self.cut) for n in self.screen.resolution)
        shape = (3, *shape) if self.scene.colored else shape
        image = torch.zeros((len(self.samplers), *shape), dtype=torch.float64, device=self.device)
        leaving, entering, parts = image.new_zeros(shape[:-2]), image.new_zeros(shape[:-2]), []  # one for each colour
        with torch.set_grad_enabled(self.whole):
            for k, traced in self.kept or self._tracers():
                part = self._see(traced, parameters)
                image[k] += part[0].detach()
                leaving, entering = leaving + part[1].detach().double(), entering + traced.entering.double()
                if self.whole:
                    parts.append((k, part))
        ranks.all_reduce(image, leaving, entering)
        image, leaving = image.requires_grad_(), leaving.requires_grad_()
        seen = self._spread_out(image)
        loss = self.loss(seen, self._expected_power(seen, leaving), penalty, entering)
        wanted = [image, leaving, *leaves] if penalty.requires_grad else [image, leaving]
        by_image, by_leaving, *direct = torch.autograd.grad(loss, wanted, allow_unused=True)
        gradients = [torch.zeros_like(heights) for heights in leaves]
        for k, part in parts or ((k, self._see(traced, parameters)) for k, traced in self.kept or self._tracers()):
            # Bincount images, and the power that leaves a lens without reflections, do not depend on the heights.
            pulls = [
                (value, by.to(value.dtype))
                for value, by in zip(part, (by_image[k], by_leaving), strict=True)
                if value.requires_grad and by is not None
            ]
            if pulls:
                values, by = zip(*pulls, strict=True)
                for gradient, more in zip(gradients, torch.autograd.grad(values, leaves, by, allow_unused=True), strict=True):
                    if more is not None:
                        gradient += more
        ranks.all_reduce(*gradients)
        for gradient, more in zip(gradients, direct or [None] * len(gradients), strict=True):
            if more is not None:
                gradient += more
        a = self.apron
        inner = seen.detach()[..., a : seen.shape[-2] - a, a : seen.shape[-1] - a]
        return Evaluation(float(loss.detach()), dict(zip(parameters, gradients, strict=True)), float(inner.sum()), inner)

    def _see(self, traced: Tracer, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Contribution of a chunk to the image, and to the power that leaves the lens."""
        part = traced.expose(parameters, self.screen, self.filter)
        return self._pool(part.image, self.cut), part.leaving
