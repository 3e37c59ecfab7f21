"""L-BFGS: finds minima, keeps the Wolfe conditions, survives values that are not finite, and resumes bitwise."""

import io
import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from caustic_cli.inverse.lbfgs import ARMIJO, CURVATURE, LBFGS


class Counted:
    """A differentiable function with its gradient by autograd, and every point it was asked at."""

    def __init__(self, function):
        self.function, self.asked = function, []

    def __call__(self, x):
        self.asked.append(x.clone())
        x = x.detach().requires_grad_()
        value = self.function(x)
        (gradient,) = torch.autograd.grad(value, x)
        return float(value.detach()), gradient


def rosenbrock(x):
    return (100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2).sum()


def quadratic(condition: float, n: int):
    """0.5 (x - 1)' A (x - 1) + 3 with eigenvalues from 1 to `condition` along random axes."""
    q = torch.linalg.qr(torch.randn(n, n, generator=torch.Generator().manual_seed(n), dtype=torch.float64))[0]
    a = q @ torch.diag(torch.logspace(0, math.log10(condition), n, dtype=torch.float64)) @ q.T
    return lambda x: 0.5 * (x - 1.0) @ a @ (x - 1.0) + 3.0


def start(n: int) -> torch.Tensor:
    return -1.2 + 0.1 * torch.sin(torch.arange(n, dtype=torch.float64))


def run(method: LBFGS, steps: int) -> int:
    """Steps taken before it stops."""
    for k in range(steps):
        if not method.step():
            return k
    return steps


@pytest.mark.parametrize("n", [2, 10, 50])
def test_rosenbrock(n):
    """The valley's end, to sqrt(eps); SciPy's L-BFGS-B takes some 40 evaluations for two variables, 400 for 50."""
    f = Counted(rosenbrock)
    method = LBFGS(f, start(n))
    run(method, 500)
    torch.testing.assert_close(method.x, torch.ones(n, dtype=torch.float64), rtol=0, atol=1e-7)
    assert len(f.asked) == method.evaluations < 60 + 10 * n


@pytest.mark.parametrize("condition", [1.0, 100.0, 1e4])
@pytest.mark.parametrize("n", [1, 5, 30])
def test_quadratic(condition, n):
    """SciPy's L-BFGS-B with the same memory takes 374 evaluations for the worst of these, this one 373."""
    method = LBFGS(Counted(quadratic(condition, n)), start(n), memory=30)
    run(method, 400)
    assert method.evaluations < 450
    assert method.f == pytest.approx(3.0, abs=1e-12)
    torch.testing.assert_close(method.x, torch.ones(n, dtype=torch.float64), rtol=0, atol=1e-6)


@given(st.integers(0, 10**6), st.integers(1, 6), st.floats(-3, 3), st.floats(0.01, 100))
def test_it_never_goes_up(seed, n, offset, size):
    """Random quartic bowls with a wavy floor: no step is accepted for a higher value, and x, f, g belong together."""
    g = torch.Generator().manual_seed(seed)
    a, c = torch.rand(n, generator=g, dtype=torch.float64), torch.randn(n, generator=g, dtype=torch.float64)
    f = Counted(lambda x: (a * x**4 + c * x + torch.cos(3.0 * x)).sum() * size + offset)
    method = LBFGS(f, 2.0 * torch.randn(n, generator=g, dtype=torch.float64))
    values = [f(method.x)[0]]
    while len(values) < 30 and method.step():
        values.append(method.f)
        again = f(method.x)
        assert again[0] == method.f
        assert torch.equal(again[1], method.g)
    assert all(b <= a for a, b in pairwise(values))  # equal only where the decrease is below rounding
    assert values[-1] < values[0]


@pytest.mark.parametrize("function", [rosenbrock, quadratic(1e4, 12)], ids=["rosenbrock", "quadratic"])
def test_accepted_steps_meet_the_strong_wolfe_conditions(function):
    """f1 <= f0 + c1 s'g0 and |s'g1| <= c2 |s'g0|, as long as rounding lets the line search see a decrease."""
    method = LBFGS(Counted(function), start(12))
    f, g = method.evaluate(method.x)
    checked, x = 0, method.x
    while method.step() and f - method.f > 1e-12 * abs(f):
        s = method.x - x
        decrease = float(s @ g)
        assert decrease < 0
        assert method.f <= f + ARMIJO * decrease * (1 - 1e-9)
        assert abs(float(s @ method.g)) <= CURVATURE * abs(decrease) * (1 + 1e-9)
        x, f, g = method.x, method.f, method.g
        checked += 1
    assert checked > 20


