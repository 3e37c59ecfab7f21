"""What two checkouts of this program do alike: a net to fall into while its code is rearranged.

    python tests/benchmarks/compare.py record DIR [--checkout PATH] [--only settings,designs,images,refusals,help]
    python tests/benchmarks/compare.py show OLD NEW [--tolerance 1e-12]

`record` runs the commands of one checkout (this one unless another is given) on small pictures and writes what they leave to
DIR, as text and arrays; on two cores it takes about a quarter of an hour.  `show` lists what differs between two recordings and
exits with 1 if anything does: texts must be the same, numbers within the tolerance, relative to the largest number of their
array.

    settings    project.toml, as completed, of every preset and of every configuration in examples/, at full size: the design is
                interrupted as soon as it is written
    designs     figures, control heights and completed settings of a small design of every kind, and after it was resumed
    images      images, by rays and by waves, of one lens under every source and effect, and its gradient map
    refusals    the templates of all messages of bad input, from the sources; and what is said to wrong commands
    help        the help of every command, and the manual pages
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parents[2]
COMMANDS = ("design", "render", "gradmap", "export", "convergence")
#: Options of the small designs, and their resumption.
SMALL = "--resolution 24 --control 16 --rays 4000 --iterations 4 --quality draft"
DESIGNS = {
    "rays": "--waves off",
    "waves": "--lens-size 2 --throw 60",
    "offset": "--waves off --start offset",
    "adam": "--waves off --start offset --optimizer adam --lr 1e-4",
    "sparse": "--waves off --start offset --network sparse",
    "dense": "--waves off --start offset --network dense --control 8",
    "round": "--waves off --aperture circle",
    "mirror": "--waves off --mirror",
    "tilted": "--waves off --screen-tilt 20,0",
    "curved": "--waves off --screen-radius 200",
    "point": "--waves off --source point",
    "grid": "--waves off --source grid --source-grid 3",
    "disc": "--waves off --source disc --source-size 2 --source-position 0,0,-500",
    "sun": "--source-angle 0.53",
    "collimate": "--waves off --collimate",
    "second": "--waves off --second other.png --second-at 400",
    "array": "--waves off --array 2",
    "element": "--waves off --element 'lens z=20 thickness=4 radius=80,-80 size=14'",
    "gradient": "--waves off --gradient free",
    "over": "--waves off --start offset --network dense --control 8 --over throw=250:350",
    "robust": "--waves off --robust errors.toml",
    "radius": "--waves off --min-radius 5",
    "wavelengths": "--glass N-BK7 --wavelengths 486,588,656 --waves off",
}
#: Renders of the lens designed as "rays".
IMAGES = {
    "plane": "",
    "point": "--source point --source-position 0,0,-300",
    "grid": "--source grid --source-grid 3 --source-position 0,0,-300",
    "disc": "--source disc --source-size 2 --source-position 0,0,-300",
    "sun": "--source disc --source-angle 0.53",
    "lambertian": "--source point --source-position 0,0,-40 --intensity lambertian",
    "cosine": "--reconstruction cosine --filter-size 3",
    "gaussian": "--reconstruction gaussian --filter-size 5",
    "none": "--effects none",
    **{
        effect: f"--effects {effect}"
        for effect in ("fresnel", "absorption", "ghosts", "polarisation", "dispersion", "diffraction", "roughness")
    },
}
#: Commands that must be refused.
WRONG = (
    "design missing.png",
    "design flame.png --mag -3",
    "design flame.png --source sun",
    "design flame.png --degree 0",
    "design flame.png --control 3",
    "design flame.png --gradient free --mirror",
    "design flame.png --collimate --element 'lens z=20'",
    "design flame.png --preset none",
    "design flame.png --glass none",
    "design flame.png --loss none",
    "design flame.png --config missing.toml",
    "design flame.png --source point --source-angle 1",
    "design flame.png --second other.png",
    "design flame.png --array 2 --source point",
    "render missing.caustic",
    "render rays.caustic --effects none,ghosts",
    "render rays.caustic --rays 0",
    "gradmap rays.caustic --control 99,0",
    "export rays.caustic --format none",
    "export rays.caustic --format step --samples 9",
    "convergence rays.caustic --study none",
)


class Recorder:
    """Commands of a checkout, run in a scratch folder, and the recording at `folder`."""

    def __init__(self, checkout: Path, scratch: Path, folder: Path):
        self.checkout, self.scratch, self.folder = checkout, scratch, folder
        self.environment = os.environ | {"PYTHONPATH": str(checkout), "NO_COLOR": "1", "COLUMNS": "100"}

    def start(self, command: str, **options) -> subprocess.Popen:
        words = [sys.executable, "-m", "caustic_cli", *shlex.split(command)]
        return subprocess.Popen(words, cwd=self.scratch, env=self.environment, text=True, **options)

    def run(self, command: str) -> tuple[int, str, str]:
        """Exit status, stdout and stderr."""
        with self.start(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            out, err = process.communicate()
        return process.returncode, out, err

    def need_lens(self) -> None:
        """Design rays.caustic, which other parts render, unless it is there."""
        if not (self.scratch / "rays.caustic").exists():
            self.run(f"design flame.png {SMALL} {DESIGNS['rays']} -o rays.caustic --quiet")

    def text(self, name: str, text: str) -> None:
        """Record a text, without paths of this run."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.replace(str(self.scratch), "SCRATCH").replace(str(self.checkout), "CHECKOUT"))

    def array(self, name: str, values: np.ndarray) -> None:
        """Record an array."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, values)

    def figures(self, name: str, out: str, err: str) -> None:
        """Record the numbers of a JSON object that do not depend on the clock, or the message where there is none."""
        try:
            numbers = dict(_numbers(json.loads(out)))
        except json.JSONDecodeError:
            self.text(f"{name}.txt", err)
            return
        self.text(f"{name}.json", json.dumps(numbers, indent=1, sort_keys=True))


def _numbers(value, path: str = "") -> Iterator[tuple[str, float]]:
    """Numbers of nested JSON by their path, but for times and sizes of files."""
    if isinstance(value, dict):
        for key, one in value.items():
            if not any(word in key for word in ("seconds", "bytes", "memory")):
                yield from _numbers(one, f"{path}/{key}")
    elif isinstance(value, list):
        for k, one in enumerate(value):
            yield from _numbers(one, f"{path}/{k}")
    elif isinstance(value, int | float):
        yield path, value


def record_settings(recorder: Recorder) -> None:
    examples = recorder.checkout / "examples"
    presets = sorted(path.stem for path in (recorder.checkout / "caustic_cli/config/presets").glob("*.toml"))
    said = {f"preset-{name}": f"--preset {name}" for name in presets}
    said |= {str(p.relative_to(examples).with_suffix("")): f"--config {p}" for p in sorted(examples.rglob("*.toml"))}
    for name, options in {"default": "", **said}.items():
        out = recorder.scratch / "settings.caustic"
        subprocess.run(["rm", "-rf", str(out)], check=True)
        with recorder.start(
            f"design flame.png {options} -o settings.caustic", stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        ) as process:
            while process.poll() is None and not (out / "project.toml").exists():
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            _, err = process.communicate()
        written = out / "project.toml"
        recorder.text(f"settings/{name}.toml", written.read_text() if written.exists() else err)


def record_designs(recorder: Recorder) -> None:
    for name, options in DESIGNS.items():
        project = recorder.scratch / f"{name}.caustic"
        for step, command in (
            ("new", f"design flame.png {SMALL} {options} -o {name}.caustic --json --quiet"),
            ("resumed", f"design --resume {name}.caustic --iterations 6 --json --quiet"),
        ):
            _, out, err = recorder.run(command)
            recorder.figures(f"designs/{name}-{step}", out, err)
            if (project / "project.toml").exists():
                recorder.text(f"designs/{name}-{step}.toml", (project / "project.toml").read_text())
            status, _, err = recorder.run(f"export {name}.caustic --format lighttools --samples 9 -o {name}.npz --force --quiet")
            if status:
                recorder.text(f"designs/{name}-{step}-export.txt", err)
                continue
            with np.load(recorder.scratch / f"{name}.npz") as archive:
                for key in sorted(k for k in archive.files if "control_points" in k or "heights" in k or k == "z"):
                    recorder.array(f"designs/{name}-{step}-{key}.npy", archive[key])


def record_images(recorder: Recorder) -> None:
    recorder.need_lens()
    for name, options in IMAGES.items():
        _, out, err = recorder.run(f"render rays.caustic {options} --rays 20000 --npy i.npy -o i.png --json --quiet --force")
        recorder.figures(f"images/{name}", out, err)
        for file in ("i.npy", "i-wave.npy"):
            if (path := recorder.scratch / file).exists():
                recorder.array(f"images/{name}-{file}", np.load(path))
                path.unlink()
    recorder.run("gradmap rays.caustic --control 7,8 --npy g.npy -o g.png --quiet --force")
    recorder.array("images/gradmap.npy", np.load(recorder.scratch / "g.npy"))


def record_refusals(recorder: Recorder) -> None:
    templates = set()
    for path in sorted((recorder.checkout / "caustic_cli").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
                templates.add(f"{ast.unparse(node.exc.func)}: {_template(node.exc.args[0])}")
    recorder.text("refusals/templates.txt", "\n".join(sorted(templates)) + "\n")
    recorder.need_lens()
    for k, command in enumerate(WRONG):
        status, out, err = recorder.run(command)
        recorder.text(f"refusals/{k:02d}.txt", f"{command}\n{status}\n{out}{err}")


def _template(node: ast.AST) -> str:
    """A message with ... in place of what is inserted."""
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "..." for part in node.values)
    return str(node.value) if isinstance(node, ast.Constant) else "..."


def record_help(recorder: Recorder) -> None:
    for command in ("", *COMMANDS):
        recorder.text(f"help/{command or 'caustic'}.txt", recorder.run(f"{command} --help")[1])
    for page in sorted((recorder.checkout / "man").iterdir()):
        recorder.text(f"help/{page.name}", page.read_text())


PARTS = {
    "settings": record_settings,
    "designs": record_designs,
    "images": record_images,
    "refusals": record_refusals,
    "help": record_help,
}


def record(folder: Path, checkout: Path, only: list[str]) -> None:
    """Record the parts of a checkout."""
    with tempfile.TemporaryDirectory() as scratch:
        recorder = Recorder(checkout.resolve(), Path(scratch), folder)
        for name, source in (("flame", "flame"), ("other", "ball"), ("ball", "ball"), ("tophat", "tophat")):
            (Path(scratch) / f"{name}.png").write_bytes((checkout / f"examples/{source}.png").read_bytes())
        (Path(scratch) / "errors.toml").write_text("[screen_shift]\nsigma = 0.1\n")
        for name in only:
            began = time.monotonic()
            PARTS[name](recorder)
            print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)


def differences(old: Path, new: Path, tolerance: float) -> Iterator[str]:
    """What differs between two recordings, a line or a few each."""
    names = {path.relative_to(folder) for folder in (old, new) for path in folder.rglob("*") if path.is_file()}
    for name in sorted(names):
        a, b = old / name, new / name
        if not (a.exists() and b.exists()):
            yield f"{name}: only in the {'old' if a.exists() else 'new'} recording"
        elif name.suffix == ".npy":
            x, y = np.load(a), np.load(b)
            if x.shape != y.shape:
                yield f"{name}: shape {x.shape} became {y.shape}"
            elif (off := float(np.abs(x - y).max()) / (float(np.abs(x).max()) or 1.0)) > tolerance:
                yield f"{name}: differs by {off:.2g} of its largest value"
        elif name.suffix == ".json":
            x, y = json.loads(a.read_text()), json.loads(b.read_text())
            for key in sorted(set(x) | set(y)):
                if key not in x or key not in y:
                    yield f"{name}: {key} is only in the {'old' if key in x else 'new'} one"
                elif abs(x[key] - y[key]) > tolerance * max(abs(x[key]), abs(y[key])):
                    yield f"{name}: {key} {x[key]:.12g} became {y[key]:.12g}"
        elif a.read_text() != b.read_text():
            lines = difflib.unified_diff(a.read_text().splitlines(), b.read_text().splitlines(), "old", "new", lineterm="", n=0)
            yield "\n    ".join([f"{name}:", *list(lines)[2:14]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    actions = parser.add_subparsers(dest="action", required=True)
    one = actions.add_parser("record")
    one.add_argument("folder", type=Path)
    one.add_argument("--checkout", type=Path, default=HERE)
    one.add_argument("--only", default=",".join(PARTS), help=f"of {', '.join(PARTS)}")
    two = actions.add_parser("show")
    two.add_argument("old", type=Path)
    two.add_argument("new", type=Path)
    two.add_argument("--tolerance", type=float, default=1e-12)
    options = parser.parse_args()
    if options.action == "record":
        record(options.folder, options.checkout, options.only.split(","))
        return
    found = list(differences(options.old, options.new, options.tolerance))
    print("\n".join(found) or "no differences")
    raise SystemExit(1 if found else 0)


if __name__ == "__main__":
    main()
