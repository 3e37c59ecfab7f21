"""Validity of geometrical optics: ray image against wave image over lens size, wavelength and source size.

Notation
    size        width of the lens; throw, screen, relief, other elements and the distribution of a varying index scale with it, so
                that all angles are unchanged
    wave        the wave image at one wavelength, `error` the relative RMS between it and the ray image, each over its own mean
    noise       of the ray image, from two halves of its rays; subtracted from the error in quadrature
    blur        predicted, by diffraction, sqrt(lambda L M), and by the source, mm

Pixels scale with the lens, and the Fresnel scale sqrt(lambda L M) only with the square root of its size, so that the agreement
improves with size.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import groupby

import torch
from matplotlib.figure import Figure
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.optics import ranks
from caustic_cli.optics.resolution import GREEN, Resolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.scene import Disc, Light, PlaneWave, Scene
from caustic_cli.scene.aperture import larger
from caustic_cli.studies.measurement import Reference
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.report import COLOURS, MARKERS, Study, plain_ticks
from caustic_cli.studies.retrace import sampler_for

#: Lens widths, mm; wavelengths, nm; full angles of a distant source, degrees.
SIZES = (5.0, 10.0, 20.0, 40.0, 60.0, 100.0)
WAVELENGTHS = (405.0, 550.0, 780.0, 1064.0, 1550.0)
ANGLES = (0.0, 0.02, 0.05, 0.1)
#: Rays per pixel of each ray image by default.
A_PIXEL = 64
#: Largest error at which the ray image counts as sufficient.
ENOUGH = 0.1

#: Series, value, wavelength, nm, full angle of the source, degrees, and scale of the lens.
Case = tuple[str, float, float, float, float]
COLUMNS = {
    "series": "parameter varied",
    "value": "lens size (mm), wavelength (nm) or the source's full angle (degrees)",
    "error": "relative RMS between ray image and wave image, each over its own mean, corrected for the noise of the rays",
    "noise": "relative RMS noise of the ray image",
    "blur": "predicted blur by diffraction and the source, pixels",
    "seconds": "time of the wave image, s",
    "rays_seconds": "time of the ray image, s",
    "samples": "samples of the largest transform along an axis",
}


def scaled(scene: Scene, field: HeightField, heights: Tensor, factor: float) -> tuple[Scene, HeightField, Tensor]:
    """A scene with a plane wave, scaled by a factor at constant angles, index and transmittance, without a second target; field and
    heights (n, m) mm with it."""
    shift, tilt = scene.mounting
    lens = scene.lens.scaled(factor)
    other = replace(
        scene,
        lens=lens,
        screen=scene.screen.scaled(factor),
        second_target=None,
        elements=tuple(element.scaled(factor) for element in scene.elements),
        mounting=(larger(shift, factor), tilt),
    )
    return other, HeightField(field.spaces, lens.half_size), factor * heights


def run_diffraction(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    *,
    rays: int | None = None,
    seed: int = 0,
    dtype: torch.dtype | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Ray image against wave image of a lens in plane light, at several sizes, wavelengths and source sizes.

    Raises:
        NoWaveImage: none of them has one, as where rays cross inside the glass.
    """
    plane = replace(scene, source=PlaneWave(scene.source.power, tilt=scene.source.tilt), light=Light())
    own = plane.lens.size[0]
    cases = _cases(own)
    count = rays or A_PIXEL * math.prod(plane.screen.resolution)
    groups = [list(group) for _, group in groupby(cases, lambda case: case[3:])]
    measured = partial(_measured, plane, field, heights.detach().double(), count, seed, dtype or torch.float32)
    told = (lambda done: None) if progress is None else lambda done: progress(done, len(groups))
    rows = [row for some in ranks.mapped(measured, groups, told) for row in some]
    if not rows:
        raise NoWaveImage("this lens has no wave image at any of the sizes, wavelengths and sources of the study")
    about = {
        "version": __version__,
        "seed": seed,
        "repeats": 1,
        "rays": count,
        "device": str(heights.device),
        "reference_error": max(r["noise"] for r in rows),
        "threads": torch.get_num_threads(),
        "dtype": str(dtype or torch.float32).removeprefix("torch."),
        "lens": own,
    }
    return Study("diffraction", COLUMNS, rows, {}, _advice(rows), about, "value", PLOTS)


def _cases(own: float) -> list[Case]:
    """Series, value, wavelength, nm, full angle of the source, degrees, and scale of a lens of this size, mm."""
    return [
        *(("lens size", size, GREEN, 0.0, size / own) for size in SIZES),
        *(("wavelength", wavelength, wavelength, 0.0, 1.0) for wavelength in WAVELENGTHS),
        *(("source size", angle, GREEN, angle, 1.0) for angle in ANGLES),
    ]


