"""The loss over the heights of a lens: value, gradient, and the apron that pulls back light which has left the screen."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from caustic_cli.errors import CausticError
from caustic_cli.inverse import objective as module
from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.losses import Loss
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.penalties import Penalty
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Lens, Light, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.materials import refractive_index

pytestmark = pytest.mark.usefixtures("kernels")

LENS = Lens((10.0, 8.0), 0.0, 1.5, (7, 6), (3, 2), offset=Offset(3.0))
SCENE = Scene(PlaneWave(), LENS, Screen((11.0, 9.0), 60.0, (12, 9)))
FIELD = HeightField.of(LENS)
COSINE = Filter("cosine", (3, 3))


def heights(bumps: float = 0.1, seed: int = 0) -> torch.Tensor:
    return 3.0 + bumps * torch.randn(7, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def cut_into(monkeypatch, rays: int) -> None:
    """Chunks of so many rays."""
    for name in ("CHUNK", "CHUNK_OF_ROWS"):
        monkeypatch.setattr(module, name, rays)


def disc() -> torch.Tensor:
    """A bright disc off the centre of the screen."""
    i, j = torch.arange(12.0, dtype=torch.float64)[:, None], torch.arange(9.0, dtype=torch.float64)
    return ((i - 6.5) ** 2 + (j - 3.5) ** 2 < 9).double()


def objective(loss: str = "rms-light", *, scene: Scene = SCENE, f: Filter = COSINE, target=None, dtype=torch.float64, **how):
    sampler = Sampler("lines", (40, 36), 1)
    return Objective(scene, FIELD, sampler, disc() if target is None else target, loss, LossImage(f, **how), dtype=dtype)


@pytest.mark.parametrize("name", ["rms", "rms-light"])
@pytest.mark.parametrize("filter_target", [True, False])
def test_value_is_the_loss_of_the_exposed_image(name, filter_target):
    z = heights()
    exposure = expose(SCENE, FIELD, z, Sampler("lines", (40, 36), 1), COSINE)
    target = COSINE.smooth(disc()) if filter_target else disc()
    expected = Loss(name, target)(exposure.image, torch.tensor(exposure.leaving, dtype=torch.float64))
    evaluation = objective(name, filter_target=filter_target)(z)
    assert evaluation.loss == pytest.approx(float(expected), rel=1e-12)
    assert evaluation.on_screen == pytest.approx(float(exposure.image.sum()), rel=1e-12)
    assert evaluation.on_screen < 0.9  # some light has left: it matters which power divides


@pytest.mark.parametrize("name", ["rms", "rms-light"])
@pytest.mark.parametrize("options", [{}, {"blur": 1.5, "apron": 3}, {"apron": 2, "f": Filter("cosine", (5, 3))}], ids=str)
def test_gradient_is_finite_differences(name, options):
    """Central differences along random directions; the second derivative jumps at pixel edges, so they are right to O(h) only."""
    function, z = objective(name, **options), heights()
    gradient = function(z).gradient
    assert gradient.shape == z.shape
    for seed in range(4):
        v = torch.randn(z.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        h = 1e-6
        expected = (function(z + h * v).loss - function(z - h * v).loss) / (2 * h)
        assert float((gradient * v).sum()) == pytest.approx(expected, rel=1e-6, abs=1e-9)
        assert abs(expected) > 1e-5


def test_taylor_remainder_is_of_order_two():
    function, z = objective(apron=2, blur=1.0), heights()
    v = heights(1.0, 5) - 3.0
    here = function(z)
    slope = float((here.gradient * v).sum())
    steps = np.logspace(-6, -4, 8)
    rest = [abs(function(z + h * v).loss - here.loss - h * slope) for h in steps]
    assert np.polyfit(np.log(steps), np.log(rest), 1)[0] == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("name", ["rms", "rms-light"])
def test_float32_rays_give_the_same_slope(name):
    """Landing points are off by 1e-5 of a pixel, the shares' derivatives likewise; the gradient sums 1440 rays: 1e-4 relative."""
    double, single = objective(name)(heights()), objective(name, dtype=torch.float32)(heights())
    assert single.gradient.dtype == torch.float64
    assert single.loss == pytest.approx(double.loss, rel=1e-5)
    assert float((single.gradient - double.gradient).norm() / double.gradient.norm()) < 1e-4


