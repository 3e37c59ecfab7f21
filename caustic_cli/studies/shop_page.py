"""A page for the shop: the part with its blank, what has to be held in a maker's words, its finish, and how its picture is checked.

Light is displaced on the screen by |n - 1| T times an error s of the slope, at throw T, which is to stay below a pixel p: a bump of
width w (half a period) and height a of a sinusoid has slopes up to pi a / w, so a <= w p / (pi |n - 1| T).  Its roughness
is to scatter less than SCATTERED of the light (`optics.scattering`).
"""

from __future__ import annotations

import base64
import html
import io
import math
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from torch import Tensor

from caustic_cli.io.files import SOFTWARE, write_bytes
from caustic_cli.optics.scattering import deviation_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene

#: Widths of bumps for which heights are given, in parts of the part's width.
BUMPS = (0.02, 0.05, 0.1, 0.2, 0.5)
#: Fraction of light that may be scattered; points of the drawing along an axis.
SCATTERED, POINTS = 0.01, 301
#: How the picture is photographed.
STEPS = (
    "Print the test card in its true size ($wide x $high mm, no scaling by the printer) on white matt paper, and measure the"
    " distance of two of its marks.",
    "Fix it on the screen, $throw mm from the part's flat side, square to the light, with its printed side to the lens and the"
    " picture between the marks.",
    "Light the part as it is meant to be: $light.",
    "Darken the room, but leave enough light that the marks are seen.",
    "Photograph the card from the side of the lens, as nearly square as the light allows, with all marks in the picture, the camera"
    " on a stand; nothing may be white without detail: expose so that the brightest places stay below the camera's limit.",
    "Send the file as the camera wrote it: the designer's program tells from it what is wrong with the part.",
)
PAGE = Template(
    """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="generator" content="$software"><title>$title</title><style>
body { font: 11pt/1.4 sans-serif; max-width: 190mm; margin: 8mm auto; } h1 { font-size: 16pt; } h2 { font-size: 12pt; }
table { border-collapse: collapse; } td, th { padding: 1mm 4mm 1mm 0; text-align: left; vertical-align: top; }
img { width: 100%; } li { margin-bottom: 1.5mm; } @media print { body { margin: 0; } }
</style></head><body>
<h1>$title</h1>
<h2>The part</h2>
<table>$part</table>
<img alt="Heights of the free-form side, and sections through its middle" src="data:image/png;base64,$drawing">
<h2>What has to be held</h2>
<table>$held</table>
<h2>Finish</h2>
<p>$finish</p>
<h2>How the picture is checked</h2>
<ol>$steps</ol>
</body></html>
"""
)


def limits(scene: Scene) -> dict[str, Any]:
    """What has to be held, for JSON: slope, by which the light moves by a pixel; bumps_um, heights by widths, mm; roughness_nm."""
    bend, throw = abs(scene.lens.effective_index - 1.0), abs(scene.screen.z - scene.lens.offset.thickness)
    slope = min(scene.screen.pixel) / (bend * throw)
    widths = [float(f"{part * max(scene.lens.size):.3g}") for part in BUMPS]
    return {
        "slope": slope,
        "bumps_um": {width: 1e3 * width * slope / math.pi for width in widths},
        "roughness_nm": 1e6 * deviation_of(SCATTERED, bend, scene.light.mean),
    }


def write_page(
    path: Path, title: str, scene: Scene, field: HeightField, heights: Tensor, report: dict[str, Any], finish: str, card: tuple
) -> dict[str, Any]:
    """Write the page; its `limits`.

    Args:
        field, heights: of the surface to be made; report: of `studies.manufacture`; finish: its steps, "" if none is foreseen.
        card: width and height of the test card, mm.
    """
    found, lens = limits(scene), scene.lens
    light = scene.light.mean
    several = len(scene.light.wavelengths) > 1
    source = f"a {scene.source.kind} source as designed, " + (
        f"of {light:.0f} nm" if not several else f"white, {light:.0f} nm on average"
    )
    words = {"wide": f"{card[0]:.4g}", "high": f"{card[1]:.4g}", "throw": f"{abs(scene.screen.z - lens.z_in):.6g}", "light": source}
    page = PAGE.substitute(
        software=SOFTWARE,
        title=html.escape(title),
        part=_table(_part(scene, report)),
        drawing=base64.b64encode(_drawing(field, heights)).decode(),
        held=_table(_held(found, report)),
        finish=html.escape(_finish(finish)),
        steps="".join(f"<li>{html.escape(Template(step).substitute(words))}</li>" for step in STEPS),
    )
    write_bytes(path, page.encode())
    return found


