"""The objective function: the loss of control heights and its gradient, for a fixed set of rays.

    Scene + heights -> trace -> landing points, weights -> reconstruct -> image on each screen -> loss

An objective is a sum over channels, each the image on a screen against its target, and over further scalar terms, sums over rays:

    loss = sqrt(sum_c weight_c t_c^2 + sum_j weight_j s_j / P_out + penalties of the surface) / pixels

with t_c the loss of channel c (`losses`), s_j a sum over rays, and P_out the power that leaves the lens.  Everything that does not
depend on the heights (basis matrices, filtered target, blur) is made once.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, cast

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.loss_terms import PENALTIES, parse
from caustic_cli.inverse.losses import ColorLoss, Loss
from caustic_cli.inverse.penalties import Penalty
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics import ranks
from caustic_cli.optics.emission import Emission, Rays
from caustic_cli.optics.memory import smaller_chunk
from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import Parameters, Tracer, dealt_tracers, is_by_rows
from caustic_cli.scene import Scene, Screen

if TYPE_CHECKING:
    from caustic_cli.optics.spread import Convolution

#: Rays traced at a time, and most rays whose prepared chunks are kept between evaluations; and the same for tensor grids of axial
#: rays, which need little memory per ray: 8e6 on 2000 x 2000 pixels take 0.6 s, by 2^20 at a time 3 s.
CHUNK, KEPT_RAYS = 1 << 20, 1 << 22
CHUNK_OF_ROWS, KEPT_OF_ROWS = 1 << 24, 1 << 25


@dataclass(frozen=True)
class Evaluation:
    """Loss (units of eq. 5.2.1), its gradients with respect to the heights of each surface (n, m) per mm, the fraction of the light
    on the screen, and the image there, power per pixel, (n_x, n_y), or (3, n_x, n_y) for channels or tristimulus values."""

    loss: float
    gradients: dict[str, Tensor]
    on_screen: float
    image: Tensor

    @property
    def finite(self) -> bool:
        """Whether loss and gradient are finite."""
        return math.isfinite(self.loss) and bool(torch.isfinite(self.gradient).all())

    @property
    def gradient(self) -> Tensor:
        """Gradient of the exit (n, m), or of all surfaces, (k, n, m)."""
        return self.gradients[EXIT]


class LossOfHeights(Protocol):
    """The loss as a function of the heights, in the optimisers' eyes."""

    loss: Loss | ColorLoss

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradient at heights, mm."""


class LossOfLens(Protocol):
    """The loss as a function of the heights of the exit and of further parameters of the trace."""

    loss: Loss | ColorLoss

    def evaluate(self, parameters: Parameters) -> Evaluation:
        """Value and gradients."""


def penalty_of(scene: Scene, field: HeightField, loss: str, limits: Limits, device: str | torch.device) -> Penalty:
    """The penalty terms of the surface, from a loss and the limits."""
    terms = [(weight, name) for weight, name in parse(loss) if name in PENALTIES and weight > 0]
    return Penalty(scene, field, terms, limits.max_slope, device, limits.min_radius)


class Unblurred:
    """What the extent of the source does to an image by rays of the whole source: nothing."""

    #: Subdivisions of a pixel in the images that are convolved, and pixels of the margin along each axis.
    cut = 1
    beside = (0, 0)

    def spread_out(self, images: Tensor) -> Tensor:
        """The image on screen and apron of the whole source, from those of its points."""
        return images[0]

    def expected_power(self, seen: Tensor, leaving: Tensor) -> Tensor:
        """Power to which the loss normalises an image: all that leaves the lens."""
        return leaving


class SourceBlur(Unblurred):
    """What it does to the image of its points, which is traced on a margin from which light is spread onto screen and apron.

    Args:
        spread: convolution for the image of each point, with the section of the source that it represents.
        expected: fraction of the light that can be on screen and apron behind the blur.
    """

    def __init__(self, spread: Sequence[Convolution], expected: float = 1.0):
        self.spread, self.expected, self.cut = spread, expected, spread[0].cut
        x, y = spread[0].beside
        self.beside = x // self.cut, y // self.cut

    def spread_out(self, images: Tensor) -> Tensor:
        """As of rays of the whole source."""
        total: Tensor | int = 0
        for spread, image in zip(self.spread, images, strict=True):
            total = total + (torch.stack([spread(c) for c in image]) if image.ndim == 3 else spread(image))
        return cast(Tensor, total)

    def expected_power(self, seen: Tensor, leaving: Tensor) -> Tensor:
        """That in the image, but at least what can be expected there."""
        return torch.maximum(seen.sum((-2, -1)), self.expected * leaving)


UNBLURRED = Unblurred()


class Channel:
    """The image on one screen, compared with its target.

    Args:
        screen: of the picture; target: (n_x, n_y) irradiance there, or (3, n_x, n_y) in colour.
        loss: weighted terms, see `losses.parse`; how: see `LossImage`; blur: of the source.
    """

    def __init__(self, screen: Screen, target: Tensor, loss: str, how: LossImage, blur: Unblurred = UNBLURRED):
        self.how, self.cut = how, blur.cut
        grown = screen.grown((how.apron + blur.beside[0], how.apron + blur.beside[1]))
        nx, ny = grown.resolution
        self.screen = replace(grown, resolution=(how.oversample * nx, how.oversample * ny))
        wide = torch.nn.functional.pad(target.double(), (how.apron,) * 4)
        smooth = wide
        if how.filter_target:
            fine = wide.repeat_interleave(how.oversample, -2).repeat_interleave(how.oversample, -1)
            colors = [how.filter.smooth(c) for c in fine.reshape(-1, *fine.shape[-2:])]
            smooth = self._pool(torch.stack(colors).view(fine.shape), 1)
        self.loss = (Loss if target.ndim == 2 else ColorLoss)(loss, smooth, how.blur, how.apron, wide > 0, how.bright)
        cells = how.oversample // self.cut
        self.shape = (*target.shape[:-2], *(n // cells for n in self.screen.resolution))

    def _pool(self, image: Tensor, cut: int) -> Tensor:
        """Pixels of the screen, each subdivided by `cut` along each axis, from those of the render, by summation."""
        k, (*colors, n, m) = self.how.oversample // cut, image.shape
        if k == 1:
            return image
        return avg_pool2d(image.view(-1, n, m), k, divisor_override=1).view(*colors, n // k, m // k)  # sums; faster than .sum

    def pooled(self, image: Tensor) -> Tensor:
        """An image of the render on the pixels that are compared, or convolved with the blur of the source."""
        return self._pool(image, self.cut)

    def inner(self, image: Tensor) -> Tensor:
        """The screen without its apron."""
        a = self.how.apron
        return image[..., a : image.shape[-2] - a, a : image.shape[-1] - a]


class Objective:
    """The loss as a function of the heights, for the image on the scene's screen; a subclass adds channels and terms.

    Args:
        scene: with the screen of the picture.
        field: spline spaces of the heights.
        sampler: the rays, the same at every evaluation; or a list with those of several points of the source.
        target: (n_x, n_y) irradiance on the scene's screen, or (3, n_x, n_y) of a coloured scene.
        loss: weighted terms, see `losses.parse`.
        how: render and comparison, see `LossImage`.
        limits: of the surface, enforced by penalties.
        blur: of the source, where `sampler` has the rays of its points.
        dtype: precision of the rays.
    """

    #: Most chunks of a staged trace whose graphs are kept for the gradient; more are traced twice.
    graphs = 1
    #: Number of sums over rays beyond images and the power that leaves the lens.
    further = 0

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        sampler: Rays | Sequence[Rays],
        target: Tensor,
        loss: str,
        how: LossImage | None = None,
        limits: Limits | None = None,
        *,
        blur: Unblurred = UNBLURRED,
        dtype: torch.dtype = torch.float32,
    ):
        self.samplers = list(sampler) if isinstance(sampler, Sequence) else [sampler]
        self.device = self.samplers[0].device
        self.channels = [Channel(scene.screen, target.to(self.device), loss, how or LossImage(), blur)]
        self.loss = self.channels[0].loss
        self.penalty = penalty_of(scene, field, loss, limits or Limits(), self.device)
        self.scene, self.field, self.dtype, self.blur = scene, field, dtype, blur
        self.chunk, self.kept, kept = CHUNK, None, KEPT_RAYS
        #: Rank of this process and number of those among which the chunks of rays are dealt out.
        self.share = ranks.rank_and_size()
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
        channel = copy.copy(self.channels[0])
        channel.screen = replace(channel.screen, z=scene.screen.z, shift=scene.screen.shift)
        other.scene, other.channels, other.samplers = scene, [channel], [rays]
        other.kept = None if self.kept is None else list(other._tracers())
        return other

    @property
    def keeps_graphs(self) -> bool:
        """Whether the graphs of all chunks are kept: a fused kernel stores the net or the surface at its rays, a staged trace every
        ray after each stage."""
        if self.kept is None:
            return False
        return len(self.kept) <= self.graphs or all(traced is None or traced.fused is not None for _, traced in self.kept)

    def _rows(self) -> bool:
        """Whether the rays are a tensor grid on the exit, for which there is a fused kernel."""
        if not all(isinstance(s, (Sampler, Emission)) and s.tensor for s in self.samplers):
            return False
        return all(is_by_rows(self.scene, self.field, s, self.scene.screen) for s in self.samplers)

    def _tracers(self) -> Iterator[tuple[int, Tracer | None]]:
        """Tracers of all chunks, None for those of other ranks, each with the index of its source point."""
        own = ranks.turns(self.share)
        for k, sampler in enumerate(self.samplers):
            for traced in dealt_tracers(self.scene, self.field, sampler, self.dtype, self.chunk, own=own):
                yield k, traced

    def __call__(self, heights: Tensor) -> Evaluation:
        """`evaluate` at the heights (n, m) mm float64 of the exit, or of all surfaces that are `shaped`, (k, n, m)."""
        return self.evaluate({EXIT: heights})

    def evaluate(self, parameters: Parameters) -> Evaluation:
        """Value and gradients at parameters of the trace, of which EXIT are the heights of the exit, (n, m) mm float64, or those of
        all free surfaces, (k, n, m).

        The loss depends on the rays through images and sums alone.  So these are accumulated chunk by chunk, the loss is
        differentiated with respect to them, and each chunk is traced again for the vector-Jacobian product: memory does not grow
        with the number of rays.  Small graphs are kept instead of tracing again.  When memory runs out, smaller chunks are tried.

        Raises:
            CausticError: out of memory, or no light reaches the screen.
        """
        while True:
            try:
                return self._evaluate(parameters)
            except (MemoryError, RuntimeError) as error:
                if self.share[1] > 1:  # the other ranks wait for the image of this chunk
                    raise
                problem = error.with_traceback(None)  # the traceback would keep all allocations alive
            self.chunk, self.kept = smaller_chunk(self.chunk, problem), None

    def _evaluate(self, given: Parameters) -> Evaluation:
        parameters = {name: heights.detach().to(self.device).clone() for name, heights in self._by_surface(given).items()}
        for heights in parameters.values():
            ranks.broadcast(heights)
            heights.requires_grad_()
        leaves = list(parameters.values())
        penalty = self._penalty(parameters) if self.penalty else torch.zeros((), device=self.device)
        sums, entering, contributions = self._sums(parameters)
        for value in sums:
            value.requires_grad_()
        seen = [self.blur.spread_out(images) for images in sums[: len(self.channels)]]
        loss = self._loss(seen, sums[len(self.channels) :], penalty, entering)
        wanted = [*sums, *leaves] if penalty.requires_grad else sums
        derivatives = torch.autograd.grad(loss, wanted, allow_unused=True)
        by, direct = derivatives[: len(sums)], derivatives[len(sums) :] or (None,) * len(leaves)
        gradients = [torch.zeros_like(heights) for heights in leaves]
        graphs = contributions or ((k, traced and self._see(traced, parameters)) for k, traced in self.kept or self._tracers())
        pulled = (found and self._pulled(found, self._of_point(by, k), leaves) for k, found in graphs)
        for more in ranks.in_order(pulled, gradients, self.share):
            _add(gradients, more)
        _add(gradients, direct)
        inner = self.channels[0].inner(seen[0].detach())
        by_name = dict(zip(parameters, gradients, strict=True))
        if len(parameters) > len(given):
            by_name[EXIT] = torch.stack([by_name[name] for name in self.scene.free_surfaces])
        return Evaluation(float(loss.detach()), {name: by_name[name] for name in given}, float(inner.sum()), inner)

    def _by_surface(self, given: Parameters) -> dict[str, Tensor]:
        """The parameters with the heights of every free surface by its name, where EXIT has those of all."""
        heights = given.get(EXIT)
        several = heights is not None and heights.ndim > 2
        return {**given, **(dict(zip(self.scene.free_surfaces, cast(Tensor, heights), strict=True)) if several else {})}

    def _sums(self, parameters: Parameters) -> tuple[list[Tensor], Tensor, list[tuple[int, list[Tensor] | None]]]:
        """Accumulated contributions of all chunks, see `_see`, images with an axis of source points in front; the power that
        enters; and the contributions with their graphs, where these are kept."""
        zero = torch.zeros(self.channels[0].shape[:-2], dtype=torch.float64, device=self.device)  # one for each colour
        sums = [zero.new_zeros(len(self.samplers), *channel.shape) for channel in self.channels]
        sums += [zero.clone() for _ in range(1 + self.further)]
        entering, contributions, points = zero.clone(), [], []

        def seen() -> Iterator[list[Tensor] | None]:
            for k, traced in self.kept or self._tracers():
                found = traced and self._see(traced, parameters)
                points.append(k)
                if self.keeps_graphs:
                    contributions.append((k, found))
                yield found and [*(more.detach() for more in found), traced.entering.double()]

        with torch.set_grad_enabled(self.keeps_graphs):
            for n, found in enumerate(ranks.in_order(seen(), [*self._of_point(sums, 0), entering], self.share)):
                _add(self._of_point(sums, points[n]), found[:-1])
                entering = entering + found[-1]
        return sums, entering, contributions

    @staticmethod
    def _pulled(contribution: list[Tensor], by: Sequence[Tensor | None], leaves: list[Tensor]) -> Sequence[Tensor | None]:
        """Derivatives by the leaves, None for zero, from those by a contribution."""
        # Bincount images, and the power that leaves a lens without reflections, do not depend on the heights.
        pulls = [
            (value, pull.to(value.dtype))
            for value, pull in zip(contribution, by, strict=True)
            if pull is not None and value.requires_grad
        ]
        if not pulls:
            return [None] * len(leaves)
        values, pulled = zip(*pulls, strict=True)
        return pull_back(values, leaves, pulled)

    def _of_point(self, values: Sequence[Tensor], k: int) -> list[Tensor]:
        """Of accumulated values, or their derivatives, which may be None, those of source point k."""
        count = len(self.channels)
        return [value if value is None else value[k] for value in values[:count]] + list(values[count:])

    def _see(self, traced: Tracer, parameters: Parameters) -> list[Tensor]:
        """Contribution of a chunk to the image of each channel, the power that leaves the lens, and further sums over rays."""
        channel = self.channels[0]
        exposure = traced.expose(parameters, channel.screen, channel.how.filter)
        return [channel.pooled(exposure.image), exposure.leaving]

    def _loss(self, seen: list[Tensor], sums: list[Tensor], penalty: Tensor, entering: Tensor) -> Tensor:
        """The loss of the images of all channels, the power that leaves the lens, and further sums over rays."""
        return self.loss(seen[0], self.blur.expected_power(seen[0], sums[0]), penalty, entering)

    def _penalty(self, parameters: Parameters) -> Tensor:
        """Weighted sum of squared penalties of the surfaces."""
        return self.penalty(parameters[EXIT])


def _add(values: Sequence[Tensor], more: Sequence[Tensor | None]) -> None:
    """Add to values in place, None for zero."""
    for value, summand in zip(values, more, strict=True):
        if summand is not None:
            value += summand