def test_going_down_the_gradient_lowers_the_loss():
    function, z = objective(apron=2, blur=2.0), heights(0.0)
    losses = []
    for _ in range(15):
        here = function(z)
        losses.append(here.loss)
        z = z - 0.02 * here.gradient / here.gradient.norm()
    assert losses[-1] < 0.9 * losses[0]


def tilted(reach: float) -> torch.Tensor:
    """A prism that moves all light along +x by about `reach` mm."""
    x, _ = FIELD.control_xy()
    slope = reach / (57.0 * 0.5)
    return (3.0 + slope * x[:, None]).expand(7, 6).clone()


def test_the_apron_pulls_back_light_that_has_left_the_screen():
    """A prism throws the light of the lens' right half past the screen's edge and beyond its ghost pixels.

    Without an apron the lens' right edge has no gradient, and the plain loss goes on throwing light away (erratum E13);
    with one the same sixty steps bring light back.
    """
    scene = replace(SCENE, lens=replace(LENS, fresnel="none"))
    begin = tilted(5.0)
    changes = {}
    for apron in (0, 8):
        function, z = objective("rms", scene=scene, apron=apron, blur=2.0), begin
        first = function(z)
        assert 0.4 < first.on_screen < 0.6  # counted on the screen proper, the apron aside
        assert bool(first.gradient[-1].any()) == (apron > 0)
        for _ in range(60):
            gradient = function(z).gradient
            z = z - 0.01 * gradient / gradient.norm()
        changes[apron] = function(z).on_screen - first.on_screen
    assert changes[0] < -0.1
    assert changes[8] > 0.03


def test_with_all_light_on_the_apron_there_is_still_a_way_back():
    lens = replace(LENS, fresnel="none")
    scene = Scene(PlaneWave(), lens, Screen((11.0, 9.0), 60.0, (12, 9)))
    z = tilted(11.8)
    with pytest.raises(CausticError, match="no light reaches the screen"):
        objective(scene=scene)(z)
    seen = objective(scene=scene, apron=13, blur=6.0)(z)
    assert seen.on_screen == 0.0
    back = tilted(11.0) - z
    assert float((seen.gradient * back).sum()) < 0


def test_the_apron_is_dark_and_widens_the_frame():
    function = objective(apron=3, filter_target=False)
    assert function.loss.target.shape == (18, 15)
    assert torch.equal(function.loss.target[3:-3, 3:-3], disc() / disc().sum())
    assert float(function.loss.target.sum()) == pytest.approx(1.0, abs=1e-14)
    wide = expose(SCENE, FIELD, heights(), Sampler("lines", (40, 36), 1), COSINE, screen=SCENE.screen.grown((3, 3)))
    target = torch.nn.functional.pad(disc(), (3, 3, 3, 3))
    expected = Loss("rms-light", target)(wide.image, torch.tensor(wide.leaving, dtype=torch.float64))
    evaluation = function(heights())
    assert evaluation.loss == pytest.approx(float(expected), rel=1e-12)
    assert evaluation.on_screen == pytest.approx(objective()(heights()).on_screen, rel=1e-12)


@pytest.mark.parametrize("name", ["rms", "rms-light"])
@pytest.mark.parametrize("fresnel", ["none", "exact"])
@pytest.mark.parametrize("kept", [True, False])
def test_chunks_do_not_change_value_or_gradient(name, fresnel, kept, monkeypatch):
    """Many chunks are traced twice, one chunk once: the same sums in another order."""
    scene = replace(SCENE, lens=replace(LENS, fresnel=fresnel))
    whole = objective(name, scene=scene, apron=2)(heights())
    cut_into(monkeypatch, 300)
    for limit in ("KEPT_RAYS", "KEPT_OF_ROWS"):
        monkeypatch.setattr(module, limit, 10**6 if kept else 0)
    cut = objective(name, scene=scene, apron=2)(heights())
    assert cut.loss == pytest.approx(whole.loss, rel=1e-12)
    assert cut.on_screen == pytest.approx(whole.on_screen, rel=1e-12)
    torch.testing.assert_close(cut.gradient, whole.gradient, rtol=0, atol=1e-12 * float(whole.gradient.abs().max()))


