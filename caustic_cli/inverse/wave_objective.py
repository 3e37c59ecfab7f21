"""The loss of a lens' wave image and its derivative by the control heights.

Linearised about the lens at the beginning of a stage, with heights h_0 and optical path length v_0(x) to a point x of the plane
behind it,

    v(x) = v_0(x) + c(x) (h - h_0)(s(x)),    c = n_in d_in - n_out d_out along the surface's normal axis

is the path length of a lens of heights h, by Fermat's principle exact to first order, where s(x) is the intersection of that ray
with the surface.  A refinement moves the surface by tenths of a micrometre, for which the second order is some thousandths of a
wavelength; the next stage starts from an exact trace again.  Amplitudes are those of the trace.  So an evaluation needs no ray
tracing: the spline at fixed points, one Fourier transform and its adjoint for each wavelength.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from torch import Tensor

from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.losses import ColorLoss, Loss
from caustic_cli.inverse.objective import Evaluation, penalty_of
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics import ranks
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.image import with_colour
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.waves.image import Imager, Line, by_source, lines_of
from caustic_cli.optics.waves.propagation import TURN, PrunedExposure, pruning_pays
from caustic_cli.optics.waves.unsupported import receiver_of
from caustic_cli.optics.waves.wavefront import Wavefront
from caustic_cli.scene import Scene

#: Most bytes of transforms kept for the gradient; beyond, each is computed twice.
KEPT = 1 << 30
#: Oversampling where light outside the picture is free, so that it lies where it would be aliased into the picture.
FINER = 1.5


@dataclass(frozen=True)
class Contribution:
    """Light of one wavelength and one mode, a point of the source: its image as a function of the change of its optical paths since
    h_0, and its total power."""

    line: Line
    #: Of the light of its source.
    imager: Imager
    mode: int
    #: Number of the wavefront, which parts with the same rays share.
    front: int
    #: None of another rank's.
    exposure: Any = None
    power: float = 0.0


class WaveObjective:
    """The loss as a function of the heights; see above.

    Args:
        scene: with the screen of the picture.
        field: spline spaces of the heights.
        heights: h_0 (n, m) mm.
        target, loss, limits: as of an `Objective`; how: only its blur and apron apply.
        wavelengths: nm, of a scene with a continuous spectrum, see `Light.lines`; empty for those of the verdict.
        dtype: of fields; paths are float64.

    Raises:
        NoWaveImage: no light, no single wavefront, or not enough memory.
    """

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        heights: Tensor,
        target: Tensor,
        loss: str,
        how: LossImage | None = None,
        limits: Limits | None = None,
        *,
        wavelengths: tuple[float, ...] = (),
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ):
        how, scene = how or LossImage(), scene.unfolded
        self.scene, self.field, self.apron, self.dtype = scene, field, how.apron, dtype
        self.middle = heights.detach().double().to(device)
        screen = scene.screen.grown((how.apron, how.apron))
        wide = torch.nn.functional.pad(target.double().to(device), (how.apron,) * 4)
        self.loss = (Loss if target.ndim == 2 else ColorLoss)(loss, wide, how.blur, how.apron, wide > 0, how.bright)
        self.penalty = penalty_of(scene, field, loss, limits or Limits(), device)
        lines = lines_of(scene, field, None if scene.light.continuum is None else wavelengths or None)
        #: Rank of this process and number of those among which the wavefronts are dealt out.
        self.share = ranks.rank_and_size()
        parameters = {EXIT: self.middle}
        with torch.no_grad():
            finer, lit = 1.0 if self.loss.box is None else FINER, _lit(scene, target)
            sources = [
                (Imager.of(light, parameters, receiver_of(light[0].system, screen), finer, watched=lit, dense=True), light)
                for light in by_source(lines)
            ]
            #: The wavefronts with the changes of their optical paths by the heights, by number; those of other ranks are missing.
            self.fronts: dict[int, tuple[Wavefront, Any]] = {}
            self.parts = list(self._parts(sources, parameters))
            self.numbers = sorted({part.front for part in self.parts})
        self.in_colour = lines[0].colour is not None
        self.colours = len({line.channel for line in lines if line.channel is not None})
        self.keeps = sum(8 * part.imager.sampling.samples for part in self.parts if self._is_own(part.front)) <= KEPT

    def _parts(self, sources: list[tuple[Imager, list[Line]]], parameters) -> Iterator[Contribution]:
        """All contributions, without an exposure those of other ranks."""
        numbers, backend = dict[tuple, int](), backend_for(self.middle.device)
        for imager, lines in sources:
            one_index = len({(id(line.system), line.label) for line in lines}) == 1  # for `image_at`, which rank 0 asks for
            for line, (k, mode) in product(lines, enumerate(imager.modes(lines[0].system))):
                # wavelengths of the same index have the same rays
                number = numbers.setdefault((id(line.system), line.label, k), len(numbers))
                own = self._is_own(number)
                if number not in self.fronts and (own or (one_index and self.share[0] == 0)):
                    front = imager.front(line, mode, parameters, sensitive=True)
                    self.fronts[number] = front, backend.path_change(self.field, front.last, self.dtype)
                if own:
                    front = self.fronts[number][0]
                    yield Contribution(line, imager, k, number, self._exposure(imager, line, front), front.power)
                else:
                    yield Contribution(line, imager, k, number)

    def _is_own(self, front: int) -> bool:
        """Whether a wavefront is this rank's."""
        return front % self.share[1] == self.share[0]

    def _exposure(self, imager: Imager, line: Line, front: Wavefront) -> Any:
        """The image of a contribution; only that part of it which the loss looks at, where this is faster."""
        box = self.loss.box
        if box is not None and imager.receiver.across and not imager.spreading:
            shape, edges = imager.sampling.padded, imager.edges(line)
            if pruning_pays(shape, imager.sampling.count, edges, box, True):
                return PrunedExposure(*imager.field(line, front, self.dtype), TURN / line.length, shape, edges, box, True)
        return imager.exposure(line, front, self.dtype)

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradient at heights (n, m) mm float64.

        Raises:
            NoLight: no light reaches the screen.
        """
        heights = heights.detach().to(self.middle).clone()
        ranks.broadcast(heights)
        heights.requires_grad_()
        penalty = self.penalty(heights) if self.penalty else torch.zeros((), dtype=torch.float64, device=heights.device)
        moved = heights.detach() - self.middle
        changes = {number: change.of(moved) for number, (_, change) in self.fronts.items() if self._is_own(number)}
        shape = (3, *self.loss.target.shape) if self.colours else self.loss.target.shape
        image = torch.zeros(shape, dtype=torch.float64, device=heights.device)
        leaving = image.new_zeros(image.shape[:-2])
        xyz: Tensor | None = None
        one = image.new_zeros(self.loss.target.shape[-2:])
        owners, own = [part.front for part in self.parts], (self._image(part, changes) for part in self.parts)
        for part, (power, passed) in zip(self.parts, ranks.in_order(own, [one, one.sum()], self.share, owners), strict=True):
            self._channel(image, part)[...] += power
            xyz = with_colour(xyz, power, part.line.colour)
            self._channel(leaving, part)[...] += passed
        image.requires_grad_()
        loss = self.loss(image, leaving, penalty)
        by_image, direct = (
            torch.autograd.grad(loss, (image, heights), allow_unused=True)
            if penalty.requires_grad
            else (*torch.autograd.grad(loss, (image,)), None)
        )
        by_changes = {number: torch.zeros_like(change) for number, change in changes.items()}
        for part in self.parts:
            if part.exposure is not None:
                pull = part.imager.gathered(part.line.part * self._channel(by_image, part), part.mode, part.exposure.resolution)
                part.exposure.pull(pull, changes[part.front], by_changes[part.front])
        gradient = torch.zeros_like(heights)
        pulled = ([self.fronts[k][1].pull(by_changes[k])] if k in by_changes else None for k in self.numbers)
        for (more,) in ranks.in_order(pulled, [gradient], self.share):
            gradient += more
        if direct is not None:
            gradient = gradient + direct
        a = self.apron
        inner, shown = (
            c[..., a : image.shape[-2] - a, a : image.shape[-1] - a] for c in (image.detach(), image if xyz is None else xyz)
        )
        return Evaluation(float(loss.detach()), {EXIT: gradient}, float(inner.sum()), shown.detach())

    def _image(self, part: Contribution, changes: dict[int, Tensor]) -> list[Tensor] | None:
        """Power of a part on the pixels, and in all; None of another rank's."""
        if part.exposure is None:
            return None
        found = part.imager.spread_out(part.exposure.image(changes[part.front], self.keeps), part.mode)
        return [part.line.part * found.double(), torch.tensor(part.line.part * part.power, dtype=torch.float64)]

    @torch.no_grad()
    def image_at(self, heights: Tensor, wavelengths: tuple[float, ...]) -> Tensor | None:
        """The image (n_x, n_y) at other wavelengths, nm, by the same wavefronts; None where these differ by wavelength."""
        lights, a = by_source(lines_of(self.scene, self.field, wavelengths)), self.apron
        fronts = {(id(part.imager), part.mode): part.front for part in self.parts}
        one_index = all(len({(id(line.system), line.label) for line in light}) == 1 for light in lights)
        if self.colours or len(fronts) != len(self.numbers) or not one_index:
            return None
        image = torch.zeros(self.loss.target.shape, dtype=torch.float64, device=self.middle.device)
        moved = heights.detach().to(self.middle) - self.middle
        imagers = {id(part.imager): part.imager for part in self.parts}.values()
        for imager, light in zip(imagers, lights, strict=True):
            for k in range(len(imager.modes(light[0].system))):
                front, change = self.fronts[fronts[id(imager), k]]
                changed = change.of(moved)
                for line in light:
                    found = self._exposure(imager, line, front).image(changed)
                    image += line.part * imager.spread_out(found, k).double()
        return image[a : image.shape[0] - a, a : image.shape[1] - a]

    def _channel(self, values: Tensor, part: Contribution) -> Tensor:
        return values if part.line.channel is None else values[part.line.channel]


def _lit(scene: Scene, target: Tensor) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lows and highs of the picture's bright part on an upright screen, mm."""
    grey = target if target.ndim == 2 else target.sum(0)
    found = []
    for k in (0, 1):
        at = (grey.sum(1 - k) > 0).nonzero()[:, 0]
        low, width = scene.screen.low[k], scene.screen.pixel[k]
        found.append((low + width * int(at[0]), low + width * (int(at[-1]) + 1)))
    return tuple(f[0] for f in found), tuple(f[1] for f in found)
