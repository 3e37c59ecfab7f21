"""Coarse-to-fine optimisation schedule: a list of stages.

Early stages compare blurred images on a small control net with few rays, late ones at full detail.  The blur halves from stage to
stage, so that the loss has a gradient towards features not yet reached.  Each stage traces its own rays.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from caustic_cli.config import checks
from caustic_cli.config.table import check_all, default
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SAMPLERS
from caustic_cli.scene import Source

#: Rays whose cost equals that of the Fourier transform at one wavelength of a typical scene.
RAYS_A_WAVE = 600_000


@dataclass(frozen=True)
class Stage:
    """One stage of a design.

    Args:
        control: control points along x and y; the surface of the stage before is represented on them.
        rays: number of rays; sampler: see `caustic_cli.optics.sampling`.
        filter: reconstruction filter of the render inside the loss.
        blur: standard deviation of the Gaussian blur of render and target in the loss, pixels.
        apron: pixels added around the screen, dark in the target, that catch stray light.
        iterations: optimiser iterations; the last stage continues to the total of the design.
        source: the source during this stage, None for that of the scene (6.4: a point first, then the grid).
        tolerance: ends the stage when ten iterations lowered the loss by less than this part; 0 never.
        oversample: see `Objective`.
        waves: nm, wavelengths of the wave image, which is optimised instead of the ray image, unless the scene gives its own; empty
            for the ray image.
        spread: rays are traced from the centre of the source, and their image is convolved with that of the source, where this is
            a good approximation.
        lenslets: each lenslet of an array is compared with its own target, see `lenslets.ArrayObjective`.
    """

    control: tuple[int, int]
    rays: int
    sampler: str = "lines"
    filter: Filter = field(default_factory=lambda: Filter("cosine", (3, 3)))
    blur: float = default("design.stages.blur")
    apron: int = default("design.stages.apron")
    iterations: int = 30
    tolerance: float = 2e-3
    source: Source | None = None
    oversample: int = default("design.stages.oversample")
    waves: tuple[float, ...] = ()
    spread: bool = default("design.stages.spread")
    lenslets: bool = default("design.stages.lenslets")

    def __post_init__(self):
        check_all("design.stages", self, "control", "rays", "blur", "apron", "iterations", "tolerance", "oversample", "waves")
        checks.choice("⟨design.stages.sampler⟩", self.sampler, SAMPLERS)

    @property
    def cost(self) -> float:
        """Estimated cost of all its iterations, in units of one traced ray."""
        each = RAYS_A_WAVE * len(self.waves) if self.waves else self.rays
        return self.iterations * (each + 20.0 * self.control[0] * self.control[1])