@pytest.mark.parametrize("chunk", [300, 10**6])
def test_bins_without_fresnel_have_a_slope_of_zero(chunk, monkeypatch):
    """Moving a ray within its pixel changes nothing then: that is a gradient of 0, not an error."""
    cut_into(monkeypatch, chunk)
    scene = replace(SCENE, lens=replace(LENS, fresnel="none"))
    evaluation = objective(scene=scene, f=Filter())(heights())
    assert evaluation.loss > 1e-3
    assert evaluation.gradient.shape == (7, 6)
    assert not evaluation.gradient.any()
    assert objective(scene=scene)(heights()).gradient.any()


@pytest.mark.parametrize("fresnel", ["none", "exact"])
@pytest.mark.parametrize("kind", ["lines", "stratified"])
def test_three_wavelengths_keep_their_graphs(kind, fresnel, kernels):
    """In a glass that disperses; and the derivative by all heights is the weighted sum of those of each wavelength alone.

    By kernels the chunks of all three keep their graphs; plain torch would hold every ray after every stage, so it traces again.
    """
    lines, weights = (450.0, 550.0, 650.0), (1.0, 2.0, 1.0)
    lens = replace(LENS, glass="N-SF11", index=refractive_index("N-SF11"), fresnel=fresnel)
    scene = replace(SCENE, lens=lens, light=Light(wavelengths=lines, weights=weights))
    sampler, z, towards = Sampler(kind, (40, 36), 1), heights(), torch.randn(12, 9, dtype=torch.float64)
    assert [band.weight for band in scene.bands] == pytest.approx([0.25, 0.5, 0.25])
    assert len({band.scene.lens.index for band in scene.bands}) == 3
    made = Objective(scene, FIELD, sampler, disc(), "rms-light", LossImage(COSINE), dtype=torch.float64)
    assert made.keeps_graphs == (kernels == "fused") and len(made.kept) == 3

    class Linear(torch.nn.Module):
        """A loss whose derivative by the image is the same everywhere, so that those of wavelengths add up."""

        target = made.loss.target

        def forward(self, image, leaving, penalty, entering):
            return (image * towards).sum() + 3.0 * leaving + penalty

    def gradient(of: Scene) -> torch.Tensor:
        one = Objective(of, FIELD, sampler, disc(), "rms-light", LossImage(COSINE), dtype=torch.float64)
        assert one.keeps_graphs
        one.loss = Linear()
        return one(z).gradient

    apart = sum(band.weight * gradient(band.scene) for band in scene.bands)
    value = made(z)
    along = torch.randn(z.shape, dtype=torch.float64)
    difference = (made(z + 1e-6 * along).loss - made(z - 1e-6 * along).loss) / 2e-6
    assert float((value.gradient * along).sum()) == pytest.approx(difference, rel=1e-6)
    made.loss = Linear()
    torch.testing.assert_close(made(z).gradient, apart, rtol=0, atol=1e-13 * float(apart.abs().max()))


def test_heights_are_left_alone():
    z = heights()
    before = z.clone()
    first, second = objective()(z), objective()(z)
    assert torch.equal(z, before)
    assert not z.requires_grad
    assert not first.gradient.requires_grad
    assert first.loss == second.loss
    assert torch.equal(first.gradient, second.gradient)
    assert math.isfinite(first.loss)


