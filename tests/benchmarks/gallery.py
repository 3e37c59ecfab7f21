"""The gallery: fifteen lenses of different kinds, designed by whole commands, with their pictures, times and figures.

    python tests/benchmarks/gallery.py [--only NAME,...] [--quality draft|standard|fine] [-o DIR]

writes examples/gallery: README.md, and for each lens a strip of target, image by rays, wave image where diffraction is
simulated, and relief.  About fifteen minutes on two cores.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont
from quality import DATA, EXAMPLES, caustic, pictures

from caustic_cli import load
from caustic_cli.inverse.lamp import pixels_of, wanted
from caustic_cli.optics.lamp import sides
from caustic_cli.workflow.lamp import LampDesign

#: What each lens is for, its picture, and the options that make it.
LENSES = {
    "flame": ("The first command of the README: a plane wave, refined on the wave image", "flame", ""),
    "portrait": ("A photograph, refined by ray tracing only", "portrait", "--waves off"),
    "logo": ("A black drawing on a transparent background, inverted", "logo", "--invert"),
    "point": ("A point source 50 mm before the lens", "ball", "--source point"),
    "disc": ("A disc of 5 mm at 1 m", "ball", "--source disc --source-size 5 --source-position 0,0,-1000"),
    "plate": ("A 100 mm acrylic plate in sunlight, wall at 0.5 m", "portrait", "--preset plate-100"),
    "mirror": ("A 100 mm mirror in sunlight from the side, wall at 1 m in front of it", "flame", "--preset mirror-100"),
    "window": (
        "A plate in a south window at an equinox, its picture on the floor below",
        "flame",
        "--preset window-floor",
    ),
    "mark": ("A mark of 20 mm that is read in daylight, 60 mm behind a round lens", "logo", "--preset mark --invert"),
    "sundial": ("A sundial in a roof window: nine lenslets, nine hours", "dial", "--preset sundial --quality draft"),
    "led": ("A luminaire lens, 60 mm from an LED, wall at 2 m", "tophat", "--preset led-30"),
    "lamp": ("A lens around an LED, for the passing beam of a car", "headlamp", "--preset headlamp"),
    "laser": ("A round lens in a laser beam, screen at 1 m", "flame", "--preset laser-25"),
    "beam": (
        "The beam of a laser as an even disc of 6 mm, with 0.97 of the light in it",
        "tophat",
        "--source gaussian --waist 3 --wavelengths 1064 --lens-size 12 --throw 500 --picture-size 13x13 --margin 0"
        " --loss log-rms --efficiency 0.97",
    ),
    "print": ("A lens of printing resin, 500 mm from a small LED, wall at 300 mm", "portrait", "--preset print-50"),
}
HEAD = """# Gallery

The lenses below were designed by `python tests/benchmarks/gallery.py` on two cores. Each strip shows the target, the image by ray
tracing, the wave image where diffraction is simulated, and the relief of the lens relative to its best-fitting quadric, or of a
lens around an LED its outer radius over the directions from there, with the axis in the middle (each on its own scale). Errors are
measured with rays that no design used; other work on the machine affected the times.

"""
#: Pixels along a panel's side.
SIDE = 200


def more_pictures(folder: Path) -> dict[str, Path | str]:
    """Those that examples/ and the table of qualities do not have, and pictures by name."""
    logo = Image.new("RGBA", (500, 500))
    draw = ImageDraw.Draw(logo)
    draw.ellipse((60, 60, 440, 440), outline=(0, 0, 0, 255), width=28)
    draw.text((250, 250), "f/2", fill=(0, 0, 0, 255), anchor="mm", font=ImageFont.truetype(f"{DATA}/fonts/ttf/DejaVuSans.ttf", 150))
    logo.save(folder / "logo.png")
    return {"headlamp": "headlamp", "tophat": EXAMPLES / "tophat.png", "dial": EXAMPLES / "dial.png", "logo": folder / "logo.png"}


def relief(project: Path) -> Image.Image:
    """The surface, less the quadric that fits it best, from dark to bright; of a lamp its radius over stereographic coordinates."""
    lens = load(project)
    if isinstance(lens, LampDesign):
        u, v = np.meshgrid(np.linspace(-1.0, 1.0, SIDE), np.linspace(1.0, -1.0, SIDE))
        net = lens.field.net.evaluate(sides(lens.values)[1], *(torch.from_numpy(c.reshape(-1)) for c in (u, v)))[0]
        return shaded(np.where(u * u + v * v <= 1.0, net.numpy().reshape(u.shape), np.nan))
    rx, ry = lens.scene.lens.half_size
    x, y = np.meshgrid(np.linspace(-rx, rx, SIDE), np.linspace(ry, -ry, SIDE))
    z = lens.surface(x, y)[0]
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1).reshape(-1, 6)
    return shaded(z - (terms @ np.linalg.lstsq(terms, z.ravel(), rcond=None)[0]).reshape(z.shape))


def shaded(z: np.ndarray) -> Image.Image:
    """Values from dark to bright, white where there are none."""
    low, high = np.nanpercentile(z, (0.5, 99.5))
    shown = colormaps["cividis"].with_extremes(bad="white")(np.clip((z - low) / max(high - low, 1e-12), 0.0, 1.0))[..., :3]
    return Image.fromarray((shown * 255).astype(np.uint8))


def codes_of(light: np.ndarray) -> np.ndarray:
    """Light (rows, columns[, colours]) as bytes to be shown."""
    brightest = np.percentile(light if light.ndim == 2 else light.max(-1), 99.9)
    return (np.clip(light / brightest, 0.0, 1.0) ** (1 / 2.2) * 255).astype(np.uint8)


def strip(project: Path, path: Path) -> None:
    """The lens' panels side by side."""
    if (project / "hours.png").exists():  # the pictures of all hours, whose mean is the target
        panels = [Image.open(project / name) for name in ("target.png", "hours.png")]
    elif isinstance(lens := load(project), LampDesign):
        pixels = pixels_of(lens.goal, SIDE * SIDE)
        wanted_there = wanted(lens.goal, lens.picture, pixels).numpy() / lens.goal.shares(pixels)
        seen = np.asarray(Image.open(project / "render.png").convert("L"), float)  # as linear as the target
        panels = [Image.fromarray(codes_of(light)) for light in (wanted_there.T[::-1], seen)]
    else:
        target = lens.target
        light = np.moveaxis(np.atleast_3d(target if target.ndim == 2 else np.moveaxis(target, 0, -1)), (0, 1), (1, 0))[::-1]
        codes = codes_of(light)
        names = [name for name in ("render.png", "wave.png") if (project / name).exists()]
        panels = [Image.fromarray(codes[..., 0] if codes.shape[-1] == 1 else codes), *(Image.open(project / n) for n in names)]
    panels = [p.convert("RGB").resize((SIDE, round(SIDE * p.height / p.width)), Image.Resampling.LANCZOS) for p in panels]
    panels.append(relief(project))
    sheet = Image.new("RGB", (len(panels) * (SIDE + 8) - 8, max(p.height for p in panels)), "white")
    for k, panel in enumerate(panels):
        sheet.paste(panel, (k * (SIDE + 8), 0))
    sheet.save(path, optimize=True)


