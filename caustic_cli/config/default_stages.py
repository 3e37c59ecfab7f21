"""What a quality means: the default stages of a design, as tables of [[design.stages]].

Early stages see the picture through a wide blur on a small control net with few rays, late ones at full detail.  The blur halves
from stage to stage.  After a transport start, whose surface has every scale right, there is full detail at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from caustic_cli.config.settings import Settings
from caustic_cli.config.table import check, default
from caustic_cli.inverse.initial_surface import COARSE
from caustic_cli.scene import Source

Table = dict[str, Any]
RAYS_PER_PIXEL = 9.0  # 750 x 750 rays on 250 x 250 pixels, tables D.1 and D.2
WAVE_KEYS = ("control", "blur", "apron", "iterations", "tolerance")  # of a stage on rays that one on the wave image has too
#: Of a default stage on rays or on the wave image: the part by which ten iterations have to lower the loss.
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
    """A stage on the ray image, reconstructed with a 3 x 3 cosine."""
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
    """A stage on the wave image at so many nanometres."""
    return {
        "control": list(control),
        "waves": list(waves),
        "blur": default("design.stages.blur"),
        "apron": apron,
        "iterations": iterations,
        "tolerance": WAVE_TOLERANCE,
    }


def usual_sampler(source: Source) -> str:
    """A tensor product of rays makes a plane wave cheap; others are intersected one by one."""
    return "lines" if source.collimated else "stratified"


def completed_stage(table: Table, s: Settings, sampler: str) -> Table:
    """A stage of the user's own with all that it does not say."""
    base = stage_base(s, sampler)
    return {**({k: base[k] for k in WAVE_KEYS} if table.get("waves") else base), **table}


