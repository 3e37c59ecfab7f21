"""The loss of a lens with two free-form surfaces: of its picture, and of a second picture or the ray directions behind it.

    loss = sqrt(w_1 t_1^2 + w_2 t_2^2) / pixels,    w_1 + w_2 = 1

t_1 is the error of the picture on the screen (`losses`); t_2 that of a second picture on a screen farther away, or the RMS angle
between the directions of the rays and the prescribed ones, weighted by power, over SHARP.  The weights are 1/2, unless two pictures
are balanced: that with the larger error then has the larger weight.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from caustic_cli.inverse.objective import Channel, Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.angular_error import squared_angular_error
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import ENTRANCE, EXIT
from caustic_cli.optics.trace import Parameters, Tracer
from caustic_cli.scene import Scene

#: Angle, rad, equivalent to a relative RMS error of 1.
SHARP = 1e-2
#: Power of the squared errors of two pictures to which their weights are proportional.  Of flame and ball the flame, which has 1.3
#: times the error after 60 iterations with equal weights, is then as good as the ball after 90 more.
BALANCE = 2.0


class TwoSidedObjective(Objective):
    """The loss as a function of the heights of entrance and exit, (2, n, m) mm.

    Args:
        scene: with a `second`; field: spline spaces of both sides; sampler: the rays, the same at every evaluation.
        targets: irradiance (n_x, n_y) on the scene's screen, and on that of its `second`, if it has one.
        loss, how, options: as of `Objective`.
    """

    graphs = 4  # 0.6 KiB per ray
    #: w_1 and w_2, and t_1^2 and t_2^2 of the last evaluation.
    weights, squares = (0.5, 0.5), (0.0, 0.0)

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        sampler: Rays,
        targets: tuple[Tensor, ...],
        loss: str,
        how: LossImage | None = None,
        **options: Any,
    ):
        assert scene.second_target is not None
        super().__init__(scene, field, sampler, targets[0], loss, how, **options)
        if scene.second_target.screen is not None:
            self.channels.append(Channel(scene.second_target.screen, targets[1].to(self.device), loss, how or LossImage()))
        self.further = 2 - len(self.channels)

    def balanced(self, heights: Tensor) -> TwoSidedObjective:
        """Itself, with the weights of the errors that there are at heights (2, n, m), mm."""
        self(heights)
        first, other = (square**BALANCE for square in self.squares)
        if first + other > 0:
            self.weights = first / (first + other), other / (first + other)
        return self

    def _see(self, traced: Tracer, parameters: Parameters) -> list[Tensor]:
        """For a single picture, the last is the sum of power times squared angle to the prescribed direction."""
        states = traced(parameters)
        images = [traced.collect(states, channel.screen, channel.how.filter) for channel in self.channels]
        found = [channel.pooled(image.image) for channel, image in zip(self.channels, images, strict=True)] + [images[0].leaving]
        if len(images) == 1:
            found.append(traced.of_color(traced.weight * squared_angular_error(traced, states[0], self.scene)))
        return found

    def _penalty(self, parameters: Parameters) -> Tensor:
        """Penalties of both surfaces, each from outside the glass."""
        return self.penalty(parameters[EXIT]) + self.penalty(self.penalty.base - parameters[ENTRANCE])

    def _loss(self, seen: list[Tensor], sums: list[Tensor], penalty: Tensor, entering: Tensor) -> Tensor:
        leaving, *angles = sums
        terms = [
            (channel.loss(image, leaving, entering=entering) * channel.loss.target.numel()).square()
            for channel, image in zip(self.channels, seen, strict=True)
        ]
        first, other = *terms, *(angle.sum() / (leaving.sum() * SHARP**2) for angle in angles)
        self.squares = float(first.detach()), float(other.detach())
        square, pixels = self.weights[0] * first + self.weights[1] * other + penalty, self.loss.target.numel()
        if not float(square.detach()) > 0:
            return square / pixels  # zero loss: the square root has no derivative there, its square has
        return square.sqrt() / pixels
