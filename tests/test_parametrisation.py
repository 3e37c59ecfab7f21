"""From parameters to heights: ranges, inversion, the preconditioner, and the thesis' statements about its networks."""

import math

import numpy as np
import pytest
import torch
from scipy.fft import dct

from caustic_cli.errors import InputError
from caustic_cli.inverse.parametrisation import (
    MAX_DENSE,
    SATURATION,
    UNIFORM_SPREAD,
    Architecture,
    cosine_transform,
    parametrise,
)

N, M = 6, 5


def bounds(n: int = N, m: int = M, dtype=torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    """Bounds that differ from point to point."""
    g = torch.Generator().manual_seed(7)
    low = 3.0 + torch.rand(n, m, generator=g, dtype=torch.float64)
    return low.to(dtype), (low + 0.5 + torch.rand(n, m, generator=g, dtype=torch.float64)).to(dtype)


def count(module) -> int:
    return sum(p.numel() for p in module.parameters())


ALL = [{}, {"preconditioner": "laplacian"}, {"network": "sparse"}, {"network": "dense"}]


@pytest.mark.parametrize("options", ALL, ids=str)
def test_zero_parameters_give_the_middle_of_the_range(options):
    low, high = bounds()
    heights = parametrise(low, high, **options)()
    assert heights.dtype == torch.float64
    torch.testing.assert_close(heights, 0.5 * (low + high), rtol=0, atol=1e-15)


@pytest.mark.parametrize("options", ALL, ids=str)
@pytest.mark.parametrize("size", [1.0, 1e3, 1e8])
def test_heights_never_leave_their_range(options, size):
    """tanh saturates at exactly 1, and low + (high - low) may round to the next number above high: one unit in the last place."""
    low, high = bounds()
    module = parametrise(low, high, **options)
    reached = 0.0
    for seed in range(5):
        g = torch.Generator().manual_seed(seed)
        for p in module.parameters():
            p.data = size * torch.randn(p.shape, generator=g, dtype=torch.float64).to(p.dtype)
        heights = module().detach()
        assert bool((heights >= low).all())
        assert bool((heights <= high * (1 + 2.0**-52)).all())
        reached = max(reached, float(((heights - low) / (high - low) - 0.5).abs().max()))
    assert reached > 0.3


@pytest.mark.parametrize("preconditioner", ["none", "laplacian"])
def test_a_start_is_reproduced(preconditioner):
    """To 1e-14 of the range over the slope of tanh; at the bounds SATURATION / 2 of the span away, so that a gradient remains."""
    low, high = bounds()
    part = torch.linspace(0.001, 0.999, N * M, dtype=torch.float64).view(N, M)
    start = low + part * (high - low)
    module = parametrise(low, high, start=start, preconditioner=preconditioner)
    torch.testing.assert_close(module().detach(), start, rtol=0, atol=1e-12)
    for beyond, bound, inwards in ((low - 1.0, low, 1), (low, low, 1), (high, high, -1), (high + 5.0, high, -1)):
        module = parametrise(low, high, start=beyond, preconditioner=preconditioner)
        heights = module()
        expected = bound + inwards * 0.5 * SATURATION * (high - low)
        torch.testing.assert_close(heights.detach(), expected, rtol=0, atol=1e-14)
        (gradient,) = torch.autograd.grad(heights.sum(), module.y)
        assert bool(torch.isfinite(gradient).all())
        assert float(gradient.abs().sum()) > 0


@pytest.mark.parametrize("n", [2, 3, 8, 25, 128])
def test_cosine_transform_is_orthonormal_scipys_and_diagonalises_the_laplacian(n):
    c = cosine_transform(n)
    torch.testing.assert_close(c @ c.T, torch.eye(n, dtype=torch.float64), rtol=0, atol=1e-13)
    np.testing.assert_allclose(c.numpy(), dct(np.eye(n), axis=0, norm="ortho"), rtol=0, atol=1e-13)
    laplacian = torch.diag(torch.full((n,), 2.0, dtype=torch.float64))
    laplacian -= torch.diag(torch.ones(n - 1, dtype=torch.float64), 1) + torch.diag(torch.ones(n - 1, dtype=torch.float64), -1)
    laplacian[0, 0] = laplacian[-1, -1] = 1.0  # the net ends there
    eigenvalues = 4 * torch.sin(0.5 * math.pi * torch.arange(n, dtype=torch.float64) / n) ** 2
    torch.testing.assert_close(c @ laplacian @ c.T, torch.diag(eigenvalues), rtol=0, atol=1e-12)


def test_laplacian_coordinates_are_the_laplacian_of_the_net():
    """raw = start + (inverse Laplacian) y: the five-point Laplacian of raw - start is y's cosine transform, up to one scale."""
    low, high = bounds(9, 7)
    start = low + 0.3 * (high - low)
    module = parametrise(low, high, start=start, preconditioner="laplacian")
    y = torch.randn(9, 7, dtype=torch.float64)
    module.y.data = y.clone()
    moved = (module.raw() - module.start).detach().numpy()
    padded = np.pad(moved, 1, mode="edge")
    laplacian = 4 * moved - padded[:-2, 1:-1] - padded[2:, 1:-1] - padded[1:-1, :-2] - padded[1:-1, 2:]
    y[0, 0] = 0.0  # the mean moves no light and is left alone
    expected = (cosine_transform(9).T @ y @ cosine_transform(7)).numpy()
    scale = 4 * math.sin(math.pi / 18) ** 2 + 4 * math.sin(math.pi / 14) ** 2
    np.testing.assert_allclose(laplacian, scale * expected, rtol=0, atol=1e-13)
    assert abs(moved.mean()) < 1e-14


def test_number_of_weights():
    """Thesis 5.1.1 and erratum E10: one layer of input weights and biases; the dense network joins three by two full matrices."""
    low, high = bounds()
    size = N * M
    assert count(parametrise(low, high)) == count(parametrise(low, high, preconditioner="laplacian")) == size
    assert count(parametrise(low, high, "sparse", degree=(2, 1))) == (size + size) + (5 * 3 * size + size)
    assert count(parametrise(low, high, "dense")) == (size + size) + 2 * (size * size + size)
    assert count(parametrise(*bounds(25, 25), "dense")) == pytest.approx(2 * 25**4, rel=0.01)  # 7.8e5


def test_a_dense_network_too_large_is_refused_before_it_is_made():
    n = 126
    assert 2 * n**4 > MAX_DENSE
    with pytest.raises(InputError, match=r"network dense needs .* weights for a 126 x 126 control net"):
        parametrise(*bounds(n, n), "dense")


@pytest.mark.parametrize("network", ["sparse", "dense"])
def test_a_preconditioned_network_gives_the_coordinates_that_heights_have(network):
    low, high = bounds()
    start = low + 0.3 * (high - low)
    module = parametrise(low, high, network, degree=(1, 1), initial="random", seed=4, preconditioner="laplacian", start=start)
    plain = parametrise(low, high, network, degree=(1, 1), initial="random", seed=4)
    free = parametrise(low, high, preconditioner="laplacian", start=start)
    free.y.data = plain.raw().detach().double()
    torch.testing.assert_close(module().detach(), free().detach(), rtol=0, atol=1e-12)


def set_randomly(module, seed: int = 3) -> None:
    g = torch.Generator().manual_seed(seed)
    for p in module.parameters():
        p.data = torch.randn(p.shape, generator=g, dtype=p.dtype)


@pytest.mark.parametrize("degree", [(1, 1), (2, 1), (3, 3)])
def test_sparse_layer_is_a_masked_full_matrix(degree):
    """Neuron (i, j) sees (i + a, j + b), |a| <= p, |b| <= q, each through its own weight; beyond the net there is nothing."""
    low, high = bounds()
    module = parametrise(low, high, "sparse", degree=degree)
    set_randomly(module)
    (w0, w1), (b0, b1) = module.weights, module.biases
    p, q = degree
    full, mask = torch.zeros(N * M, N * M), torch.zeros(N * M, N * M)
    for i in range(N):
        for j in range(M):
            for k, (a, b) in enumerate((a, b) for a in range(-p, p + 1) for b in range(-q, q + 1)):
                if 0 <= i + a < N and 0 <= j + b < M:
                    full[i * M + j, (i + a) * M + j + b] = w1[k, i * M + j].item()
                    mask[i * M + j, (i + a) * M + j + b] = 1.0
    expected = full @ torch.tanh(w0 + b0) + b1
    torch.testing.assert_close(module.raw(), expected.view(N, M), rtol=0, atol=2e-6)  # sums of up to 49 float32 terms
    raw = Raw(module)
    jacobian = torch.autograd.functional.jacobian(lambda w: torch.func.functional_call(raw, {"m.weights.0": w}, ()), w0.detach())
    assert torch.equal((jacobian.view(N * M, N * M) != 0).float(), mask)
    assert 0 < float(mask.mean()) <= 1


def test_a_sparse_network_of_two_surfaces_is_one_of_each():
    """Neither sees the other's neurons."""
    low, high = (torch.stack([b, b]) for b in bounds())
    both = parametrise(low, high, "sparse", degree=(2, 1))
    set_randomly(both)
    assert both.raw().shape == (2, N, M)
    for side in range(2):
        one, own = parametrise(low[side], high[side], "sparse", degree=(2, 1)), slice(side * N * M, (side + 1) * N * M)
        for mine, its in zip((*one.weights, *one.biases), (*both.weights, *both.biases), strict=True):
            mine.data = its.data[..., own]
        torch.testing.assert_close(both.raw()[side], one.raw(), rtol=0, atol=1e-6)


def test_a_dense_network_of_two_surfaces_by_hand():
    low, high = (torch.stack([b, b]) for b in bounds())
    module = parametrise(low, high, "dense", architecture=Architecture(1, 5))
    set_randomly(module)
    w, b = list(module.weights), list(module.biases)
    torch.testing.assert_close(module.raw(), (w[1] @ torch.tanh(w[0] + b[0]) + b[1]).view(2, N, M), rtol=0, atol=1e-6)


class Raw(torch.nn.Module):
    """A parametrisation's raw values as a module's forward."""

    def __init__(self, m):
        super().__init__()
        self.m = m

    def forward(self):
        return self.m.raw()


def test_dense_network_by_hand():
    low, high = bounds()
    module = parametrise(low, high, "dense")
    set_randomly(module)
    w, b = list(module.weights), list(module.biases)
    expected = w[2] @ torch.tanh(w[1] @ torch.tanh(w[0] + b[0]) + b[1]) + b[2]
    torch.testing.assert_close(module.raw(), expected.view(N, M), rtol=0, atol=1e-6)
    part = 0.5 * (1 + torch.tanh(expected.view(N, M).double()))
    torch.testing.assert_close(module(), low + part * (high - low), rtol=0, atol=1e-6)


def pull(heights: torch.Tensor) -> torch.Tensor:
    """Some smooth loss of the heights with a different pull at every control point."""
    target = 3.5 + torch.sin(torch.arange(heights.numel(), dtype=torch.float64)).view(heights.shape)
    return ((heights - target) ** 4).sum() + heights[0, 0] * heights[-1, -1]


@pytest.mark.parametrize("optimizer", [torch.optim.Adam, torch.optim.SGD])
def test_a_zero_sparse_network_optimises_like_no_network(optimizer):
    """Thesis 6.2.1: only the biases of the last layer have gradients then.  Bitwise, once both parameters are float32."""
    low, high = bounds(dtype=torch.float32)
    modules = parametrise(low, high), parametrise(low, high, "sparse", degree=(2, 2))
    free, sparse = modules
    pull(free()).backward()
    pull(sparse()).backward()
    assert torch.equal(sparse.biases[1].grad.view(N, M), free.y.grad)
    assert bool((free.y.grad != 0).all())
    assert not any(p.grad.any() for p in (*sparse.weights, sparse.biases[0]))
    methods = [optimizer(m.parameters(), lr=1e-2) for m in modules]
    start = free().detach()
    for _ in range(20):
        for module, method in zip(modules, methods, strict=True):
            method.zero_grad()
            pull(module()).backward()
            method.step()
        assert torch.equal(free(), sparse())
    assert float((free().detach() - start).abs().max()) > 0.01


def test_initial_states():
    low, high = bounds()
    for network in ("sparse", "dense"):
        for initial, spread in (("uniform", UNIFORM_SPREAD), ("random", 1.0)):
            a, b, other = (parametrise(low, high, network, initial=initial, seed=s, degree=(1, 1)) for s in (1, 1, 2))
            for p, q, r in zip(a.parameters(), b.parameters(), other.parameters(), strict=True):
                assert torch.equal(p, q)
                assert not torch.equal(p, r)
                assert float(p.detach().abs().max()) <= spread
        kernel = {"sparse": 9, "dense": N * M}[network]
        last = parametrise(low, high, network, initial="random", degree=(1, 1)).weights[-1].detach()
        assert float(last.abs().max()) == pytest.approx(1 / math.sqrt(kernel), rel=0.02)  # 1 / sqrt(fan-in)
    for preconditioner in ("none", "laplacian"):
        free = [
            parametrise(low, high, initial=initial, seed=1, preconditioner=preconditioner)().detach()
            for initial in ("zero", "uniform", "random")
        ]
        middle = 0.5 * (low + high)
        away = [float(((f - middle) / (high - low)).abs().max()) for f in free]
        assert away[0] < 1e-15
        assert 1e-5 < away[1] <= 0.5 * UNIFORM_SPREAD
        assert 0.2 < away[2] <= 0.5 * math.tanh(1.0)


REFUSED = {
    "network": ({"network": "conv"}, "network must be one of none, sparse, dense, got 'conv'"),
    "initial": ({"initial": "ones"}, "initial must be one of"),
    "preconditioner": ({"preconditioner": "jacobi"}, "preconditioner must be one of"),
    "start": ({"network": "sparse", "start": torch.zeros(N, M)}, "begins from its own initial state"),
}


@pytest.mark.parametrize(("options", "sentence"), REFUSED.values(), ids=REFUSED.keys())
def test_contradictions_are_refused(options, sentence):
    with pytest.raises(InputError, match=sentence):
        parametrise(*bounds(), **options)


def test_the_fast_transforms_derivative():
    """Raw heights are linear in the parameters: the adjoint of the fast transform is that of the matrices."""
    low, high = bounds(9, 7)
    module = parametrise(low, high, start=low + 0.3 * (high - low), preconditioner="laplacian")
    generator = torch.Generator().manual_seed(3)
    by, along = (torch.randn(9, 7, dtype=torch.float64, generator=generator) for _ in range(2))
    (module.raw() * by).sum().backward()
    pulled = float((module.y.grad * along).sum())
    module.y.data = along
    assert float(((module.raw() - module.start) * by).sum().detach()) == pytest.approx(pulled, rel=1e-12)
