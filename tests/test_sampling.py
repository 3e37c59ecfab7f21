"""Where rays start: inside the aperture, one to a cell, the same however they are cut, and without structure."""

import numpy as np
import pytest
import torch
from helpers import looked_up_in
from scipy import stats

from caustic_cli.errors import InputError
from caustic_cli.optics.sampling import SAMPLERS, Sampler, random_numbers, stream

SEEDS = (*range(16), 123456, 2**31, 2**32 - 1, 2**32, 2**40 + 5)
RAYS = 1 << 14


def points(sampler: Sampler, size: int = 1 << 20) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Every ray's u, v and flux as flat tensors, in order."""
    u, v, flux = [], [], []
    for s in sampler.chunks(size):
        a, b = (s.u[:, None], s.v[None, :]) if s.tensor else (s.u, s.v)
        for out, value in ((u, a), (v, b), (flux, s.flux)):
            out.append(torch.broadcast_to(value, s.shape).reshape(-1))
    return torch.cat(u), torch.cat(v), torch.cat(flux)


@pytest.mark.usefixtures("kernels")
@pytest.mark.parametrize("kind", SAMPLERS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (13, 1), (37, 41), (64, 3)])
def test_rays_start_strictly_inside_the_aperture(kind, shape):
    for seed in (0, 1, 2**32 - 1, 2**50):
        sampler = Sampler(kind, shape, seed)
        u, v, flux = points(sampler)
        assert len(u) == len(v) == len(flux) == sampler.count == shape[0] * shape[1]
        for at in (u, v):
            assert at.dtype == torch.float64
            assert float(at.min()) > 0
            assert float(at.max()) < 1
        assert float(flux.sum()) == pytest.approx(1.0, abs=1e-12)


def test_random_numbers_are_odd_multiples_of_two_to_the_minus_33():
    """The middles of 2^32 intervals, so that 0 and 1 cannot come up however many are drawn."""
    numbers = torch.cat([random_numbers(seed, 0, torch.arange(1000) + (seed << 30)) for seed in SEEDS[:8]])
    assert bool((numbers * 2.0**33 % 2 == 1).all())
    assert float(numbers.min()) > 0
    assert float(numbers.max()) < 1


def test_grid_is_the_cell_centres():
    """To a unit in the last place of float64: a mirrored lens must see mirrored rays."""
    u, v, _ = points(Sampler("grid", (30, 7)))
    np.testing.assert_allclose(u.view(30, 7)[:, 0], (np.arange(30) + 0.5) / 30, rtol=3e-16)
    np.testing.assert_allclose(v.view(30, 7)[0], (np.arange(7) + 0.5) / 7, rtol=3e-16)


@pytest.mark.usefixtures("kernels")
@pytest.mark.parametrize("kind", ["grid", "lines", "stratified"])
def test_one_ray_in_every_cell(kind):
    nu, nv = 41, 29
    for seed in range(20):
        u, v, _ = points(Sampler(kind, (nu, nv), seed))
        cell = (u * nu).floor().long() * nv + (v * nv).floor().long()
        assert torch.equal(cell, torch.arange(nu * nv))  # in order, too: u slowest


@pytest.mark.parametrize("kind", ["grid", "lines"])
def test_lines_are_a_tensor_grid(kind):
    for s in Sampler(kind, (12, 9), 3).chunks(20):
        assert s.tensor
        assert s.shape == (len(s.u), 9)
    offsets = points(Sampler(kind, (12, 9), 3))[0] * 12 % 1
    assert (offsets.std() > 0.1) == (kind == "lines")


@pytest.mark.usefixtures("kernels")
@pytest.mark.parametrize("kind", SAMPLERS)
@pytest.mark.parametrize("size", [20, 30, 100, 10**6])
def test_chunks_do_not_change_the_rays(kind, size):
    """Positions bitwise; shares, too, but for a profile's, whose norm is a sum over chunks: one rounding for each, 1e-13."""
    for p in (None, looked_up_in(torch.rand(5, 3, dtype=torch.float64))):
        sampler = Sampler(kind, (17, 29), 11, p)
        whole, cut = points(sampler), points(sampler, size)
        assert torch.equal(whole[0], cut[0])
        assert torch.equal(whole[1], cut[1])
        torch.testing.assert_close(cut[2], whole[2], rtol=1e-13 if p is not None else 0, atol=0)
    largest = max(s.shape[0] * s.shape[1] if s.tensor else s.shape[0] for s in sampler.chunks(size))
    assert largest <= max(size, 29)  # a row of a tensor grid is never cut