def _table(rows: list[tuple[str, str]]) -> str:
    return "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows)


def _part(scene: Scene, report: dict[str, Any]) -> list[tuple[str, str]]:
    lens = scene.lens
    wide, high = lens.size
    shape = f"round, {wide:g} mm across" if lens.opening.round else f"{wide:g} x {high:g} mm"
    rows = [("optical area", shape), ("material", lens.glass or f"clear, refractive index {lens.index:g}")]
    if lens.mirror:
        return [rows[0], ("material", "any that takes a mirror coating")]
    return [
        *rows,
        ("blank", f"at least {report['stock_height_mm']:.3f} mm thick, one side flat and polished"),
        ("thinnest place", f"{report['minimum_wall_mm']:.3f} mm"),
        ("volume", f"{report['volume_cm3']:.4g} cm³" + (f", {report['mass_g']:.4g} g" if report["mass_g"] else "")),
    ]


def _held(found: dict[str, Any], report: dict[str, Any]) -> list[tuple[str, str]]:
    bumps = "; ".join(f"{height:.2g} µm over {width:g} mm" for width, height in found["bumps_um"].items())
    radius = report["smallest_concave_radius_mm"]
    rows = [
        ("bumps and hollows", f"lower than {bumps}: each moves the light by one pixel of the picture"),
        (
            "slope",
            f"within {found['slope']:.2g} mm per mm ({math.degrees(math.atan(found['slope'])):.2g} degrees)",
        ),
        ("roughness", f"at most {found['roughness_nm']:.0f} nm RMS: an optical polish, through which print is seen sharply"),
        ("tool", "of any radius" if radius is None else f"radius at most {radius:.3g} mm, the smallest hollow's"),
        ("steepest place", f"{math.degrees(math.atan(report['maximum_slope'])):.1f} degrees"),
    ]
    for key, name, unit in (
        ("index_error_of_a_pixel", "refractive index", ""),
        ("throw_error_of_a_pixel_mm", "distance of the screen", " mm"),
    ):
        if report[key] is not None:
            rows.append((name, f"within {report[key]:.2g}{unit}"))
    return rows


def _finish(finish: str) -> str:
    if finish:
        return f"The surface in the exported file is corrected for this finish, without which the picture is wrong: {finish}."
    return (
        "The surface is to be made as in the file and must not be rounded off: no pad or coat may change the heights above. If it"
        " has to be sanded, polished or coated, say how before it is made: the file can be corrected for it."
    )


def _drawing(field: HeightField, heights: Tensor) -> bytes:
    """Heights, and sections along x and y through the middle, a PNG."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    z = field.on_grid(heights, (POINTS, POINTS)).numpy()
    (rx, ry), lines = field.half_size, [np.linspace(-r, r, POINTS) for r in field.half_size]
    figure = Figure(figsize=(9.5, 4.0), dpi=150, layout="constrained")
    plan, section = figure.subplots(1, 2)
    shown = plan.imshow(z.T, extent=(-rx, rx, -ry, ry), origin="lower", cmap="viridis")
    plan.contour(*lines, z.T, levels=12, colors="white", linewidths=0.4)
    plan.set(xlabel="x (mm)", ylabel="y (mm)", title="height (mm), seen from the free-form side")
    figure.colorbar(shown, ax=plan)
    section.plot(lines[0], z[:, POINTS // 2], label="along x")
    section.plot(lines[1], z[POINTS // 2], label="along y")
    section.set(xlabel="mm from the middle", ylabel="height (mm)", title="sections through the middle")
    section.legend()
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": SOFTWARE})
    return file.getvalue()
