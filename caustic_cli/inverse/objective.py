"""The loss of a set of control heights and its derivative, over one fixed set of rays.

    Scene + heights -> trace -> landing points, weights -> reconstruct -> image -> loss

Everything that does not depend on the heights (basis matrices, filtered target, blur) is made once.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.inverse.losses import Loss
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.tracing import PlaneTracer
from caustic_cli.scene import Scene


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
        target: (n_x, n_y) irradiance on the scene's screen.
        loss: name of the loss.
        blur: pixels, see `Loss`.
        filter_target: filter the target as the render is filtered.
        apron: pixels by which the screen is widened on every side, dark in the target: light that has left the screen
            is seen there and pulled back.
        dtype: precision of the rays.
    """

    def __init__(self, scene: Scene, field: HeightField, sampler: Sampler, filter: Filter, target: Tensor, loss: str, *,
                 blur: float = 0.0, filter_target: bool = True, apron: int = 0, dtype: torch.dtype = torch.float32):
        self.device = sampler.device
        self.screen, self.filter, self.apron = scene.screen.grown((apron, apron)), filter, apron
        wide = torch.nn.functional.pad(target.double().to(sampler.device), (apron, apron, apron, apron))
        self.loss = Loss(loss, filter.smooth(wide) if filter_target else wide, blur)
        self.tracers = [PlaneTracer(scene, field, s, dtype) for s in sampler.chunks()]

    def image(self, heights: Tensor) -> tuple[Tensor, Tensor]:
        """Differentiable image (n_x, n_y) on the widened screen, and the power leaving the lens; both float64."""
        image, leaving = 0.0, 0.0
        for tracer in self.tracers:
            landing = tracer(heights)
            image = image + splat(landing.x, landing.y, landing.weight, self.screen, self.filter)[0].double()
            leaving = leaving + landing.leaving.double()
        return image, leaving

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradient at heights (n, m) mm float64."""
        heights = heights.detach().to(self.device).requires_grad_()
        image, leaving = self.image(heights)
        loss = self.loss(image, leaving)
        (gradient,) = torch.autograd.grad(loss, heights)
        a = self.apron
        inner = image.detach()[a : image.shape[0] - a, a : image.shape[1] - a]
        return Evaluation(float(loss.detach()), gradient, float(inner.sum()))