@pytest.mark.usefixtures("kernels")
@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1, 2**40 + 5])
def test_samples_are_the_random_numbers_of_their_rays(seed):
    """Bitwise, whoever computes them; dimension 0 along u, 1 along v."""
    nu, nv, k = 31, 29, torch.arange(31 * 29)
    du, dv = random_numbers(seed, 0, k), random_numbers(seed, 1, k)
    u, v, _ = points(Sampler("uniform", (nu, nv), seed), 100)
    assert torch.equal(u, du)
    assert torch.equal(v, dv)
    u, v, _ = points(Sampler("stratified", (nu, nv), seed), 100)
    assert torch.equal(u, (k // nv + du) / nu)
    assert torch.equal(v, (k % nv + dv) / nv)
    u, v, _ = points(Sampler("lines", (nu, nv), seed), 100)
    assert torch.equal(u, (k // nv + du[k // nv]) / nu)
    assert torch.equal(v, (k % nv + dv[k % nv]) / nv)


def test_any_ray_can_be_drawn_again_alone():
    index = torch.tensor([0, 5, 1000, 2**31, 2**32, 2**32 + 5, 2**40])
    together = random_numbers(3, 1, index)
    alone = torch.cat([random_numbers(3, 1, k[None]) for k in index])
    assert torch.equal(together, alone)
    assert len(set(together.tolist())) == len(index)  # the upper 32 bits of an index count


def test_seeds_are_reproducible_and_matter():
    for kind in ("lines", "stratified", "uniform"):
        a, b, c = (points(Sampler(kind, (20, 20), seed))[0] for seed in (4, 4, 5))
        assert torch.equal(a, b)
        assert not torch.isclose(a, c, rtol=0, atol=1e-9).any()
    names = {stream(seed, name) for seed in range(50) for name in ("render", "stage 1", "stage 2")}
    assert len(names) == 150


def chi_square(*samples: np.ndarray, bins: int) -> float:
    """p-value of equal probability of all cells of a bins^d partition of the unit cube."""
    counts = np.histogramdd(np.stack(samples, 1), bins, [(0, 1)] * len(samples))[0]
    expected = counts.sum() / counts.size
    assert expected >= 4  # below it the chi-square distribution is no good approximation
    return float(stats.chi2.sf(((counts - expected) ** 2 / expected).sum(), counts.size - 1))


def lattice_strength(a: np.ndarray, b: np.ndarray, order: int = 12) -> float:
    """Largest |mean exp(2 pi i (k a + l b))|^2 N over 0 < |(k, l)| <= order: about log(300) = 6 for noise, N for a lattice."""

    def waves(values):
        up = np.cumprod(np.broadcast_to(np.exp(2j * np.pi * values), (order, len(values))), axis=0)  # of 1, 2 ... order periods
        return np.concatenate([up[::-1].conj(), np.ones((1, len(values))), up])

    spectrum = waves(a) @ waves(b).T
    power = np.abs(spectrum) ** 2 / len(a)
    power[order, order] = 0.0
    return float(power.max())


def test_random_numbers_are_uniform_in_one_and_two_dimensions():
    """Chi-square over values, (u, v) pairs, neighbours, strides, and the same ray under consecutive seeds.

    None may be smaller than 0.01 / how many, and all together must look uniform themselves (Kolmogorov-Smirnov; the tests
    flux numbers, so not to better than 1e-3).
    """
    p, k = [], torch.arange(RAYS)
    for seed in SEEDS:
        u, v = random_numbers(seed, 0, k).numpy(), random_numbers(seed, 1, k).numpy()
        after = random_numbers(seed + 1, 0, k).numpy()
        p += [chi_square(u, bins=256), chi_square(v, bins=256)]
        for a, b in ((u, v), (u, after), (u[:-1], u[1:]), (u[:-2], u[2:]), (u[::2], u[1::2])):
            p += [chi_square(a, b, bins=8), chi_square(a, b, bins=32)]
        p.append(chi_square(u, v, after, bins=12))
        for stride in (2, 256, 1000, 1 << 20, 1 << 32):  # a column of a stratified sample takes every nv-th number
            p.append(chi_square(*(random_numbers(seed, d, k * stride).numpy() for d in (0, 1)), bins=16))
    assert len(p) > 300
    assert min(p) > 0.01 / len(p)
    assert max(p) < 1 - 0.01 / len(p)  # too even is not random either
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_random_numbers_have_no_lattice():
    """Every random walk 2 pi (k u + l v) ends near the origin: its squared length over N is exponential with mean 1.

    624 wave vectors (half of them conjugates) in 21 spectra: the largest of 7e3 exceeds 25 with probability 1e-7.
    """
    k = torch.arange(RAYS // 4)
    strongest = []
    for seed in SEEDS[::3]:
        u, v, after = (random_numbers(s, d, k).numpy() for s, d in ((seed, 0), (seed, 1), (seed + 1, 0)))
        strongest += [lattice_strength(u, v), lattice_strength(u, after), lattice_strength(u[:-1], u[1:])]
    assert len(strongest) == 21
    assert max(strongest) < 25
    assert min(strongest) > 1  # 312 exponential variables never all stay below 1


def test_the_statistics_above_recognise_a_lattice():
    """The same two tests on Kronecker's sequence, which is even in one dimension and a lattice in two."""
    k = np.arange(RAYS)
    a, b = k * 0.6180339887498949 % 1, k * 0.7548776662466927 % 1
    assert chi_square(a, bins=256) > 0.99
    assert max(lattice_strength(a[: RAYS // 4], a[: RAYS // 4]), lattice_strength(a[:-1][: RAYS // 4], a[1:][: RAYS // 4])) > 1000
    assert chi_square(a[:-1], a[1:], bins=32) < 1e-9
    assert chi_square(a, b, bins=8) > 0.999


def test_streams_of_different_seeds_and_dimensions_are_uncorrelated():
    """4005 correlation coefficients times sqrt(N) are standard normal: spread 1 to 3 %, none beyond 5 sigma."""
    k = torch.arange(RAYS)
    rows = torch.stack([random_numbers(seed, d, k) for seed in range(30) for d in range(3)]) - 0.5
    z = (12.0 * rows @ rows.T / RAYS**0.5)[*np.triu_indices(len(rows), 1)]
    assert len(z) == 4005
    assert abs(float(z.std()) - 1.0) < 0.03
    assert abs(float(z.mean())) < 4 / 4005**0.5
    assert float(z.abs().max()) < 5.0


@pytest.mark.parametrize("kind", ["stratified", "lines", "uniform"])
def test_the_mean_over_seeds_is_even(kind):
    """All samples of 100 seeds together fill a 16 x 16 grid of cells that does not fit theirs: shifts are uniform, too."""
    u, v = (torch.cat(at) for at in zip(*(points(Sampler(kind, (10, 14), seed))[:2] for seed in range(100)), strict=True))
    assert len(u) == 14000
    counts = np.histogram2d(u, v, 16, [[0, 1], [0, 1]])[0]
    expected = len(u) / 256
    spread = float(((counts - expected) ** 2).mean() / expected)  # 1 for independent rays, with standard error 0.09
    # stratified rays are more even than independent ones; lines, too, but whole lines of rays move together
    low, high = {"uniform": (0.7, 1.3), "stratified": (0.2, 0.8), "lines": (0.3, 1.5)}[kind]
    assert low < spread < high


@pytest.mark.parametrize("kind", SAMPLERS)
def test_profile_lights_its_own_corner(kind):
    """[i, j], i along +x: only profile[-1, 0] is bright, so light starts at large u and small v alone."""
    profile = torch.zeros(4, 3, dtype=torch.float64)
    profile[3, 0] = 2.5
    u, v, flux = points(Sampler(kind, (40, 42), 1, looked_up_in(profile)))
    lit = (u > 0.75) & (v < 1 / 3)
    assert 0 < int(lit.sum()) < len(u) / 4
    assert bool((flux[lit] > 0).all())
    assert not flux[~lit].any()
    assert float(flux.sum()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("kind", SAMPLERS)
def test_profile_weights_rays_by_its_value(kind):
    profile = torch.rand(4, 3, dtype=torch.float64) + 0.1
    u, v, flux = points(Sampler(kind, (40, 42), 1, looked_up_in(profile)), 100)
    value = profile[(u * 4).long(), (v * 3).long()]
    torch.testing.assert_close(flux, value / value.sum(), rtol=1e-13, atol=0)
    assert float(flux.sum()) == pytest.approx(1.0, abs=1e-12)


def test_a_profile_that_every_ray_misses_is_refused():
    profile = torch.zeros(3, 3, dtype=torch.float64)
    profile[0, 0] = 1.0
    with pytest.raises(InputError, match="use more rays"):
        next(Sampler("grid", (1, 1), profile=looked_up_in(profile)).chunks())


@pytest.mark.parametrize(("rays", "aspect"), [(1, 1.0), (10, 1.0), (10**4, 1.0), (10**4, 3.0), (10**5, 0.1), (50, 1000.0)])
def test_of_size_gives_about_that_many_rays_in_square_cells(rays, aspect):
    sampler = Sampler.of_size("grid", rays, aspect)
    nu, nv = sampler.shape
    assert abs(sampler.count - rays) <= 0.5 * nu + (nu if nv == 1 else 0) + 1
    if rays >= 10**4:
        assert nu / nv == pytest.approx(aspect, rel=0.03)


def test_unknown_sampler_is_refused():
    with pytest.raises(InputError, match="grid, lines, stratified, uniform, sobol, got 'halton'"):
        Sampler("halton", (2, 2))
