"""Default stages of a design, by quality, as tables of [[design.stages]].

The stages form a coarse-to-fine continuation: early ones use a wide blur, a coarse control net and few rays, late ones the full
resolution, and the blur is halved from stage to stage.  After an optimal-transport start, which is accurate at every scale, full
resolution is used from the beginning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from caustic_cli.config.settings import Settings
from caustic_cli.config.table import check, default
from caustic_cli.inverse.initial_surface import COARSE
from caustic_cli.scene import Source

Table = dict[str, Any]
RAYS_PER_PIXEL = 9.0  # 750 x 750 rays on 250 x 250 pixels, tables D.1 and D.2
WAVE_KEYS = ("control", "blur", "apron", "iterations", "tolerance")  # keys of a ray stage that a wave stage has, too
#: Least relative decrease of the loss over ten iterations, in default stages on rays and on the wave image.
TOLERANCE, WAVE_TOLERANCE = 2e-3, 1e-3


def on_rays(
    control: Sequence[int],
    rays: int,
    sampler: str,
    *,
    blur: float = 0.0,
    apron: int = 0,
    iterations: int = 30,
    tolerance: float = TOLERANCE,
    oversample: int = 1,
) -> Table:
    """A stage on the ray image, with a 3 x 3 raised-cosine filter."""
    return {
        "control": list(control),
        "rays": rays,
        "sampler": sampler,
        "reconstruction": "cosine",
        "filter_size": [3, 3],
        "blur": blur,
        "apron": apron,
        "iterations": iterations,
        "tolerance": tolerance,
        "oversample": oversample,
    }


def on_waves(control: Sequence[int], waves: Sequence[float], apron: int, iterations: int) -> Table:
    """A stage on the wave image at wavelengths `waves`, nm."""
    return {
        "control": list(control),
        "waves": list(waves),
        "blur": default("design.stages.blur"),
        "apron": apron,
        "iterations": iterations,
        "tolerance": WAVE_TOLERANCE,
    }


def usual_sampler(source: Source) -> str:
    """The default sampler: tensor-product rays make a plane wave cheap; other rays are intersected individually."""
    return "lines" if source.collimated else "stratified"


def completed_stage(table: Mapping[str, Any], s: Settings, sampler: str) -> Table:
    """A user-defined stage with its missing keys completed."""
    base = stage_base(s, sampler)
    return {**({k: base[k] for k in WAVE_KEYS} if table.get("waves") else base), **table}


def stage_base(s: Settings, sampler: str) -> Table:
    """Defaults of a user-defined stage."""
    nx, ny = s.screen.resolution
    return on_rays(
        s.lens.control,
        int(RAYS_PER_PIXEL * nx * ny),
        sampler,
        iterations=default("design.stages.iterations"),
        tolerance=default("design.stages.tolerance"),
    )


def coarse_to_fine(
    control: tuple[int, int],
    degree: tuple[int, int],
    rays: int,
    resolution: tuple[int, int],
    quality: str = "standard",
    sampler: str = "lines",
) -> list[Table]:
    """The default stages for a picture of `resolution` pixels, ending on `control` points with `rays` rays.

    The blur starts at 1/16 of the screen and is halved down to none.  Control nets have a quarter, half and all of the final
    knot spans, so that knot insertion preserves the surface if these are divisible.
    """
    check("quality", quality)
    early, late = {"draft": (15, 25), "standard": (25, 50), "fine": (40, 120)}[quality]
    pixels = max(resolution)
    blurs = [2.0**k * pixels / 250.0 for k in (4, 3, 2, 1, 0, -1)] + [0.0]
    shrink = [4, 4, 2, 2, 1, 1, 1]
    fewer = [0.16, 0.16, 0.3, 0.3, 0.64, 1.0, 1.0]
    stages = []
    for k, (blur, part, few) in enumerate(zip(blurs, shrink, fewer, strict=True)):
        net = tuple(min(n, max(p + 1, -(-(n - p) // part) + p)) for n, p in zip(control, degree, strict=True))
        apron = math.ceil(pixels * (0.12 if blur > 1 else 0.04))
        stages.append(
            on_rays(
                net,
                max(1, int(rays * few)),
                sampler,
                blur=round(blur, 6),
                apron=apron,
                iterations=late if k == len(blurs) - 1 else early,
            )
        )
    return stages


#: Qualities after a transport start: knot spans per pixel and their largest number; rays per pixel in the last stage and their
#: largest number; largest subdivision of pixels along each axis; and for each stage its fraction of the rays and its iterations.
REFINEMENT = {
    "draft": (1.0, 256, 16, 1_000_000, 2, ((1.0, 14),)),
    "standard": (2.0, 957, 64, 8_000_000, 4, ((0.5, 8), (1.0, 24))),
    "fine": (2.0, 957, 256, 16_000_000, 4, ((0.125, 15), (0.25, 65), (1.0, 25))),
}
#: Gaps of a picture (`io.picture`) from which on creases of the surface dominate its error, and the qualities then: light through a
#: crease falls into dark regions, and a crease is as narrow as the knot spans and the cells of the start.  On such fine nets
#: iterations gain little: with 10 spans per pixel two more iterations improved thin lines from 0.094 to 0.093, 12 spans in the same
#: time to 0.081.
GAPS = 0.5
#: Least knot spans of such a net, from which on the start is evaluated on finer cells than it is solved on.
LEAST_CREASED = 1152
CREASED = {
    "draft": (6.0, 1536, 16, 1_000_000, 2, ((1.0, 2),)),
    "standard": (12.0, 3072, 64, 4_000_000, 4, ((1.0, 2),)),
    "fine": (16.0, 4096, 64, 4_000_000, 4, ((1.0, 2),)),
}
#: Factor of the iterations where the image is blurred by the source.
LONGER = 3
#: Source cells of the transport start along the lens: rays of the last stage per cell, and bounds of the number of cells.
RAYS_PER_CELL, LEAST_CELLS, MOST_CELLS = 4, 256, 1024
#: Largest prime factor of a length with fast transforms.
LARGEST_FACTOR = 50
#: Knot spans of a net from which on its start has one cell per span.
FINE_SPANS = 1024
LEAST_SPANS = 32
#: For pictures with more than LARGE_PIXELS along an axis, or more than the spans of a quality: spans (1280 control points are a
#: fast transform length); rays per pixel and their largest number; and iterations, all with these rays, since with fewer the lens
#: overfits the sampling noise.
LARGE_PIXELS, LARGE_SPANS, LARGE_RAYS, MOST_RAYS, LARGE_PLAN = 700, 1277, 8, 16_000_000, ((1.0, 24),)
LEAST_RAYS = 40_000


def refinement_spans(pixels: int, quality: str) -> int:
    """Knot spans along each axis of the lens for a screen of `pixels` pixels: finer than the picture."""
    return _spans(REFINEMENT, pixels, quality)


def creased_control(pixels: int, degree: int, quality: str) -> int:
    """Control points along an axis for a picture with gaps.

    The number of knot spans is a multiple of the cells of the coarse transport solution, increased where it or the number of
    control points has a large prime factor: the cosine transforms of the initial surface and of the preconditioner are three times
    as slow for such lengths.
    """
    spans = max(LEAST_CREASED, _spans(CREASED, pixels, quality))
    step = -(-spans // COARSE)
    spans = -(-spans // step) * step
    while max(map(_largest_factor, (spans, spans + degree))) > LARGEST_FACTOR:
        spans += step
    return spans + degree


def _largest_factor(n: int) -> int:
    """The largest prime factor of n >= 2."""
    factor = 2
    while factor * factor <= n:
        if n % factor:
            factor += 1
        else:
            n //= factor
    return n


def _spans(plan: dict[str, tuple], pixels: int, quality: str) -> int:
    check("quality", quality)
    density, most, *_ = plan[quality]
    large = most < LARGE_SPANS and pixels > min(most, LARGE_PIXELS)
    return LARGE_SPANS if large else min(most, max(LEAST_SPANS, round(density * pixels)))


def transport_cells(rays: int, scattered: bool, spans: int = 0) -> int:
    """Source cells of a transport start along the lens, for a refinement with `rays` rays on a net of `spans` knot spans.

    Discretisation errors of the cells appear as stripes in dark regions, and take many iterations to smooth.
    """
    if spans >= FINE_SPANS and not scattered:
        return spans
    return min(MOST_CELLS, max(LEAST_CELLS, round(math.sqrt(rays * (4 if scattered else 1)) / RAYS_PER_CELL)))


def refinement(
    control: tuple[int, int],
    rays: int | None,
    resolution: tuple[int, int],
    quality: str = "standard",
    scattered: bool = False,
    spread: bool = False,
    creased: bool = False,
) -> list[Table]:
    """The default stages after a transport start, which is accurate at every scale: full resolution from the beginning.

    Rays form a regular grid: under a smooth filter, narrow thanks to the subdivided pixels, such a quadrature is far more accurate
    than random rays, whose noise a lens would overfit.

    Args:
        rays: of the last stage, None for the default of the quality.
        scattered: the source's rays are intersected individually, so a quarter of them is used.
        spread: as for a stage; light that the source spreads beyond the screen is not an error.
        creased: the picture has gaps, and the net is that of `creased_control`.
    """
    check("quality", quality)
    _, spans, each, most, finer, plan = (CREASED if creased else REFINEMENT)[quality]
    pixels = resolution[0] * resolution[1]
    if spans < LARGE_SPANS and max(resolution) > LARGE_PIXELS and quality == "standard":
        most, plan = max(most, min(LARGE_RAYS * pixels, MOST_RAYS)), LARGE_PLAN
    rays = rays or max(LEAST_RAYS, min(most, each * pixels) // (4 if scattered else 1))
    finer = max(1, min(finer, math.isqrt(rays // pixels)))
    apron = 0 if spread else math.ceil(0.04 * max(resolution))
    stages = []
    for part, iterations in plan:
        stages.append(
            on_rays(
                control,
                max(1, round(part * rays)),
                "grid",
                apron=apron,
                iterations=LONGER * iterations if spread else iterations,
                oversample=finer,
            )
            | ({"spread": True} if spread else {})
        )
    return stages


#: Qualities of systems without a fused kernel, two free-form sides or a lens among other elements: rays per pixel, largest number
#: of rays, subdivision of pixels, iterations; and largest number of knot spans of two sides.
TWO_SIDED = {
    "draft": (8, 500_000, 2, 30),
    "standard": (48, 3_000_000, 4, 50),
    "fine": (64, 4_000_000, 4, 200),
}
TWO_SIDED_SPANS = 384


def two_sided(control: tuple[int, int], rays: int | None, resolution: tuple[int, int], quality: str = "standard") -> list[Table]:
    """The stage of two free-form sides, or of a lens among other elements, after their start; arguments as for `refinement`."""
    check("quality", quality)
    each, most, finer, iterations = TWO_SIDED[quality]
    pixels = resolution[0] * resolution[1]
    rays = rays or max(LEAST_RAYS, min(most, each * pixels))
    finer = max(1, min(finer, math.isqrt(rays // pixels)))
    apron = math.ceil(0.04 * max(resolution))
    return [on_rays(control, rays, "grid", apron=apron, iterations=iterations, oversample=finer)]


#: Largest factor of the rays where every lenslet is compared with its own picture.
MORE_LENSLETS = 4


def each_lenslet(stages: list[Table], lenslets: int, resolution: tuple[int, int]) -> list[Table]:
    """Stages after a transport start in which every lenslet of an array is compared with its own picture."""
    found = []
    for stage in stages:
        rays = stage["rays"] * min(MORE_LENSLETS, lenslets)
        finer = max(1, min(stage["oversample"], math.isqrt(rays // lenslets // (resolution[0] * resolution[1]))))
        found.append(stage | {"rays": rays, "oversample": finer, "lenslets": True})
    return found


#: Qualities of the refinement on the wave image: wavelengths of white light, iterations of each stage, and the time budget of
#: `waves = "auto"`, seconds on two cores.
WAVES = {
    "draft": (3, (10,), 8.0),
    "standard": (5, (12, 20), 25.0),
    "fine": (8, (30, 30), 90.0),
}
#: Time on two cores per sample of the field and iteration, s: at each wavelength, and for the spline.
SECONDS_A_SAMPLE, SECONDS_A_POINT = 2.2e-8, 6e-8
#: Least number of iterations that is worth an exact trace.
LEAST_WAVES = 5


def wave_refinement(samples: float, wavelengths: int, quality: str = "standard", timed: bool = True) -> list[tuple[int, int]]:
    """Stages on the wave image after those on rays: (number of wavelengths of white light, iterations) each.

    Args:
        samples: of the field at one wavelength.
        wavelengths: number of the source's wavelengths; 0 for white light.
        timed: keep the time budget of the quality, with fewer iterations or none at all.
    """
    check("quality", quality)
    count, plan, seconds = WAVES[quality]
    each = samples * (SECONDS_A_SAMPLE * (wavelengths or count) + SECONDS_A_POINT)
    part = min(1.0, seconds / (each * sum(plan))) if timed else 1.0
    stages = [(count, int(part * n)) for n in plan]
    return [s for s in stages if s[1] >= LEAST_WAVES]
