"""Optical effect of the scallops left by a ball-nose tool: blur of rays, and scattering by diffraction.

Notation
    R, s        radius of the tool and distance of its passes, mm
    h           s^2 / (8 R), height of a scallop on a flat surface
    g           s / (2 R) = sqrt(2 h / R), slope at the cusps; slopes are uniformly distributed from -g to g
    n, T        refractive index (-1 for a mirror) and throw, mm
    lambda      wavelength, mm

In geometrical optics each scallop is a small cylindrical lens: rays spread over a width b = 2 |n - 1| g T = |n - 1| T s / R across
the passes.  In wave optics the scallops are a phase grating of period s and depth h: orders lambda T / s apart on the screen,
within the same b, and the fraction of the light scattered out of the zeroth order is 1 - exp(-phi^2) for Gaussian or small phases,
with the standard deviation phi = 2 pi |n - 1| sigma / lambda and sigma = h / sqrt(11.25) of a parabola.  So rays require slopes
that displace light by less than a pixel, and waves, where the orders are resolved, a depth far below a wavelength; with decreasing
step-over the latter is reached first.
"""

from __future__ import annotations

import math

from caustic_cli.optics.scattering import deviation_of
from caustic_cli.optics.scattering import scattered as scattering
from caustic_cli.scene import Scene

#: Standard deviation of a parabola's heights in parts of its depth: sqrt(4 / 45).
PARABOLA = math.sqrt(4.0 / 45.0)
#: Blur, pixels, and fraction of light scattered for which a step-over is given.
PIXELS, SCATTERED = 0.5, 0.01


def scallops(scene: Scene, step: float, radius: float) -> dict:
    """Figures for JSON, of a step-over s and a tool of radius R, mm.

    Keys: blur_mm and blur_pixels, of rays; scattered, the fraction of light scattered by diffraction, at wavelength_nm;
    step_over_of_half_a_pixel_mm and scallop_of_half_a_pixel_mm, for which rays blur by half a pixel; step_over_of_waves_mm and
    scallop_of_waves_mm, for which a hundredth of the light is scattered.
    """
    lens, screen = scene.lens, scene.screen
    bend, throw = abs(lens.effective_index - 1.0), abs(screen.z - lens.offset.thickness)
    pixel = max(screen.pixel)
    wavelength = scene.light.mean
    blur = bend * throw * step / radius
    fine = PIXELS * pixel * radius / (bend * throw)
    shallow = deviation_of(SCATTERED, bend, wavelength) / PARABOLA
    return {
        "blur_mm": blur,
        "blur_pixels": blur / pixel,
        "scattered": scattering(PARABOLA * step * step / (8.0 * radius), bend, wavelength),
        "wavelength_nm": wavelength,
        "step_over_of_half_a_pixel_mm": fine,
        "scallop_of_half_a_pixel_mm": fine * fine / (8.0 * radius),
        "step_over_of_waves_mm": math.sqrt(8.0 * radius * shallow),
        "scallop_of_waves_mm": shallow,
    }


def rows(f: dict) -> list[tuple[str, str]]:
    """The figures of a machining program as rows of a table (name, text)."""
    lathe = []
    if "turns" in f:
        blank = f"{f['turns']} turns of a blank of {f['blank_mm']:.4g} mm; clearance above {f['clearance_needed_deg']:.2g} degrees"
        moves = f"Z up to {f['z_speed_mm_s']:.2g} mm/s and {f['z_acceleration_m_s2']:.2g} m/s²"
        lathe.append(("on the lathe", f"{blank}; {moves}"))
    return [
        ("program", f"{f['lines']:,} lines, {f['length_mm']:,.0f} mm of cut, about {_time(f['minutes'])}"),
        (
            "passes",
            f"{f['step_over_mm']:.4g} mm apart, scallops up to {1e3 * f['scallop_mm']:.3g} µm,"
            f" slopes up to {f['scallop_slope']:.3g}",
        ),
        *lathe,
        ("unpolished, by rays", f"blurs over {f['blur_mm']:.3g} mm, {f['blur_pixels']:.3g} pixels, across the passes"),
        ("as a wave", f"scatters {f['scattered']:.2%} of the light ({f['wavelength_nm']:.0f} nm)"),
        (
            "half a pixel by rays",
            f"passes {1e3 * f['step_over_of_half_a_pixel_mm']:.3g} µm apart,"
            f" scallops of {1e6 * f['scallop_of_half_a_pixel_mm']:.2g} nm",
        ),
        (
            "1 % scattered as a wave",
            f"passes {1e3 * f['step_over_of_waves_mm']:.3g} µm apart, scallops of {1e6 * f['scallop_of_waves_mm']:.3g} nm;"
            " else polish as deep as the scallops",
        ),
    ]


def _time(minutes: float) -> str:
    return f"{minutes:.1f} minutes" if minutes < 100 else f"{minutes / 60:.1f} hours"