def row(name: str, picture: Path | str, quality: str, folder: Path, out: Path) -> str:
    """Design, retrace with eight times the rays, draw; a part of the gallery's page."""
    words, _, options = LENSES[name]
    project = folder / f"{name}.caustic"
    began = time.monotonic()
    how = options.split() + (["--quality", quality] if quality != "standard" else [])  # which a lamp has not
    said = caustic("design", picture, *how, "-o", project)
    seconds = time.monotonic() - began
    sharp = caustic("render", project, "--rays", "3.2e7" if said.get("least_relative_rms") is None else "8e6")
    strip(project, out / f"{name}.png")
    contrasts = [hour["contrast"] for hour in sharp.get("hours", ()) if hour["contrast"] is not None]
    errors = {"rays": f"by rays {sharp['relative_rms']:.3f} ± {sharp['noise']:.4f}"}
    if sharp.get("wave_relative_rms") is not None:
        errors["waves"] = f"of the wave image {sharp['wave_relative_rms']:.3f}"
    judged = errors.pop(sharp.get("error_by", "rays"))
    seen = sharp[{"waves": "wave_on_target", "rays": "on_target"}.get(sharp.get("error_by"), "of_source")]
    beside = sharp["of_source"] != sharp.get("on_target", seen)
    emitted = f", {100.0 * sharp['of_source']:.3g}% of all the source emits" if beside else ""
    figures = [
        f"relative RMS error {judged}" if not contrasts else "",  # of a sundial it would be that of the mean of all hours
        f"at least {said['least_relative_rms']:.3f} for any lens, by the source's blur" if said.get("least_relative_rms") else "",
        f"light on the picture {seen:.1%}{emitted}",
        f"without its outer {sharp['border']:.3g} {sharp['border_unit']} {sharp['interior_rms']:.3f}" if "border" in sharp else "",
        f"its upper edge is {sharp['cut_off']:.2f} degrees wide" if sharp.get("cut_off") is not None else "",
        f"at its hour each is at least {min(contrasts):.3g} times as bright as the light of the others there" if contrasts else "",
        f"designed in {seconds:.0f} s",
        *errors.values(),
    ]
    command = f"caustic design {Path(picture).name} {options}".strip() + (f" --quality {quality}" if quality != "standard" else "")
    return f"## {words}\n\n![{words}]({name}.png)\n\n{'; '.join(filter(None, figures))}.\n\n```sh\n{command}\n```\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(LENSES), help="names of lenses, separated by commas")
    parser.add_argument("--quality", default="standard", choices=("draft", "standard", "fine"))
    parser.add_argument("-o", "--out", type=Path, default=EXAMPLES / "gallery", metavar="DIR")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    page = given.out / "README.md"
    parts = re.split(r"^(?=## )", page.read_text("utf-8"), flags=re.M)[1:] if page.exists() else []
    kept = {name: part for part in parts for name in re.findall(r"\((\w+)\.png\)", part)}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        known = pictures(place) | more_pictures(place)
        caustic("design", known["flame"], "--quality", "draft", "--time-limit", 1, "-o", place / "warm.caustic")
        for name in given.only.split(","):
            kept[name] = row(name, known[LENSES[name][1]], given.quality, place, given.out)
            print(kept[name], flush=True)
            page.write_text(HEAD + "\n".join(kept[name].strip() + "\n" for name in LENSES if name in kept), encoding="utf-8")


if __name__ == "__main__":
    main()
