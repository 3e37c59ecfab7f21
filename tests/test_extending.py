"""What it takes to add a filter, an export format, an effect, a surface, a source or a kind of design: done on a copy.

    python tests/test_extending.py      prints the table of files that each addition touches

Each addition is made to a copy of the package, as new files and as lines put into others, and then used.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
from dataclasses import dataclass, field
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "caustic_cli"


@dataclass(frozen=True)
class Addition:
    """What is added: most, of files that it may touch; new, files by name; edits, (file, line that is there, what takes its place);
    used, a program that uses it and fails if it does not work."""

    most: int
    used: str
    new: dict[str, str] = field(default_factory=dict)
    edits: tuple[tuple[str, str, str], ...] = ()

    @property
    def touched(self) -> list[str]:
        """Files of the package that it adds or changes."""
        return sorted({*self.new, *(name for name, _, _ in self.edits)})

    def make(self, package: Path) -> None:
        """Make it in a copy of the package."""
        for name, text in self.new.items():
            assert not (package / name).exists(), name
            (package / name).write_text(textwrap.dedent(text))
        for name, there, instead in self.edits:
            text = (package / name).read_text()
            assert text.count(there) == 1, (name, there)
            (package / name).write_text(text.replace(there, instead))


FILTER = Addition(
    3,
    edits=(
        ("optics/reconstruction.py", 'FILTERS = ("bincount",', 'FILTERS = ("tent", "bincount",'),
        (
            "optics/reconstruction.py",
            "        return self._gaussian(d, v, self.alpha[axis])",
            '        if self.kind == "tent":\n'
            "            f = (0.5 * v - d.abs()).clamp_min(0.0)\n"
            "            return f / f.sum(-1, keepdim=True)\n"
            "        return self._gaussian(d, v, self.alpha[axis])",
        ),
        (
            "optics/kernels/filter_weights.py",
            "BINCOUNT, GAUSSIAN, COSINE = 0, 1, 2",
            "BINCOUNT, GAUSSIAN, COSINE, TENT = 0, 1, 2, 3",
        ),
        ("optics/kernels/filter_weights.py", 'KINDS = {"bincount": BINCOUNT,', 'KINDS = {"tent": TENT, "bincount": BINCOUNT,'),
        (
            "optics/kernels/filter_weights.py",
            "    if alpha * square < SMALL:\n        for k in range(v):\n            offset",
            textwrap.dedent("""\
         if kind == TENT:
             for k in range(v):
                 for j in range(len(phi)):
                     d = k - (v - 1) // 2 + 0.5 - phi[j]
                     out[k, j] = max(0.5 * v - abs(d), 0.0)
                     if len(slope):
                         slope[k, j] = math.copysign(1.0, d) if abs(d) < 0.5 * v else 0.0
         elif alpha * square < SMALL:
             for k in range(v):
                 offset""")
            .replace("\n", "\n    ")
            .join(["    ", ""]),
        ),
    ),
    used="""
    import torch
    from caustic_cli.optics.backends import backend_for, plain
    from caustic_cli.optics.reconstruction import Filter
    from caustic_cli.scene import Screen
    at = 10 * torch.rand(2, 500, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 5
    screen, found = Screen((8.0, 8.0), 10.0, (16, 16)), []
    by = torch.linspace(-1, 1, 256, dtype=torch.float64).view(16, 16)
    for backend in (backend_for("cpu"), plain):
        x, y = (c.clone().requires_grad_() for c in at)
        if backend is plain:
            with plain():
                backend = backend_for("cpu")
        image, off = backend.splat(x, y, torch.full_like(x, 1 / 500), screen, Filter("tent", (3, 5)))
        assert abs(float(image.sum() + off) - 1) < 1e-12
        found.append((image.detach(), *torch.autograd.grad((image * by).sum(), (x, y))))
    assert all(float((a - b).abs().max()) < 1e-12 and float(a.abs().max()) > 1e-4 for a, b in zip(*found))
""",
)

EXPORT = Addition(
    2,
    new={
        "export/sag.py": '''
    """The sag of the exit as text, a row a line."""

    from __future__ import annotations

    from caustic_cli.io.files import write_bytes


    def write_sag(path, scene, field, heights, samples=None):
        """Control heights, mm."""
        write_bytes(path, "\\n".join(" ".join(f"{z:.9g}" for z in row) for row in heights.tolist()).encode())
'''
    },
    edits=(("export/__init__.py", '    "zemax": (', '    "sag": (".txt", "sag", "control heights as text"),\n    "zemax": ('),),
    used="""
    import os, subprocess, sys
    from pathlib import Path
    import numpy as np
    np.save("picture.npy", np.ones((8, 8)))
    run = lambda *a: subprocess.run([sys.executable, "-m", "caustic_cli", *a, "--quiet"], check=True)
    run("design", "picture.npy", "--resolution", "8", "--control", "6", "--start", "offset", "--rays", "100", "--iterations", "1")
    run("export", "picture.caustic", "--format", "sag")
    assert np.loadtxt("picture.txt").ndim == 2
""",
)

EFFECT = Addition(
    2,
    new={
        "optics/effects/dust.py": '''
    """Dust on every refracting surface, which stops a part of the light."""

    from __future__ import annotations

    from caustic_cli.optics.effects.base import NO_REQUESTS, Action, Effect, Requests, Decision

    COVERED = 0.05


    class Dust(Effect):
        """Simulated on request only."""

        name = "dust"

        def decide(self, scene, bounds):
            """Never by itself."""
            return Decision(self.name, False, "surfaces are taken to be clean")

        def request(self, scene, on, bounds):
            """To simulate it."""
            return Requests.to(self.name) if on else NO_REQUESTS

        def action(self, system, requests):
            """At every surface."""
            return Covered() if self.name in requests.on else None


    class Covered(Action):
        """Absorbs a fraction of the light."""

        def before_interaction(self, interaction):
            """Before the surface."""
            interaction.state.lose("absorbed", (COVERED * interaction.state.power).detach())
            interaction.state.power = (1.0 - COVERED) * interaction.state.power
'''
    },
    edits=(("optics/effects/__init__.py", '        "source-size",\n', '        "source-size",\n        "dust",\n'),),
    used="""
    import torch
    from caustic_cli.optics.emission import rays_of
    from caustic_cli.optics.plan import compile_plan, parse_effects
    from caustic_cli.optics.surfaces import HeightField
    from caustic_cli.optics.trace import expose
    from caustic_cli.scene import Lens, PlaneWave, Scene, Screen
    scene = Scene(PlaneWave(), Lens(control=(6, 6), fresnel="none"), Screen((30.0, 30.0), 60.0, (8, 8)))
    field, heights = HeightField.of(scene.lens), torch.full((6, 6), 5.0, dtype=torch.float64)
    for wanted, left in ((None, 1.0), (parse_effects("dust"), 0.95**2)):
        plan = compile_plan(scene, field, heights, wanted)
        image = expose(plan.scene, field, heights, rays_of(scene, "grid", 100), requests=plan.requests)
        assert abs(float(image.image.sum()) - left) < 1e-12 and abs(image.lost["absorbed"] - (1 - left)) < 1e-12
        assert plan["dust"].on == (wanted is not None)
""",
)

SURFACE = Addition(
    3,
    new={
        "optics/surfaces/paraboloid.py": '''
    """A paraboloid of revolution, z = (x^2 + y^2) / (2 R)."""

    from __future__ import annotations

    from dataclasses import dataclass

    import torch
    from torch import Tensor

    from caustic_cli.optics.surfaces.base import FIRST, Surface


    @dataclass(frozen=True)
    class Paraboloid(Surface):
        """Of vertex radius R, over a square of half width `half`, mm."""

        radius: float
        half: float

        @property
        def half_size(self):
            """Of the square."""
            return self.half, self.half

        def at(self, heights: None, x: Tensor, y: Tensor, orders=FIRST) -> list[Tensor]:
            """Up to the second derivatives."""
            bent = torch.ones_like(x) / self.radius
            known = {(0, 0): (x * x + y * y) / (2 * self.radius), (1, 0): bent * x, (0, 1): bent * y, (2, 0): bent, (1, 1): 0 * x,
                     (0, 2): bent}
            return [known[order] for order in orders]

        def hull(self, heights: None) -> tuple[float, float]:
            """Vertex and corners."""
            return tuple(sorted((0.0, self.half**2 / self.radius)))

        def slope_bounds(self, heights: None) -> tuple[float, float]:
            """At the edges."""
            return (self.half / abs(self.radius),) * 2
'''
    },
    edits=(
        (
            "optics/surfaces/__init__.py",
            "from caustic_cli.optics.surfaces.plane import Plane\n",
            "from caustic_cli.optics.surfaces.paraboloid import Paraboloid\nfrom caustic_cli.optics.surfaces.plane import Plane\n",
        ),
        ("optics/surfaces/__init__.py", '"HeightField", "Plane"', '"HeightField", "Paraboloid", "Plane"'),
    ),
    used="""
    import torch
    from caustic_cli.optics.frames import Pose
    from caustic_cli.optics.sampling import Sampler
    from caustic_cli.optics.surfaces import Paraboloid
    from caustic_cli.optics.system import Element, System
    from caustic_cli.optics.trace import Tracer
    from caustic_cli.scene import Aperture, PlaneWave, Screen
    mirror = Element("mirror", Paraboloid(-80.0, 6.0), Aperture((6.0, 6.0)), "reflect", pose=Pose((0.0, 0.0, 50.0)))
    system = System((PlaneWave(),), (mirror,), (Screen((4.0, 4.0), 10.0, (8, 8)),))
    (sample,) = Sampler("grid", (20, 20)).chunks()
    (rays,) = Tracer(system, sample).land({}, system.screens[0])
    assert float(torch.hypot(*rays.origin[:2]).max()) < 1e-10 and abs(float(rays.power.sum()) - 1) < 1e-12
""",
)

SOURCE = Addition(
    3,
    new={
        "scene/sources/spokes.py": '''\
"""Points on a circle, as many as [source] spokes says."""
from dataclasses import dataclass
import numpy as np
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.section import SourceType

@dataclass(frozen=True)
class Spokes(Source):
    count: int
    power: float
    kind = "spokes"

    def points(self):
        turn = 2.0 * np.pi * np.arange(self.count) / self.count
        return np.stack([np.cos(turn), np.sin(turn), 0.0 * turn - 20.0], -1), np.full(self.count, 1.0 / self.count)

TYPES = (SourceType("spokes", "spokes", ("spokes",), lambda table, profile: Spokes(table["spokes"], table["power"]),
                    lambda lens: {"spokes": 5}, own={"spokes": ("whole", "how many")}),)
''',
        "optics/emission/spokes.py": '''\
"""The rays of spokes."""
from caustic_cli.optics.emission.near import Near

EMISSIONS = {"spokes": Near.of_size}
''',
    },
    used="""
import torch
from caustic_cli.config import settings
from caustic_cli.project.completion import complete
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose

full = complete(settings.parse('[source]\\ntype = "spokes"\\nspokes = 7\\n[lens]\\ncontrol = [8, 8]', "here"), 1.0)
again = settings.parse(settings.dump(full), "there")
scene = settings.build_scene(settings.Settings.of(again))
rays = rays_of(scene, "stratified", 6300)
exposure = expose(scene, HeightField.of(scene.lens), torch.full((8, 8), 5.0, dtype=torch.float64), rays)
assert abs(float(exposure.image.sum()) + sum(exposure.lost.values()) - 1.0) < 1e-12
assert (scene.source.kind, len(scene.source.powers), rays.count, again["source"]["spokes"]) == ("spokes", 7, 6300, 7)
""",
)

KIND = Addition(
    3,
    new={
        "kinds/two_throws.py": '''
    """A lens that shows its picture at two distances of the screen: the loss is the mean over both."""

    from __future__ import annotations

    from dataclasses import replace

    from caustic_cli.inverse.mixture import Member, Mixture
    from caustic_cli.kinds.surface import OneSurface


    class TwoThrows(OneSurface):
        """farther: z of the other screen, mm."""

        one_scene = False

        def __init__(self, *args, farther, **more):
            self.farther = farther
            super().__init__(*args, **more)

        @classmethod
        def applies(cls, s):
            return s.design.farther > 0

        @classmethod
        def further(cls, described, scene):
            return {"farther": described.settings.design.farther}

        @property
        def scenes(self):
            """With either screen."""
            return [self.scene, replace(self.scene, screen=replace(self.scene.screen, z=self.farther))]

        def objective(self, k, begun):
            """Half of the mean square each."""
            return Mixture([Member(self.objective_in(scene, k, begun), 0.5, 0.5, 0.5) for scene in self.scenes], 2.0)

        def further_figures(self, designer, state):
            """The error on the other screen."""
            there = OneSurface(self.scenes[1], self.target, self.stages, self.options)
            return {"error_farther": there.errors(designer, state, 10_000, 0)[0]["relative_rms"]}
'''
    },
    edits=(
        (
            "kinds/__init__.py",
            "KINDS = (\n",
            'KINDS = (\n    ("design.farther", "two_throws.TwoThrows"),\n',
        ),
        (
            "schema/table.py",
            "    over: str = setting(",
            '    farther: float = setting("z of another screen with the same picture", "mm", 0.0, default=0.0, written=False)\n'
            "    over: str = setting(",
        ),
    ),
    used="""
    from pathlib import Path
    import numpy as np
    from caustic_cli import cli
    from caustic_cli.kinds import problem_of
    from caustic_cli.project.project import Project
    np.save("picture.npy", np.outer(np.arange(1.0, 9.0), np.ones(8)))
    Path("two.toml").write_text("[design]\\nfarther = 400.0")
    small = ("--resolution", "8", "--control", "6", "--start", "offset", "--rays", "200", "--iterations", "3", "--waves", "off")
    assert cli.run(["design", "picture.npy", "--config", "two.toml", *small, "--quiet"]) == 0
    assert cli.run(["design", "--resume", "picture.caustic", "--iterations", "5", "--quiet"]) == 0
    project = Project.open("picture.caustic")
    figures = project.load().results
    assert figures["iterations"] == 5 and figures["error_farther"] != figures["relative_rms"]
    mean = problem_of(project).objective(0, None)
    assert [m.objective.scene.screen.z for m in mean.members] == [300.0, 400.0]
""",
)

ADDITIONS = {
    "a reconstruction filter": FILTER,
    "an export format": EXPORT,
    "an effect": EFFECT,
    "a surface": SURFACE,
    "a source": SOURCE,
    "a kind of design": KIND,
}


@pytest.mark.parametrize("what", ADDITIONS)
def test_an_addition_touches_few_files(what, tmp_path):
    """It works, through the program's own doors, and no other file knows of it."""
    addition = ADDITIONS[what]
    assert len(addition.touched) <= addition.most
    shutil.copytree(PACKAGE, tmp_path / "caustic_cli", ignore=shutil.ignore_patterns("__pycache__"))
    addition.make(tmp_path / "caustic_cli")
    # Plain torch but for the filter, which has a kernel: the others need none compiled.
    kernels = {} if addition is FILTER else {"CAUSTIC_KERNELS": "torch"}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(addition.used)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **kernels, "PYTHONPATH": str(tmp_path)},
    )
    assert done.returncode == 0, done.stderr


def table() -> str:
    """Every addition, the number of files and which, as Markdown."""
    rows = [f"| {what} | {len(a.touched)} | {', '.join(a.touched)} |" for what, a in ADDITIONS.items()]
    return "\n".join(["| what is added | files | which |", "| --- | --- | --- |", *rows])


if __name__ == "__main__":
    print(table())
