"""Convergence studies: error against computation time of an image, relative to a reference with many more rays.

    rays            samplers x numbers of rays, bincount: the order of convergence of each sampler
    reconstruction  filters x numbers of rays: bias and noise of each filter
    precision       float32 against float64 on the same rays; both in plain torch, since the CPU's kernels support float64
                    only

A bincount image has noise only.  For n independent rays its error is sqrt(N / n) on N evenly lit pixels, order 1/2;
with one ray in each of n cells only the cells on a pixel's border contribute, which gives order 3/4 once there are
several rays a pixel.  Orders are therefore fitted over settings with at least one ray a pixel.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.optics.backends import plain
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SAMPLERS
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene
from caustic_cli.schema import checks
from caustic_cli.studies.fit import Order, knee, order
from caustic_cli.studies.measurement import REFERENCE_SEED, Benchmark, Reference, Setting, busy_warning
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.report import Study

#: Rays of the largest setting: each study then takes 10 to 30 s on two cores at 250 x 250 pixels.
MAX_RAYS = {"rays": 1 << 20, "reconstruction": 1 << 19, "precision": 1 << 19}
#: Reconstruction filters compared; the Gaussian's alpha is 1 per pixel squared.
FILTERS = (Filter(), *(Filter(kind, (v, v), (1.0, 1.0)) for kind in ("gaussian", "cosine") for v in (3, 5, 11)))
#: Single precision is enough where it changes the image by less than this part of the error its rays leave anyway:
#: it then adds half a percent to it in quadrature.
NEGLIGIBLE = 0.1
#: A speedup below this is within the scatter of the times.
FASTER = 1.1
#: An order below this counts as no convergence: halving the error would take a thousand times the rays.
STALLED = 0.1

_COMMON = {
    "series": "name of the curve",
    "sampler": "sampling of the rays",
    "rays": "rays traced",
    "error": "relative RMS against the reference, each image over its own mean, corrected for the reference's own"
    " error in quadrature; root mean square over the repeats",
}
_TIMES = {
    "seconds": "wall time of sampling, tracing and reconstruction, s; median of the repeats",
    "seconds_min": "shortest of them, s",
    "seconds_max": "longest of them, s",
}


def run_study(
    name: str,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    *,
    seed: int = 0,
    dtype: torch.dtype | None = None,
    max_rays: int | None = None,
    repeats: int = 3,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Measure one of STUDIES on a lens.  Its errors repeat from run to run; its times do not.

    Args:
        name: rays, reconstruction or precision.
        heights: (n, m) control heights, mm; the study runs on their device.
        seed: of the rays studied; the reference uses others.
        dtype: precision of the rays studied, None for float64 (`precision` always compares both).
        max_rays: rays of the largest setting, None for MAX_RAYS; the reference uses many times more.
        repeats: rounds, each with fresh rays.
        progress: called with (rays traced, rays in total) after every round.

    Raises:
        InputError: unknown study, or numbers out of range.
        CausticError: no light reaches the screen.
    """
    checks.choice("⟨study⟩", name, tuple(STUDIES))
    max_rays = checks.whole("⟨rays⟩", MAX_RAYS[name] if max_rays is None else max_rays, 256, 1 << 32)
    checks.whole("⟨repeats⟩", repeats, 1, 1000)
    bench = Benchmark(scene, field, heights.detach().double(), seed, repeats, max_rays, progress)
    return STUDIES[name](bench, dtype or torch.float64)


def study_rays(bench: Benchmark, dtype: torch.dtype) -> Study:
    """Error against the number of rays, for every sampler."""
    settings = [Setting(kind, kind, bench.max_rays >> k, Filter(), dtype) for k in range(6, -1, -1) for kind in SAMPLERS]
    bench.plan(settings)
    truth = bench.reference(Filter())
    rows = bench.measure(settings, lambda _, image, __: {"error": truth.error_of(image)})
    orders = _orders(bench, rows)
    best = rows[knee([row["seconds"] for row in rows], [row["error"] for row in rows])]
    least = min(rows, key=lambda row: row["error"])
    advice = f"a relative error of {best['error']:.2g} costs {best['seconds']:.2g} s with {best['rays']} {best['sampler']} rays"
    if least is not best:
        advice += f", the least, {least['error']:.2g}, {least['seconds']:.2g} s with {least['rays']} {least['sampler']}"
    advice += f"; {_halving(orders[best['series']])}{busy_warning(rows)}"
    return Study("rays", _COMMON | _TIMES, rows, orders, advice, _about(bench, dtype, truth))