def test_a_step_that_does_not_decrease_enough_is_refused():
    """1 - x + a x^2 + b x^3 with f(0.2) = 1 + 1e-5 and f'(0.2) = 0.5: the first trial is flat enough, but higher."""
    a, b = torch.linalg.solve(
        torch.tensor([[0.04, 0.008], [0.4, 0.12]], dtype=torch.float64), torch.tensor([0.2 + 1e-5, 1.5], dtype=torch.float64)
    ).tolist()
    f = Counted(lambda x: (1 - x + a * x**2 + b * x**3).sum())
    method = LBFGS(f, torch.zeros(1, dtype=torch.float64))
    assert method.step()
    assert float(f.asked[1]) == pytest.approx(0.2, rel=1e-12)  # 0.1 of 2 f / |g|^2
    assert len(f.asked) > 2
    assert method.f < 1 - ARMIJO * float(method.x)


def test_no_point_is_evaluated_twice():
    f = Counted(rosenbrock)
    run(LBFGS(f, start(7)), 60)
    assert len(f.asked) > 40
    assert len({tuple(x.tolist()) for x in f.asked}) == len(f.asked)


@pytest.mark.parametrize("n", [2, 5, 7, 33, 101, 1001])
def test_resuming_is_bitwise(n):
    """40 steps = 20 + checkpoint + 20, through bytes, for lengths that are and are not multiples of a vector register."""
    whole = LBFGS(Counted(rosenbrock), start(n))
    run(whole, 20)
    file = io.BytesIO()
    torch.save(whole.state(), file)
    run(whole, 20)
    file.seek(0)
    resumed = LBFGS(Counted(rosenbrock), torch.zeros(n, dtype=torch.float64))
    resumed.load(torch.load(file))
    assert len(resumed.pairs) > 5
    run(resumed, 20)
    assert torch.equal(resumed.x, whole.x)
    assert resumed.f == whole.f


def test_resuming_before_the_first_step_evaluates_afresh():
    method = LBFGS(Counted(rosenbrock), start(3))
    other = LBFGS(Counted(rosenbrock), torch.zeros(3, dtype=torch.float64))
    other.load(method.state())
    for m in (method, other):
        run(m, 15)
    assert torch.equal(method.x, other.x)


def test_stepping_does_not_change_a_state_already_taken():
    method = LBFGS(Counted(rosenbrock), start(5))
    run(method, 10)
    state = method.state()
    copy = {k: v.clone() for k, v in state.items()}
    run(method, 10)
    assert all(torch.equal(state[k], copy[k]) for k in copy)


@pytest.mark.parametrize("memory", [1, 2, 5, 20])
def test_memory_is_kept_to(memory):
    method = LBFGS(Counted(rosenbrock), start(10), memory)
    run(method, 25)
    assert 1 <= len(method.pairs) <= memory


@pytest.mark.parametrize("hole", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["value", "gradient"])
def test_values_that_are_not_finite_are_stepped_back_from(hole, where):
    """x - log x with nothing to the left of 0.5 but holes: its minimum is found although early steps are far too long."""
    holes, asked = 0, []

    def evaluate(x):
        nonlocal holes
        asked.append(tuple(x.tolist()))
        value, gradient = float((x - x.clamp_min(0.1).log()).sum() + 0.1 * x[0] ** 2), 1.0 - 1.0 / x.clamp_min(0.1)
        gradient[0] += 0.2 * x[0]
        if bool((x < 0.5).any()) or bool((x > 40).any()):
            holes += 1
            return (hole, gradient) if where == "value" else (value, torch.full_like(gradient, hole))
        return value, gradient

    method = LBFGS(evaluate, torch.tensor([30.0, 0.51, 8.0], dtype=torch.float64))
    run(method, 100)
    assert holes > 0
    assert len(set(asked)) > 0.9 * len(asked)  # a hole is not tried again; only rounding at the minimum repeats points
    first = (-1 + math.sqrt(1.8)) / 0.4  # 1 - 1/x + 0.2 x = 0
    expected = torch.tensor([first, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(method.x, expected, rtol=0, atol=1e-6)
    assert math.isfinite(method.f)


def test_at_a_minimum_and_where_nothing_is_lower_it_stops():
    f = Counted(lambda x: (x * x).sum() + 1.0)
    method = LBFGS(f, torch.zeros(3, dtype=torch.float64))
    assert not method.step()
    assert len(f.asked) == 1
    # a gradient that points the wrong way: no lower point along it
    liar = LBFGS(lambda x: (float((x * x).sum()) + 1.0, -2.0 * x), torch.ones(3, dtype=torch.float64))
    assert not liar.step()
    assert torch.equal(liar.x, torch.ones(3, dtype=torch.float64))


def test_a_start_where_the_function_is_zero_is_left():
    """The first step is measured in units of f / |g|^2, but f = 0 does not mean that the minimum is here."""
    method = LBFGS(Counted(lambda x: (x * x).sum() - 2.0 * x.sum() / 3**0.5), torch.zeros(3, dtype=torch.float64))
    run(method, 20)
    assert method.f == pytest.approx(-1.0, abs=1e-12)
