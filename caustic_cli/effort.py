"""What a quality means: how finely a design is computed and how thoroughly it is judged, on one page.

The three qualities that a user can ask for, draft, standard and fine, differ in the default stages alone, which the project then
contains; what follows from neither is the same for all.  TEST is standard in small, for tests of what is done with a design.  The
environment's CAUSTIC_EFFORT names the effort of designs that ask for no quality, and of what no quality sets, with changes, such as
"test report=True final_rays=200000".
"""

from __future__ import annotations

import ast
import os
from dataclasses import dataclass, replace

from caustic_cli.errors import InputError

#: Most knot spans of a surface with which rays are intersected one by one.
SINGLE_SPANS = 1536
#: (part of the rays of the last stage, iterations) of each stage.
Plan = tuple[tuple[float, int], ...]


@dataclass(frozen=True)
class LargePictures:
    """What is different for pictures with many pixels along an axis."""

    #: Pixels beyond which pictures are large.
    pixels: int
    #: Knot spans along each axis; 1280 control points of degree 3 are a fast transform length.
    spans: int = 1277
    #: Rays per pixel and their largest number where these are more than those of other pictures.
    rays_per_pixel: int = 0
    most_rays: int = 0
    #: All iterations with these rays, since with fewer the lens overfits the sampling noise; None for the plan of other pictures.
    plan: Plan | None = None


@dataclass(frozen=True)
class Refinement:
    """Default stages after an accurate initial surface."""

    #: Knot spans along each axis per pixel of the picture: finer than it.
    spans_per_pixel: float
    #: Their largest number.
    most_spans: int
    #: Rays per pixel in the last stage: of a quadrature, whose noise a lens overfits with fewer.
    rays_per_pixel: int
    #: Their largest number, by the time of an iteration.
    most_rays: int
    #: Largest subdivision of pixels along each axis, by which the reconstruction filter is narrow.
    subdivision: int
    #: The stages.
    plan: Plan
    #: Least number of knot spans.
    least_spans: int = 32
    large: LargePictures | None = None

    def large_at(self, pixels: int) -> LargePictures | None:
        """What is different for `pixels` along the longer axis of the picture, if they are many."""
        return self.large if self.large is not None and pixels > self.large.pixels else None

    @property
    def coarser(self) -> Refinement:
        """The same where rays are intersected with the surface one by one, which takes the memory of 16 numbers per knot span: a
        flame behind a lens had an error of 0.047 on 1536 spans, and 0.051 in twice the time and memory on 3000."""
        return replace(self, most_spans=min(self.most_spans, SINGLE_SPANS))

    def spans(self, pixels: int) -> int:
        """Knot spans along each axis of the lens for a screen of `pixels` pixels along its longer axis."""
        if large := self.large_at(pixels):
            return large.spans
        return min(self.most_spans, max(self.least_spans, round(self.spans_per_pixel * pixels)))


@dataclass(frozen=True)
class Effort:
    """The numbers that trade time for accuracy; limits and tolerances of algorithms stand in their own modules."""

    # By quality: time limit and default stages

    #: Time limit, s, from which this quality uses the time better than one before.
    seconds: float
    #: Iterations of each stage, and of the last, of a design from coarse to fine without an accurate initial surface.
    coarse_to_fine: tuple[int, int]
    #: After optimal transport.
    refinement: Refinement
    #: The same for pictures with gaps, where light through a crease falls into dark regions, and a crease is as narrow as the knot
    #: spans and the cells of the start.  From 1152 spans on the start is evaluated on finer cells than it is solved on and makes up
    #: for what creases take (`inverse.creases`).  Iterations then gain nothing: on 2580 spans two left the flame at 0.0131 and text
    #: at 0.0388; with 4096 spans text has 0.025.
    creased: Refinement
    #: As `creased` for two free-form sides, on nets that have no ripples as wide as pixels, and with subpixels that show them.
    sides: Refinement
    #: The same for two pictures, which the initial surfaces pair to first order in the angles only: many iterations on a net and
    #: with rays for which they are cheap.
    pairs: Refinement
    #: (wavelengths of white light, iterations) of each stage on the wave image: the first lenses are blurred, and so alike at all
    #: wavelengths.  At least 2 nm from those of the verdict.
    waves: tuple[tuple[int, int], ...]
    #: Time for them with `waves = "auto"`, s on two cores.
    wave_seconds: float

    #: Stages instead of those of `creased` where more is asked for than the picture, of the surface that the transport finds.
    joint: Plan = ((1.0, 2),)

    # Of the initial surface

    #: Least number of source cells of the transport along the lens: 250 x 250 pixels are resolved, and these cells are cheap.
    source_cells: int = 256
    #: The same along a lenslet, of which there are many.
    lenslet_cells: int = 128
    #: Cells along the lens on which the height of its vertex is chosen for a near source, of several that are tried.
    vertex_cells: int = 64

    # Of a lamp

    #: (pixels of the target, rays, iterations, weight of the light that is lost) of each stage.
    lamp_stages: tuple[tuple[int, int, int, float], ...] = (
        (800, 20_000, 100, 0.1),
        (5_600, 60_000, 150, 0.03),
        (24_000, 600_000, 100, 0.006),
        (96_000, 3_000_000, 60, 0.006),
    )
    #: The same for two free-form surfaces, after the first of the stages above with one.
    two_stages: tuple[tuple[int, int, int, float], ...] = (
        (800, 20_000, 150, 0.2),
        (5_600, 60_000, 80, 0.03),
        (24_000, 600_000, 120, 0.012),
    )
    #: The same for a chip with an extent, whose rays cost more and whose blur hides what is smaller: instead of the last of either.
    chip_stages: tuple[tuple[int, int, int, float], ...] = ((3_100, 300_000, 90, 0.045),)
    #: Spans of the spline along both axes in a stage with enough pixels; cells of the light along both axes for the transport;
    #: pixels by which the uniformity of the light is judged.
    lamp_spans: int = 256
    lamp_cells: int = 44
    lamp_coarse: int = 2_700

    # Of the evaluation of a design, and of a render without a number of rays

    #: Rays for 250 x 250 pixels: a noise of about a thousandth.
    final_rays: int = 4_000_000
    #: Largest noise of the error, as a fraction of it, for which rays are added.
    noise: float = 0.1
    #: Most iterations for the lower bound of the error under an extended source, which then is within some per cent.
    bound_steps: int = 1000
    #: Points at which the error is measured while a design runs, the initial and the final lens among them.
    cost_points: int = 8
    #: Whether report.png is drawn, which takes 2.5 s.
    report: bool = True

    # Of studies

    #: Rays and rounds for the cost and error of each effect, a few seconds on two cores; a wave image alone takes seconds.
    effect_rays: int = 1 << 16
    effect_rounds: int = 5
    wave_rounds: int = 2
    #: Rays of the sensitivities to manufacture, and of the angles inside the lens.
    sensitivity_rays: int = 100_000
    #: Numbers of iterations after which architectures of networks are compared.
    training_rounds: tuple[int, ...] = (25, 50, 100, 200)


