#!/usr/bin/env python3
"""Every experiment of the thesis' chapter 6, and this tool's own defaults on the same scenes beside them.

    python examples/thesis/run.py [--quick] [--threads N] [-o DIR]

Writes DIR/thesis.png (one page, in the order of the thesis' figures), thesis.csv and thesis.json (loss, light, time), and every
project.  --quick is a few dozen iterations of each, about ten minutes on two cores; without it the iterations are the thesis',
half an hour.  What is done already is not done again.  Only the command line and what its library documents are used.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
from page import draw

from caustic_cli import load

HERE = Path(__file__).resolve().parent
PICTURES = HERE.parent
#: Section 6.2.1: network and initial state.
PAIRS = ("none", "sparse-uniform", "sparse-random", "dense-uniform", "dense-random")
MAGS = (1, 3, 5)
THREADS: list[str] = []


def caustic(*arguments) -> dict:
    """One command of the tool; what --json says."""
    command = [sys.executable, "-m", "caustic_cli", *map(str, arguments), "--json", "--quiet", *THREADS]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
    return json.loads(done.stdout)


class Book:
    """The figures and arrays of every experiment; each is kept as soon as it is there."""

    def __init__(self, folder: Path, size: str):
        self.folder, self.path = folder, folder / f"book-{size}.json"
        self.rows = json.loads(self.path.read_text()) if self.path.exists() else {}

    def keep(self, name: str, figures: dict, **arrays: np.ndarray) -> None:
        np.savez(self.folder / f"{name}.npz", **arrays)
        self.rows[name] = figures
        self.path.write_text(json.dumps(self.rows, indent=1))

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        with np.load(self.folder / f"{name}.npz") as data:
            return dict(data)


def state(project: Path) -> tuple[np.ndarray, np.ndarray]:
    """Control heights (n, m), mm, and history (k, 5) of a project."""
    with h5py.File(project / "checkpoints.h5") as f:
        return load(project).heights.numpy(), f["history"][()]


def finish(book: Book, name: str, project: Path, figures: dict, seconds: float, **more: np.ndarray) -> None:
    """Retrace a designed lens and note what it does."""
    image = project / "render.npy"
    seen = caustic("render", project, "--rays", "4e6", "--npy", image, "--force")
    heights, history = state(project)
    about = {
        "relative_rms": seen["relative_rms"],
        "loss": seen["loss"],
        "on_screen": seen["on_screen"],
        "fresnel": seen["lost"]["fresnel"],
        "iterations": figures["iterations"],
        "seconds": seconds,
    }
    book.keep(name, about, image=np.load(image), heights=heights, history=history, **more)
    print(
        f"{name:24} loss {seen['loss']:.3e}  relative RMS {seen['relative_rms']:.3f}  on screen {seen['on_screen']:.1%}"
        f"  {seconds:.0f} s",
        flush=True,
    )


def gradients(book: Book) -> None:
    """6.1: degrees and filter sizes (a) 3, 3; (b) 3, 11; (c) (5, 3), 3."""
    for case, degree, filter_size in (("a", "3", 3), ("b", "3", 11), ("c", "5x3", 3)):
        if f"gradient-{case}" in book.rows:
            continue
        project, npy = book.folder / f"flat-{case}.caustic", book.folder / f"gradient-{case}.npy"
        caustic("design", PICTURES / "tophat.png", "--config", HERE / "flat.toml", "--degree", degree, "-o", project, "--force")
        found = caustic(
            "gradmap",
            project,
            "--control",
            "7,7",
            "--reconstruction",
            "gaussian",
            "--filter-size",
            filter_size,
            "--alpha",
            1,
            "--rays",
            "1e6",
            "--npy",
            npy,
            "--force",
        )
        total = 100.0 * found["maps"][0]["sum"]  # the source's power is 100
        book.keep(f"gradient-{case}", {"sum": total, "seconds": found["seconds"]}, gradient=100.0 * np.load(npy))
        print(f"gradient ({case})  sum {total:.3e}", flush=True)


def thesis_design(book: Book, name: str, picture: str, config: Path, marks: tuple[int, ...]) -> None:
    """One of its designs, with the heights at each of `marks` iterations."""
    if name in book.rows:
        return
    project, began, heights = book.folder / f"{name}.caustic", time.monotonic(), {}
    for k, mark in enumerate(marks):
        if k:
            figures = caustic("design", "--resume", project, "--iterations", mark)
        else:
            figures = caustic("design", PICTURES / picture, "--config", config, "--iterations", mark, "-o", project, "--force")
        heights[f"heights_{mark}"] = state(project)[0]
    finish(book, name, project, figures, time.monotonic() - began, **heights)


def own_design(book: Book, name: str, picture: str, config: Path, quick: bool, *more) -> None:
    """This tool's defaults on the same scene: of the configuration only source, lens, screen and picture."""
    if name in book.rows:
        return
    text = config.read_text().split("[design]")[0]
    dropped = ("control", "degree", "height_range", "radius", "aim", "fresnel", "min_thickness")
    text = "\n".join(line for line in text.splitlines() if not line.startswith(dropped)) + "\n"
    text = re.sub(r"^thickness = 0\.0$", "thickness = 3.0", text, flags=re.M)  # table D.1 begins in the middle of 0 to 6
    scene, project, began = book.folder / f"{name}.toml", book.folder / f"{name}.caustic", time.monotonic()
    scene.write_text(text)
    quality = ("--waves", "off", *(("--quality", "draft") if quick else ()))  # judged by rays, as the thesis is
    figures = caustic(
        "design", PICTURES / picture, "--config", scene, "--min-thickness", 0, *quality, *more, "-o", project, "--force"
    )
    finish(book, name, project, figures, time.monotonic() - began)


