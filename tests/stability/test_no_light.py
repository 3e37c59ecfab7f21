"""Scenes without light: all rays reflected, all rays lost, dark targets; and the optimisation that ends up there."""

import json
import math
import shlex

import numpy as np
import pytest
import torch

from caustic_cli import cli
from caustic_cli.errors import CausticError
from caustic_cli.inverse import problem
from caustic_cli.inverse.designer import Designer
from caustic_cli.inverse.losses import LOSSES, Loss, NoLight
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.parametrisation import Parametrisation
from caustic_cli.inverse.problem import Options, Problem
from caustic_cli.inverse.schedule import LossImage, Stage
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import expose
from caustic_cli.project.checkpoint import load
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.studies.metrics import figures_of_merit

SCREEN = Screen((20.0, 20.0), 60.0, (12, 12))
TARGET = torch.ones(12, 12, dtype=torch.float64)


def scene(source=None, index: float = 1.5, screen: Screen = SCREEN) -> tuple[Scene, HeightField]:
    lens = Lens(size=(10.0, 10.0), control=(8, 8), index=index)
    return Scene(source or PlaneWave(), lens, screen), HeightField.of(lens)


def prism(field: HeightField, slope: float) -> torch.Tensor:
    x, _ = field.control_xy()
    return (20.0 + slope * x)[:, None].expand(field.shape).contiguous()


#: Why every ray is lost: source, slope of the surface, index, and the entry of the account that holds them.
LOST = {
    "reflected": (PlaneWave(), 1.5, 1.5, "total_internal_reflection"),
    "beside the screen": (PlaneWave(), 0.8, 1.5, "off_screen"),
    "missed lens": (Points(((50.0, 0.0, -1.0),), cone=1.0), 0.0, 1.5, "missed_lens"),
    "sides of the lens": (Points(((-40.0, 0.0, -1.0),)), 0.0, 1.01, "missed_surface"),
}


@pytest.mark.parametrize("why", LOST)
def test_all_rays_lost(why, kernels, dtype, compare):
    """A black image, an account that closes, figures without NaN; a loss that says so instead of 0 / 0."""
    source, slope, index, name = LOST[why]
    s, field = scene(source, index, Screen((1.0, 1.0), 60.0, (12, 12)) if why == "beside the screen" else SCREEN)
    rays = rays_of(s, "stratified", 600, 1)
    e = expose(s, field, prism(field, slope), rays, Filter("cosine", (3, 3)), dtype)
    assert not e.image.any()
    assert sum(e.lost.values()) == pytest.approx(1.0, abs=1e-6) and e.lost[name] > (1e-4 if name == "missed_surface" else 0.35)
    text = json.dumps(figures_of_merit(e, TARGET.numpy()), allow_nan=False)
    naive = float(((e.image / e.image.sum() - 1.0 / 144) ** 2).mean())
    compare("all rays lost", "the loss against 1", naive, abs(json.loads(text)["relative_rms"] - 1.0), 1e-12)
    objective = Objective(s, field, rays, TARGET, "rms-light", LossImage(Filter("cosine", (3, 3))), dtype=dtype)
    with pytest.raises(NoLight, match="no light reaches the screen"):
        objective(prism(field, slope))


#: Losses that have no value where no light is within the picture.
WITHIN = ("uniformity", "log-rms")


@pytest.mark.parametrize("name", LOSSES)
def test_losses_of_next_to_nothing(name, dtype):
    """One ray's light in a corner pixel, and 1e-30 of it: value and derivative finite, or a sentence."""
    checked = 0
    for light in (1.0, 1e-12, 1e-30):
        for dark in (torch.zeros(12, 12, dtype=torch.float64), TARGET * 1e-30):
            target = dark.clone()
            target[3, 4] = 1.0
            image = torch.zeros(12, 12, dtype=dtype)
            image[0, 0] = light
            image.requires_grad_()
            try:
                value = Loss(name, target.to(dtype), 0.0, 2)(image, image.sum())
            except NoLight:
                assert name in WITHIN
                continue
            (by,) = torch.autograd.grad(value, image)
            assert math.isfinite(float(value.detach())) and bool(torch.isfinite(by).all())
            checked += 1
    assert checked >= (0 if name in WITHIN else 5)


# an optimisation that meets a bad step


def small(optimizer: str, lr: float = 1e-3, network: str = "none", index: float = 1.5, size: float = 14.0) -> Designer:
    lens = Lens(size=(10.0, 10.0), control=(8, 8), index=index, offset=Offset(5.0), height_range=(-4.0, 4.0))
    g = torch.Generator().manual_seed(0)
    target = torch.rand(12, 12, generator=g, dtype=torch.float64) + 0.2
    preconditioner = "none" if optimizer == "adam" else "laplacian"
    options = Options("rms", optimizer, lr, Parametrisation(network, preconditioner=preconditioner))
    scene = Scene(PlaneWave(), lens, Screen((size, size), 60.0, (12, 12)))
    return Designer(Problem(scene, target, [Stage((8, 8), 900, "grid", iterations=12)], options))


class Holes(Objective):
    """An objective that has no value at some of its evaluations."""

    bad: tuple = ()
    how = "nan"

    def __call__(self, heights):
        self.calls = getattr(self, "calls", -1) + 1
        e = super().__call__(heights)
        if self.calls not in self.bad:
            return e
        if self.how == "dark":
            raise NoLight("no light reaches the screen")
        nan = torch.full_like(e.gradient, math.nan)
        by = {EXIT: nan}
        return type(e)(math.nan, by, 0.0, e.image) if self.how == "nan" else type(e)(e.loss, by, e.on_screen, e.image)