def study_reconstruction(bench: Benchmark, dtype: torch.dtype) -> Study:
    """Error of filters, split into bias and noise.

    The reference of a filter is the limit of its images for many rays.  The bincount reference smoothed by `Filter.smooth` differs
    from it, because irradiance is not uniform within a pixel and light is blurred in from outside the frame: column `kernel`.
    """
    settings = [
        Setting(f.kind if f.size[0] == 1 else f"{f.kind} {f.size[0]}", "lines", bench.max_rays >> k, f, dtype)
        for k in (4, 2, 0)
        for f in FILTERS
    ]
    bench.plan(settings, filtered=len(FILTERS) - 1)
    truth = bench.reference(Filter())
    own = {f: truth if f == Filter() else bench.reference(f) for f in FILTERS}
    fixed = {
        f: {
            "bias": relative_rms(r.image, truth.image),
            "kernel": relative_rms(f.smooth(truth.image), r.image),
            "reference_error": r.error,
        }
        for f, r in own.items()
    }

    def figures(s: Setting, image: Tensor, _) -> dict:
        return {"error": truth.error_of(image), "noise": own[s.filter].error_of(image), **fixed[s.filter]}

    rows = bench.measure(settings, figures)
    for row, s in zip(rows, settings, strict=True):
        row |= {"filter": s.filter.kind, "size": s.filter.size[0]}
    columns = (
        _COMMON
        | {
            "filter": "reconstruction filter",
            "size": "its size, pixels along either axis",
            "noise": "relative RMS against the filter's own reference, which decreases with the number of rays",
            "bias": "relative RMS between the filter's own reference and the reference, which does not",
            "kernel": "relative RMS between the reference smoothed by Filter.smooth and the filter's own reference",
            "reference_error": "estimated relative RMS of the filter's own reference",
        }
        | _TIMES
    )
    parts = []
    for k in range(0, len(rows), len(FILTERS)):
        plain, best = rows[k], min(rows[k : k + len(FILTERS)], key=lambda row: row["error"])
        than = f" in {best['seconds']:.2g} s"
        if best is not plain:
            than += f" (bincount {plain['error']:.2g} in {plain['seconds']:.2g} s)"
        parts.append(f"with {best['rays']} rays {best['series']} has the least error, {best['error']:.2g}{than}")
    about = _about(bench, dtype, truth) | {"orders_of": "noise"}
    return Study("reconstruction", columns, rows, _orders(bench, rows, "noise"), "; ".join(parts) + busy_warning(rows), about)


def study_precision(bench: Benchmark, _dtype) -> Study:
    """Both precisions on the same rays: the difference of their images, beside the error of each.

    Both use plain torch, so that they differ in nothing else: the CPU's kernels support float64 only.
    """
    settings = [
        Setting(f"{kind} {_name(dtype)}", kind, bench.max_rays >> k, Filter(), dtype)
        for k in (4, 2, 0)
        for kind in SAMPLERS
        for dtype in (torch.float64, torch.float32)
    ]
    bench.plan(settings)
    truth = bench.reference(Filter())

    def figures(s: Setting, image: Tensor, before: Tensor | None) -> dict:
        difference = relative_rms(image, before) if s.dtype == torch.float32 else None
        return {"error": truth.error_of(image), "difference": difference}

    rows = bench.measure(settings, figures, plain)
    for double, single in zip(rows[::2], rows[1::2], strict=True):
        double |= {"dtype": "float64", "speedup": None}
        single |= {"dtype": "float32", "speedup": double["seconds"] / single["seconds"]}
    columns = (
        _COMMON
        | {
            "dtype": "precision of the rays",
            "difference": "relative RMS between the float32 and the float64 image of the same rays",
            "speedup": "time of float64 over time of float32, both in plain torch",
        }
        | _TIMES
    )
    largest = rows[-2 * len(SAMPLERS) :]
    worst = max(largest[1::2], key=lambda row: row["difference"] / max(row["error"], truth.error))
    advice = (
        f"float32 changes the image of {worst['rays']} {worst['sampler']} rays by {worst['difference']:.2g},"
        f" where the rays leave an error of {worst['error']:.2g}, and is {worst['speedup']:.2g} times as fast"
        f" in plain torch: {single_precision(worst)}{busy_warning(rows)}"
    )
    return Study("precision", columns, rows, _orders(bench, rows), advice, _about(bench, None, truth))


def single_precision(row: dict) -> str:
    """Whether float32 is sufficient, from a row with difference, error and speedup."""
    if row["speedup"] < FASTER:
        return "float32 gains nothing here"
    return "float32 is enough" if row["difference"] <= NEGLIGIBLE * row["error"] else "use float64"


def _orders(bench: Benchmark, rows: list[dict], column: str = "error") -> dict[str, Order | None]:
    """Fitted order of every series over its settings with at least one ray a pixel."""
    table: dict[str, list[dict]] = {}
    for row in rows:
        table.setdefault(row["series"], []).append(row)
    pixels = bench.scene.screen.resolution[0] * bench.scene.screen.resolution[1]
    return {name: order([r["rays"] for r in some], [r[column] for r in some], pixels) for name, some in table.items()}


def _halving(found: Order | None) -> str:
    """Cost of halving the error: with error ~ n^-k, 2^(1/k) times the rays and the time."""
    if found is None or found.exponent < STALLED:
        return "more rays hardly lower it"
    return f"halving it costs {2.0 ** (1.0 / found.exponent):.2g} times as much"


def _about(bench: Benchmark, dtype: torch.dtype | None, truth: Reference) -> dict:
    """Metadata of a study, from which all but the times can be reproduced."""
    seeds = [bench.seed + REFERENCE_SEED, bench.seed + REFERENCE_SEED + 1]
    return {
        "version": __version__,
        "seed": bench.seed,
        "repeats": bench.repeats,
        "max_rays": bench.max_rays,
        "dtype": "float32 and float64" if dtype is None else _name(dtype),
        "device": str(bench.heights.device),
        "threads": torch.get_num_threads(),
        "reference_rays": truth.rays,
        "reference_sampler": "stratified",
        "reference_seeds": seeds,
        "reference_dtype": "float64",
        "reference_error": truth.error,
        "orders_of": "error",
    }


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


#: Every study by name, as a function of a benchmark and the dtype of the rays.
STUDIES: dict[str, Callable[[Benchmark, torch.dtype], Study]] = {
    "rays": study_rays,
    "reconstruction": study_reconstruction,
    "precision": study_precision,
}