@pytest.mark.parametrize(
    "loss, max_slope", [("rms-light + 1e-3 laplacian", 0.0), ("rms + 0.01 curvature + 0.3 throughput", 0.0), ("rms-light", 0.02)]
)
@pytest.mark.parametrize("chunks", [1, 3])
def test_penalties_have_the_slope_of_differences(loss, max_slope, chunks, monkeypatch):
    lens = Lens(control=(8, 7), degree=(3, 2), offset=Offset(5.0, (80.0, 80.0)))
    scene, field = Scene(PlaneWave(), lens, Screen((36.0, 36.0), resolution=(18, 15))), HeightField.of(lens)
    x, y = field.control_xy()
    g = torch.Generator().manual_seed(3)
    heights = 5.0 + (x[:, None] ** 2 + y**2) / 160 + 0.01 * torch.randn(8, 7, generator=g, dtype=torch.float64)
    along = torch.randn(8, 7, generator=g, dtype=torch.float64)
    sampler = Sampler("grid", (90, 90))
    if chunks > 1:
        cut_into(monkeypatch, 3000)
    target = torch.rand(18, 15, generator=g, dtype=torch.float64)
    function = Objective(
        scene,
        field,
        sampler,
        target,
        loss,
        LossImage(Filter("cosine", (5, 5)), apron=3),
        limits=Limits(max_slope=max_slope),
        dtype=torch.float64,
    )
    step = 1e-6
    difference = (function(heights + step * along).loss - function(heights - step * along).loss) / (2 * step)
    e = function(heights)
    assert float((e.gradient * along).sum()) == pytest.approx(difference, rel=1e-5)
    plain = Objective(
        scene, field, sampler, target, loss.split(" ")[0], LossImage(Filter("cosine", (5, 5)), apron=3), dtype=torch.float64
    )
    assert e.loss > plain(heights).loss


def test_the_offset_itself_costs_nothing():
    lens = Lens(control=(8, 7), degree=(3, 2), offset=Offset(5.0, (80.0, 80.0)))
    scene, field = Scene(PlaneWave(), lens, Screen((36.0, 36.0))), HeightField.of(lens)
    penalty = Penalty(scene, field, [(1.0, "laplacian"), (1.0, "curvature")])
    x, y = (c.numpy() for c in field.control_xy())
    base = torch.from_numpy(lens.offset.thickness + lens.offset.sag(x[:, None], y[None, :]))
    assert float(penalty(base)) == 0.0
    gain = (lens.index - 1.0) * 295.0
    bump = base + 1e-4 * torch.from_numpy(x[:, None] ** 2 + 0 * y[None, :])  # not quite a parabola: its net's heights are
    assert float(penalty(bump)) == pytest.approx(2 * (gain * 2e-4) ** 2, rel=0.2)


@pytest.mark.parametrize("chunks", [1, 3])
def test_oversampling_adds_up_smaller_pixels(chunks, monkeypatch):
    lens = Lens(control=(8, 7), degree=(3, 2), offset=Offset(5.0, (80.0, 80.0)))
    scene, field = Scene(PlaneWave(), lens, Screen((36.0, 36.0), resolution=(18, 15))), HeightField.of(lens)
    x, y = field.control_xy()
    g = torch.Generator().manual_seed(3)
    heights = 5.0 + (x[:, None] ** 2 + y**2) / 160 + 0.01 * torch.randn(8, 7, generator=g, dtype=torch.float64)
    along, target = torch.randn(8, 7, generator=g, dtype=torch.float64), torch.rand(18, 15, generator=g, dtype=torch.float64)
    if chunks > 1:
        cut_into(monkeypatch, 3000)
    sampler = Sampler("grid", (90, 90))
    function = Objective(
        scene,
        field,
        sampler,
        target,
        "rms-light",
        LossImage(Filter("cosine", (3, 3)), apron=2, oversample=3, filter_target=False),
        dtype=torch.float64,
    )
    fine = replace(scene.screen.grown((2, 2)), resolution=(66, 57))
    image = expose(scene, field, heights, sampler, Filter("cosine", (3, 3)), screen=fine).image
    pooled = sum(image[a::3, b::3] for a in range(3) for b in range(3))
    wide = torch.nn.functional.pad(target, (2, 2, 2, 2))
    leaving = torch.tensor(expose(scene, field, heights, sampler).leaving, dtype=torch.float64)
    e = function(heights)
    assert e.loss == pytest.approx(float(Loss("rms-light", wide)(pooled, leaving)), rel=1e-12)
    step = 1e-6
    difference = (function(heights + step * along).loss - function(heights - step * along).loss) / (2 * step)
    assert float((e.gradient * along).sum()) == pytest.approx(difference, rel=1e-5)
