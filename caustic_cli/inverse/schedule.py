"""How a design proceeds: a list of stages, coarse to fine.

Early stages see the picture through a wide blur on a small control net with few rays, late ones at full detail.  The
blur halves from stage to stage, so that light always knows which way to go.  Each stage traces rays of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from caustic_cli.config import checks
from caustic_cli.config.table import check_all, default
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SAMPLERS
from caustic_cli.scene import Source

#: Rays that take as long as the transform at one wavelength of a scene of usual size.
RAYS_A_WAVE = 600_000


@dataclass(frozen=True)
class Stage:
    """One stretch of a design.

    Args:
        control: control points along x and y; a finer net than the stage before takes over its surface.
        rays: number of rays; sampler: see `caustic_cli.optics.sampling`.
        filter: reconstruction filter of the render inside the loss.
        blur: Gaussian seen by the loss on both render and target, pixels.
        apron: pixels added around the screen, dark in the target, that catch stray light.
        iterations: optimiser iterations; the last stage goes on to the design's total.
        source: what shines during this stage, None for the scene's own (6.4: a point first, then the grid).
        tolerance: ends the stage when ten iterations lowered the loss by less than this part; 0 never.
        oversample: see `Objective`.
        waves: nm, the wavelengths at which the wave image is refined instead of the ray image, of light that says none; empty for
            rays.
        spread: the rays are those of the source's middle, and their image is spread by the source's, where that is what the source
            does.
        lenslets: every lenslet of an array is judged by its own picture, with its part of the rays, see `lenslets.ArrayObjective`.
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
        """Of all its iterations, in rays."""
        each = RAYS_A_WAVE * len(self.waves) if self.waves else self.rays
        return self.iterations * (each + 20.0 * self.control[0] * self.control[1])
