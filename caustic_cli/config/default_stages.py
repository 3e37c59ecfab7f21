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
from caustic_cli.effort import STANDARD, Effort, Refinement
from caustic_cli.inverse.initial_surface import FEWEST
from caustic_cli.scene import Source
from caustic_cli.schema.table import TABLE, default

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
    """The default sampler: tensor-product rays make parallel light cheap; other rays are intersected individually."""
    return "lines" if source.parallel else "stratified"


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
    effort: Effort = STANDARD,
    sampler: str = "lines",
) -> list[Table]:
    """The default stages for a picture of `resolution` pixels, ending on `control` points with `rays` rays.

    The blur starts at 1/16 of the screen and is halved down to none.  Control nets have a quarter, half and all of the final
    knot spans, so that knot insertion preserves the surface if these are divisible.
    """
    early, late = effort.coarse_to_fine
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


#: Gaps of a picture (`io.picture`) from which on creases of the surface dominate its error.
GAPS = 0.5
#: Factor of the iterations where the image is blurred by the source, and on the wave image where the loss is that of a laser beam:
#: an iteration takes 0.05 s there, and lowers the error by a percent up to some hundreds of them.
LONGER, LONGER_BEAMS = 4, 10
#: Source cells of the transport start along the lens: rays of the last stage per cell, and most cells.
RAYS_PER_CELL, MOST_CELLS = 4, 1024
#: Largest prime factor of a length with fast transforms.
LARGEST_FACTOR = 50
#: Knot spans of a net from which on its start has one cell per span.
FINE_SPANS = 1024
LEAST_RAYS = 40_000


def creased_control(pixels: int, degree: int, plan: Refinement, pieces: int = 1) -> int:
    """Control points along an axis for a picture with gaps, or pictures of `pieces` lenslets with so many pixels in all.

    The number of knot spans of a piece is a multiple of the cells of the coarse transport solution, increased where it or the
    number of control points has a large prime factor, or else decreased: the cosine transforms of the initial surface and of the
    preconditioner are three times as slow for such lengths.
    """
    spans = -(-plan.spans(pixels) // pieces)
    step = -(-spans // FEWEST)
    spans = -(-spans // step) * step

    def points(spans: int) -> int:
        return pieces * (spans + degree - 1) + 1

    def slow(spans: int) -> bool:
        return max(map(_largest_factor, (spans, points(spans)))) > LARGEST_FACTOR

    while slow(spans):
        spans += step
    while points(spans) > TABLE["lens.control"].high or slow(spans):
        spans -= step
    return points(spans)


def _largest_factor(n: int) -> int:
    """The largest prime factor of n >= 2."""
    factor = 2
    while factor * factor <= n:
        if n % factor:
            factor += 1
        else:
            n //= factor
    return n


def transport_cells(rays: int, scattered: bool, spans: int = 0, least: int = STANDARD.source_cells) -> int:
    """Source cells of a transport start along the lens, for a refinement with `rays` rays on a net of `spans` knot spans; `least`
    cells, for few rays.

    Discretisation errors of the cells appear as stripes in dark regions, and take many iterations to smooth.
    """
    if spans >= FINE_SPANS:
        return spans
    return min(MOST_CELLS, max(least, round(math.sqrt(rays * (4 if scattered else 1)) / RAYS_PER_CELL)))


def refinement(
    control: tuple[int, int],
    rays: int | None,
    resolution: tuple[int, int],
    how: Refinement,
    fewer: int = 1,
    least: int = 0,
) -> list[Table]:
    """The default stages after a transport start, which is accurate at every scale: full resolution from the beginning.

    Rays form a regular grid: under a smooth filter, narrow thanks to the subdivided pixels, such a quadrature is far more accurate
    than random rays, whose noise a lens would overfit.

    Args:
        rays: of the last stage, None for the default of the quality.
        fewer: divisor of the default number of rays.
        least: of the rays, where `rays` does not say.
    """
    pixels, most, plan = math.prod(resolution), how.most_rays, how.plan
    if large := how.large_at(max(resolution)):
        most, plan = max(most, min(large.rays_per_pixel * pixels, large.most_rays)), large.plan or plan
    rays = rays or max(LEAST_RAYS, least, min(most, how.rays_per_pixel * pixels) // fewer)
    finer = max(1, min(how.subdivision, round(math.sqrt(rays / pixels))))
    apron = math.ceil(0.04 * max(resolution))
    return [
        on_rays(control, max(1, round(part * rays)), "grid", apron=apron, iterations=iterations, oversample=finer)
        for part, iterations in plan
    ]


def on_spread(stages: list[Table]) -> list[Table]:
    """Stages after a transport start on the image of the source's centre, convolved with that of the source; light that this
    spreads beyond the screen is not an error."""
    return [stage | {"apron": 0, "iterations": LONGER * stage["iterations"], "spread": True} for stage in stages]


#: Largest factor of the rays where every lenslet is compared with its own picture.
MORE_LENSLETS = 4


def more_by_lenslets(array: Sequence[int]) -> int:
    """Factor of the rays where every lenslet of an array is compared with its own picture."""
    return min(MORE_LENSLETS, math.prod(array))


def each_lenslet(stages: list[Table], array: Sequence[int], resolution: tuple[int, int]) -> list[Table]:
    """Stages after a transport start in which every lenslet of an array is compared with its own picture."""
    found = []
    for stage in stages:
        rays = stage["rays"] * more_by_lenslets(array)
        finer = max(1, min(stage["oversample"], math.isqrt(rays // (math.prod(array) * math.prod(resolution)))))
        found.append(stage | {"rays": rays, "oversample": finer, "lenslets": True})
    return found


#: Time on two cores per sample of the field and iteration, s: at each wavelength, and for the spline.
SECONDS_A_SAMPLE, SECONDS_A_POINT = 1.2e-8, 3e-8
#: Least number of iterations that is worth an exact trace.
LEAST_WAVES = 5


def wave_refinement(samples: float, wavelengths: int, effort: Effort = STANDARD, timed: bool = True) -> list[tuple[int, int]]:
    """Stages on the wave image after those on rays: (number of wavelengths of white light, iterations) each.

    Args:
        samples: of the field at one wavelength.
        wavelengths: number of the source's wavelengths; 0 for white light.
        timed: keep the time budget of the quality, with fewer iterations or none at all.
    """
    seconds = sum(n * samples * (SECONDS_A_SAMPLE * (wavelengths or count) + SECONDS_A_POINT) for count, n in effort.waves)
    part = min(1.0, effort.wave_seconds / seconds) if timed else 1.0
    stages, left = [], 0  # over from stages that are too short
    for count, n in effort.waves:
        left += int(part * n)
        if left >= LEAST_WAVES:
            stages.append((count, left))
            left = 0
    return stages
