"""The torch core designs a lens alone, without kernels, optional capabilities, files or the command line.

It is scene, system, surfaces, trace, reconstruction, losses, parametrisation and stage loop; the code's README names its files in
reading order.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "caustic_cli"
#: Of a bright ring, from the offset surface, at two scales; prints the losses and the modules that were loaded.
DESIGN = """
import sys
import torch
from caustic_cli.inverse.designer import Designer
from caustic_cli.inverse.problem import Options, Problem
from caustic_cli.inverse.schedule import LossImage, Stage
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen

screen = Screen((30.0, 30.0), 300.0, (24, 24))
x, y = torch.meshgrid(*[torch.linspace(-1.0, 1.0, 24, dtype=torch.float64)] * 2, indexing="ij")
picture = torch.exp(-(((x * x + y * y).sqrt() - 0.5) / 0.15) ** 2)
lens = Lens((10.0, 10.0), control=(12, 12), offset=Offset.for_magnification((2.5, 2.5), 1.5, 300.0, 5.0))
stages = [Stage((12, 12), 10_000, rendering=LossImage(blur=blur, apron=2), iterations=15) for blur in (2.0, 0.0)]
designer = Designer(Problem(Scene(PlaneWave(), lens, screen), picture, stages, Options()))
losses = [row[2] for row in designer.run(designer.initial_state()).history]
print(losses[0], losses[-1], *(name for name in sys.modules if name.startswith("caustic_cli") or name == "numba"))
"""
#: Modules of the core beside those of scene and optics: of the table of settings, the inverse problem, and messages.
INVERSE = {"constraints", "designer", "lbfgs", "loss_terms", "losses", "objective", "optimisers", "parametrisation", "penalties"}
INVERSE |= {"problem", "schedule"}
#: Rooms of scene and optics that are optional.
OPTIONAL = ("kernels", "gradient", "waves", "mesh", "misalignment", "obstruction", "reintersection", "bounds", "plan", "spread")


@pytest.fixture(scope="module")
def loaded():
    """First and last loss, and names of the modules."""
    done = subprocess.run(
        [sys.executable, "-c", DESIGN], check=True, capture_output=True, text=True, env=os.environ | {"CAUSTIC_KERNELS": "torch"}
    )
    first, last, *names = done.stdout.split()
    return float(first), float(last), {name.partition(".")[2] for name in names}


def test_the_core_alone_designs_a_lens(loaded):
    first, last, _ = loaded
    assert last < 0.3 * first


def test_the_core_loads_nothing_else(loaded):
    names = loaded[2]
    rooms = {name.partition(".")[0] for name in names} - {""}
    assert rooms == {"effort", "errors", "inverse", "loading", "optics", "scene", "schema"}
    assert {name.partition(".")[2] for name in names if name.startswith("inverse.")} == INVERSE
    assert not [name for name in names if name.startswith(tuple(f"optics.{room}" for room in OPTIONAL))]
    assert [name for name in names if name.startswith("optics.effects.")] == ["optics.effects.base"]


def test_the_readme_names_its_files(loaded):
    """Every file in which something is written, once, and no other."""
    text = (PACKAGE / "README.md").read_text("utf-8").partition("## The core in reading order")[2].partition("\n## ")[0]
    paths = [name.replace(".", "/") for name in loaded[2] if name]
    named = [name for name in re.findall(r"`([a-z_/]+)\.py`", text) if not name.startswith("tests/")]
    assert sorted(named) == sorted(name for name in paths if (PACKAGE / f"{name}.py").is_file())