DRAFT = Effort(
    seconds=0.0,
    coarse_to_fine=(15, 25),
    refinement=Refinement(1.0, 256, 16, 1_000_000, 3, ((1.0, 8),), large=LargePictures(256)),
    creased=Refinement(6.0, 1536, 16, 1_000_000, 2, ((1.0, 0),), 1152),
    sides=Refinement(3.0, 512, 64, 1_000_000, 8, ((1.0, 20),)),
    pairs=Refinement(1.0, 256, 8, 500_000, 2, ((1.0, 75),), large=LargePictures(256, 384)),
    waves=((2, 12),),
    wave_seconds=8.0,
    cost_points=5,
)
STANDARD = Effort(
    seconds=8.0,
    coarse_to_fine=(25, 50),
    refinement=Refinement(
        *(2.0, 957, 64, 8_000_000, 6, ((0.5, 4), (1.0, 7))),
        large=LargePictures(700, rays_per_pixel=8, most_rays=16_000_000, plan=((1.0, 8),)),
    ),
    creased=Refinement(10.0, 2560, 64, 4_000_000, 4, ((1.0, 0),), 1152),
    sides=Refinement(3.0, 765, 64, 4_000_000, 8, ((1.0, 20),)),
    pairs=Refinement(1.5, 765, 32, 4_000_000, 4, ((0.5, 60), (1.0, 90))),
    waves=((2, 24), (6, 20)),
    wave_seconds=25.0,
)
FINE = Effort(
    seconds=60.0,
    coarse_to_fine=(40, 120),
    refinement=Refinement(2.0, 957, 256, 16_000_000, 8, ((0.25, 16), (1.0, 16)), large=LargePictures(700)),
    creased=Refinement(16.0, 4096, 64, 4_000_000, 4, ((1.0, 0),), 1152),
    sides=Refinement(4.0, 1021, 64, 4_000_000, 8, ((1.0, 60),)),
    pairs=Refinement(2.0, 1021, 64, 4_000_000, 6, ((0.25, 100), (1.0, 60))),
    waves=((2, 12), (6, 12), (8, 40)),
    wave_seconds=90.0,
)
TEST = replace(
    STANDARD,
    creased=replace(STANDARD.creased, least_spans=64, plan=((1.0, 2),)),
    source_cells=64,
    lenslet_cells=32,
    vertex_cells=32,
    lamp_stages=((300, 5_000, 15, 0.1), (800, 10_000, 15, 0.02)),
    chip_stages=((300, 10_000, 5, 0.02),),
    two_stages=((300, 5_000, 20, 0.1), (800, 10_000, 15, 0.02)),
    lamp_spans=16,
    lamp_cells=16,
    lamp_coarse=150,
    final_rays=40_000,
    bound_steps=400,
    cost_points=3,
    report=False,
    effect_rays=1000,
    effect_rounds=1,
    sensitivity_rays=10_000,
    training_rounds=(3, 6),
)
EFFORTS = {"draft": DRAFT, "standard": STANDARD, "fine": FINE, "test": TEST}


def current_effort() -> Effort:
    """The effort that the environment asks for by CAUSTIC_EFFORT, "NAME [FIELD=VALUE ...]"; STANDARD unless set.

    Raises:
        InputError: there is no such effort, or a field does not exist.
    """
    text = os.environ.get("CAUSTIC_EFFORT", "") or "standard"
    name, *changes = text.split()
    try:
        return replace(EFFORTS[name], **{field: ast.literal_eval(value) for field, value in (c.split("=") for c in changes)})
    except (KeyError, TypeError, ValueError, SyntaxError) as error:
        raise InputError(f"the environment's CAUSTIC_EFFORT must be one of {', '.join(EFFORTS)}, got {text!r}") from error
