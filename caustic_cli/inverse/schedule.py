"""Coarse-to-fine optimisation schedule: a list of stages.

Early stages compare blurred images on a small control net with few rays, late ones at full detail.  The blur halves from stage to
stage, so that the loss has a gradient towards features not yet reached.  Each stage traces its own rays.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SAMPLERS
from caustic_cli.scene import Source
from caustic_cli.schema import checks
from caustic_cli.schema.table import check_all, default

if TYPE_CHECKING:
    from caustic_cli.optics.region import Region

#: Rays whose cost equals that of the Fourier transform at one wavelength of a typical scene.
RAYS_A_WAVE = 600_000


@dataclass(frozen=True)
class LossImage:
    """How the image inside a loss is rendered, and compared with its target."""

    #: Reconstruction filter.
    filter: Filter = field(default_factory=lambda: Filter("cosine", (3, 3)))
    #: Standard deviation of the Gaussian blur of render and target, pixels.
    blur: float = default("design.stages.blur")
    #: Pixels of a dark guard band around the target, in which light beside the screen contributes to the loss.
    apron: int = default("design.stages.apron")
    #: The filter is applied on pixels smaller by this factor along each axis, which are then summed: a render close to a bincount,
    #: and yet differentiable with respect to the heights.
    oversample: int = default("design.stages.oversample")
    #: Whether the target is filtered as the render is.
    filter_target: bool = True
    #: Of the loss log-rms, see `losses`; None for its default.
    bright: Region | None = None

    def __post_init__(self):
        check_all("design.stages", self, "blur", "apron", "oversample")


@dataclass(frozen=True)
class Stage:
    """One stage of a design."""

    #: Control points along x and y; the surface of the stage before is represented on them.
    control: tuple[int, int]
    #: Number of rays.
    rays: int
    #: See `caustic_cli.optics.sampling`.
    sampler: str = "lines"
    #: The render inside the loss, and its comparison with the target.
    rendering: LossImage = field(default_factory=LossImage)
    #: Optimiser iterations; the last stage continues to the total of the design.
    iterations: int = 30
    #: Ends the stage when ten iterations lowered the loss by less than this part; 0 never.
    tolerance: float = 2e-3
    #: The source during this stage, None for that of the scene (6.4: a point first, then the grid).
    source: Source | None = None
    #: Wavelengths, nm, of the wave image, which is optimised instead of the ray image, unless the scene gives its own; empty for
    #: the ray image.
    waves: tuple[float, ...] = ()
    #: Rays are traced from the centre of the source, and their image is convolved with that of the source, where this is a good
    #: approximation.
    spread: bool = default("design.stages.spread")
    #: Each lenslet of an array is compared with its own target, see `lenslets.array_objective`.
    lenslets: bool = default("design.stages.lenslets")
    #: It is left out if a later stage can refine the wave image.
    spare: bool = default("design.stages.spare")

    def __post_init__(self):
        check_all("design.stages", self, "control", "rays", "iterations", "tolerance", "waves")
        checks.choice("⟨design.stages.sampler⟩", self.sampler, SAMPLERS)

    @property
    def cost(self) -> float:
        """Estimated cost of all its iterations, in units of one traced ray."""
        each = RAYS_A_WAVE * len(self.waves) if self.waves else self.rays
        return self.iterations * (each + 20.0 * self.control[0] * self.control[1])

    @property
    def light(self) -> str:
        """How its image is made, as a phrase."""
        if self.waves:
            return f"the wave image at {', '.join(f'{w:.4g}' for w in self.waves)} nm"
        return f"{self.rays:,} rays, blur {self.rendering.blur:g} px"
