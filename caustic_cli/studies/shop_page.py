"""A page for the shop: the part with its blank, what has to be held in a maker's words (`shop_limits`), its finish, and how its
picture is checked."""

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
from caustic_cli.optics.media import medium_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Lens, Scene
from caustic_cli.studies.shop_limits import Side, limits, sides_of

#: Points of the drawing along an axis.
POINTS = 301
#: Radius, mm, of a side that is flat.
FLAT = 1e6
#: How the picture is photographed.
CARD = (
    "Print the test card in its true size ($wide x $high mm, no scaling by the printer) on white matt paper, and measure the"
    " distance of two of its marks.",
    "Fix it on the screen, $throw mm from the part's $face$along, $square, with its printed side to the lens and the picture"
    " between the marks.",
)
NO_CARD = ("Catch the picture on a white matt surface, $place, and fix eight marks or more around it whose places are measured.",)
STEPS = (
    "Light the part as it is meant to be: $light.",
    "Darken the room, but leave enough light that the marks are seen.",
    "Photograph the screen from the side of the lens, as nearly square as the light allows, with all marks in the picture, the"
    " camera on a stand; nothing may be white without detail: expose so that the brightest places stay below the camera's limit.",
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
<img alt="Heights of every free-form side, and sections through its middle" src="data:image/png;base64,$drawing">
<h2>What has to be held</h2>
<table>$held</table>
<h2>Finish</h2>
<p>$finish</p>
<h2>How the picture is checked</h2>
<ol>$steps</ol>
</body></html>
"""
)


def write_page(
    path: Path,
    title: str,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    report: dict[str, Any],
    finish: str,
    card: tuple[float, float] | None,
    seed: int,
) -> dict[str, Any]:
    """Write the page; its `limits`.

    Args:
        field, heights: of the exit to be made; report: of `studies.manufacture`; finish: its steps, "" if none is foreseen.
        card: width and height of the test card, mm, None without one; seed: of the rays.
    """
    found, lens = limits(scene, field, heights, seed), scene.lens
    light = scene.light.mean
    several = len(scene.light.wavelengths) > 1
    source = f"a {scene.source.kind} source as designed, " + (
        f"of {light:.0f} nm" if not several else f"white, {light:.0f} nm on average"
    )
    screen, throw = scene.screen, f"{abs(scene.screen.z - lens.z_in):.6g}"
    face = "flat side" if lens.entrance is None else f"plane z = {lens.z_in:g} mm"
    along = " along the axis" if scene.elements else ""
    shape = f"{screen.shape_words()}, its middle {throw} mm from the part's {face}{along}"
    angles = f"so far away that the part looks small from there: the picture is one of angles, {screen.size[0]:g} x"
    words = {
        "wide": f"{(card or screen.size)[0]:.4g}",
        "high": f"{(card or screen.size)[1]:.4g}",
        "throw": throw,
        "face": face,
        "along": along,
        "square": "rolled to its shape" if screen.curved else "square to the light",
        "place": f"{angles} {screen.size[1]:g} {screen.unit}" if screen.far else shape,
        "light": source,
    }
    steps = [Template(step).substitute(words) for step in (*(NO_CARD if card is None else CARD), *STEPS)]
    page = PAGE.substitute(
        software=SOFTWARE,
        title=html.escape(title),
        part=_table(_part(scene, report)),
        drawing=base64.b64encode(_drawing(sides_of(scene, field, heights))).decode(),
        held=_table(_held(found, report)),
        finish=html.escape(_finish(finish)),
        steps="".join(f"<li>{html.escape(step)}</li>" for step in steps),
    )
    write_bytes(path, page.encode())
    return found


def _table(rows: list[tuple[str, str]]) -> str:
    return "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows)


def _part(scene: Scene, report: dict[str, Any]) -> list[tuple[str, str]]:
    lens = scene.lens
    rows = [("optical area", lens.opening.words(lambda lengths: " x ".join(f"{c:g}" for c in lengths) + " mm"))]
    if scene.elements:
        places = ", ".join(f"a {e.kind} at {e.z - lens.z_in:+g} mm" for e in scene.elements)
        rows.append(("stands among", f"{places}, along the axis from the part; the limits below are those of all together"))
    if lens.mirror:
        return [*rows, ("material", "any that takes a mirror coating")]
    return [
        *rows,
        ("material", _material(lens)),
        ("blank", f"at least {report['stock_height_mm']:.3f} mm thick, {_other_side(lens)}"),
        ("thinnest place", f"{report['minimum_wall_mm']:.3f} mm"),
        ("volume", f"{report['volume_cm3']:.4g} cm³" + (f", {report['mass_g']:.4g} g" if report["mass_g"] else "")),
    ]


def _material(lens: Lens) -> str:
    medium = medium_of(lens)
    if not medium.varies or lens.gradient is None:
        return lens.glass or f"clear, refractive index {lens.index:g}"
    least, most = (lens.index * part for part in medium.variation(lens.half_size, lens.offset.thickness - lens.z_in)[:2])
    return f"{lens.glass or 'clear'}, refractive index from {least:.4f} to {most:.4f}: {lens.gradient.words(lens.index)}"


def _other_side(lens: Lens) -> str:
    if lens.entrance is None:
        return "one side flat and polished"
    return f"both sides free-form: heights of the exit side are from z = 0, of the entrance side from z = {lens.z_in:g} mm"


def _held(found: dict[str, Any], report: dict[str, Any]) -> list[tuple[str, str]]:
    several, rows = bool(found["beside"]), []
    for side in ({"side": "exit side"} | report | found, *found["beside"]):
        prefix = f"{side['side']}: " if several else ""
        rows += [(prefix + name, text) for name, text in _of_side(side)]
    rows.append(
        ("roughness", f"at most {found['roughness_nm']:.0f} nm RMS: an optical polish, through which print is seen sharply")
    )
    if "index_bumps" in found:
        bumps = "; ".join(f"{error:.2g} over {width:g} mm" for width, error in found["index_bumps"].items())
        rows.append(("errors of the index", f"through the whole thickness lower than {bumps}: each moves the light by one pixel"))
    for key, name, unit in (
        ("index_error_of_a_pixel", "refractive index", ""),
        ("throw_error_of_a_pixel_mm", "distance of the screen", " mm"),
    ):
        if report[key] is not None:
            rows.append((name, f"within {report[key]:.2g}{unit}"))
    return rows


def _of_side(side: dict[str, Any]) -> list[tuple[str, str]]:
    """What has to be held of a side, and its shape."""
    bumps = "; ".join(f"{height:.2g} µm over {width:g} mm" for width, height in side["bumps_um"].items())
    radius, slope = side["smallest_concave_radius_mm"], side["slope"]
    rows = [
        ("bumps and hollows", f"lower than {bumps}: each moves the light by one pixel of the picture"),
        ("slope", f"within {slope:.2g} mm per mm ({math.degrees(math.atan(slope)):.2g} degrees)"),
        ("tool", "of any radius" if radius is None or radius > FLAT else f"radius at most {radius:.3g} mm, the smallest hollow's"),
        ("steepest place", f"{math.degrees(math.atan(side['maximum_slope'])):.1f} degrees"),
    ]
    if side.get("decentre_mm") is not None:
        rows.append(("centred", f"on the exit side to {side['decentre_mm']:.2g} mm: more moves the light by one pixel"))
    return rows


def _finish(finish: str) -> str:
    if finish:
        return f"The surface in the exported file is corrected for this finish, without which the picture is wrong: {finish}."
    return (
        "The surface is to be made as in the file and must not be rounded off: no pad or coat may change the heights above. If it"
        " has to be sanded, polished or coated, say how before it is made: the file can be corrected for it."
    )


def _drawing(sides: list[Side]) -> bytes:
    """Heights of each side, and sections along x and y through its middle, a PNG."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(9.5, 4.0 * len(sides)), dpi=150, layout="constrained")
    for side, (plan, section) in zip(sides, figure.subplots(len(sides), 2, squeeze=False), strict=True):
        words = "free-form side" if len(sides) == 1 else side.words
        z = side.field.on_grid(side.heights, (POINTS, POINTS)).numpy()
        (rx, ry), lines = side.field.half_size, [np.linspace(-r, r, POINTS) for r in side.field.half_size]
        shown = plan.imshow(z.T, extent=(-rx, rx, -ry, ry), origin="lower", cmap="viridis")
        plan.contour(*lines, z.T, levels=12, colors="white", linewidths=0.4)
        seen = f"seen from the {words}" if side is sides[0] else f"{words}, seen against the light"
        plan.set(xlabel="x (mm)", ylabel="y (mm)", title=f"height (mm), {seen}")
        figure.colorbar(shown, ax=plan)
        section.plot(lines[0], z[:, POINTS // 2], label="along x")
        section.plot(lines[1], z[POINTS // 2], label="along y")
        section.set(xlabel="mm from the middle", ylabel="height (mm)", title="sections through the middle")
        section.legend()
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": SOFTWARE})
    return file.getvalue()