@pytest.mark.parametrize("how", ["nan", "gradient", "dark"])
@pytest.mark.parametrize("optimizer", ["adam", "lbfgs"])
def test_a_bad_step_is_taken_back(optimizer, how, monkeypatch):
    """Said once; the run goes on, every state handed out is finite, and the loss still falls."""
    monkeypatch.setattr(problem, "Objective", type("H", (Holes,), {"bad": (3, 4, 8), "how": how}))
    d, said, states = small(optimizer, 0.02), [], []
    state = d.run(d.initial_state(), iterations=12, notice=said.append, on_iteration=lambda s: states.append(s.heights.clone()))
    assert len(states) == 12 == len(state.history)
    assert len(said) == 1 and "was rejected" in said[0]
    assert all(bool(torch.isfinite(h).all()) for h in states)
    losses = [row[2] for row in state.history]
    assert all(map(math.isfinite, losses)) and losses[-1] < 0.95 * losses[0]


@pytest.mark.parametrize("network", ["none", "sparse"])
def test_adam_with_steps_far_too_long(network, compare):
    """A learning rate of 30 throws every ray off the screen at once: the steps are shortened, and light stays on it."""
    d, said = small("adam", 30.0, network, size=1.0), []
    state = d.run(d.initial_state(), iterations=8, notice=said.append)
    assert bool(torch.isfinite(state.heights).all())
    assert all(row[3] > 0 and math.isfinite(row[2]) for row in state.history)
    assert said, "this case no longer meets a bad step"
    naive = d.initial_state()
    heights = d.problem.parametrised(0, naive.heights if network == "none" else None)
    objective = d.objective(0, heights)
    adam = torch.optim.Adam(heights.parameters(), lr=30.0)
    worst = 0.0
    for _ in range(8):
        adam.zero_grad()
        z = heights()
        try:
            z.backward(objective(z.detach()).gradient)
        except CausticError:
            worst = math.inf
            break
        adam.step()
    compare("bad steps of an optimiser", "the loss", worst, state.history[-1][2] * 144, 20.0)


def test_where_nothing_begins_it_stops_with_a_sentence():
    for optimizer in ("adam", "lbfgs"):
        d = small(optimizer)
        state = d.initial_state()
        state.heights, state.parameters = prism(d.field(0), 0.79) - 15.0, {}
        d.scene = Scene(PlaneWave(), d.scene.lens, Screen((0.5, 0.5), 500.0, (12, 12)))
        with pytest.raises(CausticError, match="no light reaches the screen"):
            d.run(state, iterations=3)


# the command line


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("spot.npy", np.eye(12))
    return tmp_path


SMALL = "--resolution 12 --control 8 --rays 900 --quiet --threads 1 --linear"
IMPOSSIBLE = {
    "steep and far": "--start offset --mag 900 --throw 300",
    "tiny screen": "--start offset --mag 3 --screen-size 0.000031 --margin 0 --mag 0.001 --throw 1e6",
    "behind a wall": "--source point --source-position 1e6,0,-1 --cone 1 --start offset",
    "out of reach": "--mag 200 --throw 12",
}


@pytest.mark.parametrize("why", IMPOSSIBLE)
def test_an_impossible_design_stops_with_a_sentence(why, here, capfd):
    code = cli.run(shlex.split(f"design spot.npy {SMALL} {IMPOSSIBLE[why]} --iterations 3 -o out"))
    out, err = capfd.readouterr()
    assert code in (1, 2) and not out
    assert err.startswith("caustic: ") and err.count("\n") == 1 and "Traceback" not in err and "nan" not in err.lower().split()
    if (here / "out" / "checkpoints.h5").exists():
        assert bool(torch.isfinite(load(here / "out" / "checkpoints.h5").state.heights).all())


def test_a_design_from_a_sun_beside_nothing_keeps_its_account(here, capfd):
    """A finished project rendered under light that misses it: black image, figures without NaN, exit 0."""
    assert cli.run(shlex.split(f"design spot.npy {SMALL} --iterations 3 -o out")) == 0
    capfd.readouterr()
    for light in ("--source point --source-position 900,0,-1 --cone 2", "--source disc --source-position 0,900,-1 --cone 2"):
        code = cli.run(shlex.split(f"render out --rays 2000 --json --quiet --threads 1 {light}"))
        figures = json.loads(capfd.readouterr().out)
        assert code == 0 and figures["on_screen"] == 0.0 and figures["lost"]["missed_lens"] == pytest.approx(1.0)
    assert cli.run(shlex.split("gradmap out --rays 2000 --json --quiet --threads 1")) == 0
    json.loads(capfd.readouterr().out)


def test_one_ray(kernels, dtype):
    """A single ray of every kind of source, traced, reconstructed and differentiated."""
    checked = 0
    for source in (PlaneWave(), Points(((0.0, 0.0, -20.0),)), Disc((0.0, 0.0, -20.0)), Disc(angle=0.5)):
        s, field = scene(source)
        rays = Sampler("stratified", (1, 1)) if isinstance(source, PlaneWave) else rays_of(s, "stratified", 1)
        assert rays.count == 1
        heights = prism(field, 0.0)
        e = expose(s, field, heights, rays, Filter("cosine", (3, 3)), dtype)
        assert float(e.image.sum()) + sum(e.lost.values()) == pytest.approx(1.0, abs=1e-6)
        if float(e.image.sum()) > 0:
            found = Objective(s, field, rays, TARGET, "rms-light", LossImage(Filter("cosine", (3, 3))), dtype=dtype)(heights)
            assert math.isfinite(found.loss) and bool(torch.isfinite(found.gradient).all())
            checked += 1
    assert checked >= 2
