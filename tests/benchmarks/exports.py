"""The picture through every exported file, as `caustic export` prints it and as readers that share no code with it find it.

    python tests/benchmarks/exports.py PROJECT [PROJECT ...] [--formats step,stl] [--side 5600] [-o DIR]

The projects are designs by rays of a plane wave with `--margin 0 --linear`.  The readers and the tracer are those of
`tests/test_file_pictures.py`: SciPy's splines, and the closed form of a single refracting surface with --side squared stratified
rays.  The files of a net of 3003 x 3003 control points take some minutes and 8 GB.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import test_file_pictures as independent

from caustic_cli import load
from caustic_cli.export import FORMATS


def exported(project: Path, format: str, path: Path) -> dict:
    """Figures of `caustic export`."""
    command = [
        sys.executable,
        "-m",
        "caustic_cli",
        "export",
        str(project),
        "--format",
        format,
        "-o",
        str(path),
        "--json",
        "--quiet",
    ]
    done = subprocess.run([*command, "--force"], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("projects", nargs="+", type=Path)
    parser.add_argument("--formats", default=",".join(name for name in FORMATS if name not in ("gcode", "xyz")))
    parser.add_argument("--side", type=int, default=5600, help="rays along each side of the lens")
    parser.add_argument("-o", "--out", type=Path, help="keep the files here")
    options = parser.parse_args()
    independent.RAYS = options.side
    print("| picture | format | MB | error printed | facets or cloud | read independently | of the lens |\n" + "| --- " * 7 + "|")
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for project in options.projects:
            lens = load(project)
            scene, target = lens.scene, lens.target
            own = independent.own_error(scene, target, *independent.surface(lens.field, lens.heights, 11))
            for format in options.formats.split(","):
                path = folder / f"{project.stem}{FORMATS[format][0]}"
                said = exported(project, format, path)
                read = "-"
                if format != "mitsuba":
                    read = f"{independent.own_error(scene, target, *independent.read_back(path, format, lens.field, 11)):.4f}"
                beside = next((f"{said[key]:.4f}" for key in ("facet_error", "cloud_error") if key in said), "-")
                size = sum(Path(file).stat().st_size for file in [path, *said.get("beside", ())]) / 1e6
                error = f"{said['error']:.4f}{'' if said['keeps_picture'] else ' (warned)'}"
                print(f"| {project.stem} | {format} | {size:.1f} | {error} | {beside} | {read} | {own:.4f} |", flush=True)


if __name__ == "__main__":
    main()