def stage_base(s: Settings, sampler: str) -> Table:
    """What a stage of the user's own says where it says nothing."""
    nx, ny = s["screen"]["resolution"]
    return on_rays(
        s["lens"]["control"],
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

    Blurs are 1/16 of the screen at first and halve down to none.  Control nets have a quarter, half and all of the
    final knot spans, so knot insertion carries the surface on unchanged when those divide.
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


#: What a quality means after a transport start: knot spans per pixel and their most; rays a pixel in the last stage and their most;
#: pixels of the render to one of the screen, along each axis, where so many rays fall there; and of each stage its part of the rays
#: and its iterations.
REFINEMENT = {
    "draft": (1.0, 256, 16, 1_000_000, 2, ((1.0, 14),)),
    "standard": (2.0, 957, 64, 8_000_000, 4, ((0.5, 8), (1.0, 24))),
    "fine": (2.0, 957, 256, 16_000_000, 4, ((0.125, 15), (0.25, 65), (1.0, 25))),
}
#: Gaps of a picture (`io.picture`) from which on creases decide its error, and what a quality means then: light that crosses a
#: crease falls into the black, and a crease is as narrow as knot spans and the start's cells are.  On so fine a net iterations gain
#: little: on 10 spans a pixel two more took thin lines from 0.094 to 0.093, and 12 spans in the same time to 0.081.
GAPS = 0.5
#: Knot spans of such a net at least: from there on the start is evaluated on finer cells than it is solved on.
LEAST_CREASED = 1152
CREASED = {
    "draft": (6.0, 1536, 16, 1_000_000, 2, ((1.0, 2),)),
    "standard": (12.0, 3072, 64, 4_000_000, 4, ((1.0, 2),)),
    "fine": (16.0, 4096, 64, 4_000_000, 4, ((1.0, 2),)),
}
#: So many times the iterations where what is refined is seen through a source's blur only.
LONGER = 3
#: Source cells of the transport start along the lens: one to so many rays of the last stage, within bounds.
RAYS_PER_CELL, LEAST_CELLS, MOST_CELLS = 4, 256, 1024
#: Largest prime factor of a length whose transforms are quick.
LARGEST_FACTOR = 50
#: Knot spans of a net from which on its start has a cell to each of them.
FINE_SPANS = 1024
LEAST_SPANS = 32
#: Of pictures with more than LARGE_PIXELS along an axis, or more than a quality has spans: spans, whose 1280 control points are a
#: quick length; rays a pixel, and their most; and iterations, all with these: fewer rays a pixel teach the lens their noise.
LARGE_PIXELS, LARGE_SPANS, LARGE_RAYS, MOST_RAYS, LARGE_PLAN = 700, 1277, 8, 16_000_000, ((1.0, 24),)
LEAST_RAYS = 40_000


def refinement_spans(pixels: int, quality: str) -> int:
    """Knot spans along each axis of the lens for a screen of so many pixels: finer than the picture."""
    return _spans(REFINEMENT, pixels, quality)


def creased_control(pixels: int, degree: int, quality: str) -> int:
    """Control points along an axis for a picture with gaps.

    Knot spans are whole cells of the transport's coarse solution, and a few more of these where their number or that of control
    points would have a large prime factor: cosine transforms of such lengths, which the first surface and the preconditioner take,
    are three times as slow.
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
    """Source cells along the lens of a transport start that so many rays refine on a net of so many knot spans.

    What a cell leaves bright or dark shows as stripes where the picture is dark, and takes many iterations to smooth.
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
    """The default stages after a transport start, whose surface has every scale right already: full detail at once.

    Rays stand in a regular grid: under a smooth filter, which the render's finer pixels leave narrow, such sums are far more exact
    than those over random rays, whose noise a lens learns.

    Args:
        rays: of the last stage, None for what the quality says.
        scattered: the source's rays have to be intersected one by one: take a quarter of them.
        spread: as of a stage; the light that the source spreads beside the screen is no error there.
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


#: The same of what is traced surface by surface, two free-form sides or a lens among other elements: rays for each pixel, most,
#: finer, iterations; and the most knot spans of two sides.
TWO_SIDED = {
    "draft": (8, 500_000, 2, 30),
    "standard": (48, 3_000_000, 4, 50),
    "fine": (64, 4_000_000, 4, 200),
}
TWO_SIDED_SPANS = 384


def two_sided(control: tuple[int, int], rays: int | None, resolution: tuple[int, int], quality: str = "standard") -> list[Table]:
    """The stage of two free-form sides, or of a lens among other elements, after their start; arguments as of `refinement`."""
    check("quality", quality)
    each, most, finer, iterations = TWO_SIDED[quality]
    pixels = resolution[0] * resolution[1]
    rays = rays or max(LEAST_RAYS, min(most, each * pixels))
    finer = max(1, min(finer, math.isqrt(rays // pixels)))
    apron = math.ceil(0.04 * max(resolution))
    return [on_rays(control, rays, "grid", apron=apron, iterations=iterations, oversample=finer)]


#: So many times the rays at most where every lenslet is judged by itself.
MORE_LENSLETS = 4


def each_lenslet(stages: list[Table], lenslets: int, resolution: tuple[int, int]) -> list[Table]:
    """Stages after a transport start in which every lenslet of an array is judged by its own picture."""
    found = []
    for stage in stages:
        rays = stage["rays"] * min(MORE_LENSLETS, lenslets)
        finer = max(1, min(stage["oversample"], math.isqrt(rays // lenslets // (resolution[0] * resolution[1]))))
        found.append(stage | {"rays": rays, "oversample": finer, "lenslets": True})
    return found


#: What a quality means for the refinement on the wave image: wavelengths of white light, iterations of each stage, and how many
#: seconds `waves = "auto"` may take for it on two cores.
WAVES = {
    "draft": (3, (10,), 8.0),
    "standard": (5, (12, 20), 25.0),
    "fine": (8, (30, 30), 90.0),
}
#: Seconds on two cores for one sample of the field in one iteration: at each wavelength, and for the spline there.
SECONDS_A_SAMPLE, SECONDS_A_POINT = 2.2e-8, 6e-8
#: Fewer iterations than these are not worth an exact trace.
LEAST_WAVES = 5


def wave_refinement(samples: float, wavelengths: int, quality: str = "standard", timed: bool = True) -> list[tuple[int, int]]:
    """Stages on the wave image after those on rays: (wavelengths of white light, iterations) each.

    Args:
        samples: of the field at one wavelength.
        wavelengths: of the source; 0 for white light.
        timed: keep within the quality's time, with fewer iterations or none at all.
    """
    check("quality", quality)
    count, plan, seconds = WAVES[quality]
    each = samples * (SECONDS_A_SAMPLE * (wavelengths or count) + SECONDS_A_POINT)
    part = min(1.0, seconds / (each * sum(plan))) if timed else 1.0
    stages = [(count, int(part * n)) for n in plan]
    return [s for s in stages if s[1] >= LEAST_WAVES]