def scaled(name: str, folder: Path, quick: bool) -> Path:
    """A configuration; with --quick a fifth of its rays, and for 6.4 a twentieth of the iterations."""
    config = HERE / name
    if not quick:
        return config
    text = re.sub(r"^iterations = 200$", "iterations = 10", config.read_text(), flags=re.M)
    path = folder / name
    path.write_text(re.sub(r"^rays = (\d+)$", lambda m: f"rays = {int(m[1]) // 5}", text, flags=re.M))
    return path


def intersection(book: Book, quick: bool) -> None:
    """6.3: figure 6.2.14 on the scene of table D.3."""
    if "intersection" in book.rows:
        return
    folder = book.folder / "intersection"
    options = ("--rays", 5000, "--repeats", 3) if quick else ()
    found = caustic("convergence", "--study", "intersection", *options, "-o", folder, "--force")
    book.keep("intersection", {"orders": found["orders"], "seconds": found["seconds"], "rows": found["rows"]})


def table(book: Book) -> list[dict]:
    """Loss, light and time of every design, the thesis' and ours."""
    rows = []
    for name, row in book.rows.items():
        if "relative_rms" in row:
            rows.append({"experiment": name.removeprefix("own-"), "by": "defaults" if name.startswith("own-") else "thesis", **row})
    return sorted(rows, key=lambda r: (r["experiment"].startswith("point"), r["experiment"], r["by"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="a few dozen iterations of each, about ten minutes")
    parser.add_argument("-o", "--out", type=Path, default=Path("thesis"), metavar="DIR", help="default: thesis")
    parser.add_argument("--threads", type=int, metavar="N", help="of every command; default: all cores")
    options = parser.parse_args()
    if options.threads:
        THREADS[:] = ["--threads", str(options.threads)]
    quick, folder, began = options.quick, options.out, time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    book = Book(folder, "quick" if quick else "full")
    gradients(book)
    marks = (40,) if quick else (50, 100, 1000)
    for pair in PAIRS:
        thesis_design(book, f"tophat-{pair}", "tophat.png", scaled(f"tophat-{pair}.toml", folder, quick), marks)
    own_design(book, "own-tophat", "tophat.png", HERE / "tophat-none.toml", quick)
    for mag in MAGS:
        for picture in ("flame", "ball"):
            name = f"{picture}-mag{mag}"
            config = scaled(f"mag{mag}.toml", folder, quick)
            thesis_design(book, name, f"{picture}.png", config, (30,) if quick else (1000,))
            own_design(book, f"own-{name}", f"{picture}.png", HERE / f"mag{mag}.toml", quick)
    intersection(book, quick)
    point = scaled("point.toml", folder, quick)
    thesis_design(book, "point-grid", "flame.png", point, (20,) if quick else (400,))
    own_design(book, "own-point", "flame.png", HERE / "point.toml", quick, "--source", "point")
    own_design(book, "own-point-grid", "flame.png", HERE / "point.toml", quick)
    rows = table(book)
    (folder / "thesis.json").write_text(json.dumps({"quick": quick, "experiments": book.rows}, indent=1))
    with (folder / "thesis.csv").open("w", newline="") as f:
        writer = csv.DictWriter(f, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    draw(folder / "thesis.png", book, rows, PAIRS, MAGS, marks, PICTURES)
    print(f"{folder / 'thesis.png'}, thesis.csv and thesis.json after {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