def _measured(
    plane: Scene, field: HeightField, heights: Tensor, rays: int, seed: int, dtype: torch.dtype, cases: list[Case]
) -> list[dict]:
    """Rows of cases that differ in the wavelength alone, and so have the same ray image; without those that have no wave image."""
    *_, angle, factor = cases[0]
    one, net, lifted = scaled(plane, field, heights, factor)
    if angle:
        one = replace(one, source=Disc(power=plane.source.power, angle=angle, tilt=plane.source.tilt))
    rows, (reference, ray_seconds) = [], _rays(one, net, lifted, rays, seed)
    for series, value, wavelength, *_ in cases:
        began = time.perf_counter()
        try:
            light = wave_image(one, net, lifted, wavelengths=(wavelength,), dtype=dtype)
        except NoWaveImage:
            continue
        seconds = time.perf_counter() - began
        seen = Resolution.at(replace(one, light=Light(None, (wavelength,))), net, lifted)
        error, blur = reference.error_of(light.image.cpu()), seen.blur / seen.pixel
        found = (series, value, error, reference.error, blur, seconds, ray_seconds, max(light.samples))
        rows.append(dict(zip(COLUMNS, found, strict=True)))
    return rows


def _rays(scene: Scene, field: HeightField, heights: Tensor, rays: int, seed: int) -> tuple[Reference, float]:
    """The ray image from two halves of the rays, and its time, s."""
    began = time.perf_counter()
    samplers = [sampler_for(scene, rays // 2, seed + k, str(heights.device)) for k in (0, 1)]
    halves = [expose(scene, field, heights, sampler).image.cpu() for sampler in samplers]
    return Reference(sum(halves) / 2.0, rays, relative_rms(*halves) / 2.0), time.perf_counter() - began


def _advice(rows: list[dict]) -> str:
    """From which size on the ray image is sufficient, in one sentence."""
    sizes = [r for r in rows if r["series"] == "lens size"]
    found = []
    if (size := _from(sizes)) is not None:
        found.append(f"for lenses of {size:g} mm and more at these angles")
    if (angle := _from([r for r in rows if r["series"] == "source size"])) is not None:
        found.append(f"for sources of {angle:g} degrees and more" if angle > 0 else "for a point of light already")
    if found:
        return f"rays are within {ENOUGH:.0%} of light {' or '.join(found)}"
    best = min(rows, key=lambda r: r["error"])
    return (
        f"rays are nowhere within {ENOUGH:.0%} of light here; closest, {best['error']:.2g}, at a {best['series']} of"
        f" {best['value']:g}"
    )


def _from(rows: list[dict]) -> float | None:
    """The least value from which on all errors are at most ENOUGH; None if the last is not."""
    found = None
    for row in sorted(rows, key=lambda r: -r["value"]):
        if row["error"] > ENOUGH:
            break
        found = row["value"]
    return found


def draw_diffraction(study: Study, figure: Figure) -> None:
    """Error against each parameter, on a common scale; errors below the noise are omitted."""
    figure.set_size_inches(10.8, 3.8)
    titles = {
        "lens size": "lens size (mm), all angles alike",
        "wavelength": "wavelength (nm)",
        "source size": "the source's full angle (degrees)",
    }
    for axes, (series, label) in zip(figure.subplots(1, 3, sharey=True), titles.items(), strict=True):
        rows = [r for r in study.rows if r["series"] == series]
        x = [r["value"] for r in rows]
        seen = [r["error"] or math.nan for r in rows]
        axes.plot(x, seen, MARKERS[0] + "-", color=COLOURS[0], label="ray image against wave image")
        axes.fill_between(x, [r["noise"] for r in rows], color=COLOURS[7], alpha=0.2, lw=0, label="within the noise of the rays")
        axes.axhline(ENOUGH, color=COLOURS[1], linewidth=0.8, label="rays are enough below")
        axes.set(yscale="log", xlabel=label)
        if series == "lens size":
            axes.set_xscale("log")
            axes.set_xticks(x, [f"{value:g}" for value in x])
            axes.minorticks_off()
        axes.grid(which="major", linewidth=0.4)
    figure.axes[0].set_ylabel("relative RMS")
    plain_ticks(figure.axes[0].yaxis)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="small")


#: Endings of the pictures' names, and what draws them.
PLOTS = {"": draw_diffraction}
