"""The spline spaces against SciPy, a naive Cox-de Boor recursion, and the exact circle of Piegl & Tiller."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from parametric import Surface
from scipy.interpolate import BSpline, RectBivariateSpline

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import MAX_DEGREE, GridSpline, SplineSpace, over_grid
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Lens

DEGREES = range(1, MAX_DEGREE + 1)
#: Basis values are sums and products of numbers in [0, 1], and knots here are at least 0.01 apart, so x - t_i keeps 14 digits.
BASIS = 1e-12


def knots_with(degree: int, inner: list[float], counts: list[int]) -> torch.Tensor:
    """Open knot vector with the given inner knots, each repeated up to `degree` times."""
    t = [0.0] * (degree + 1)
    for x, m in zip(inner, counts, strict=True):
        t += [x] * min(m, degree)
    return torch.tensor(t + [1.0] * (degree + 1), dtype=torch.float64)


def random_spaces(degree: int, count: int) -> list[SplineSpace]:
    """Spaces with up to 8 distinct inner knots on multiples of 0.01, multiplicity 1 to p; the first has repeats for sure."""
    rng = np.random.default_rng(1000 + degree)
    spaces = [SplineSpace(degree, knots_with(degree, [0.25, 0.5, 0.51], [degree, max(1, degree - 1), 1]))]
    while len(spaces) < count:
        inner = np.sort(rng.choice(np.arange(1, 100), rng.integers(0, 9), replace=False)) / 100.0
        spaces.append(SplineSpace(degree, knots_with(degree, inner.tolist(), rng.integers(1, degree + 1, len(inner)).tolist())))
    return spaces


def awkward_points(space: SplineSpace) -> torch.Tensor:
    """0, 1, every knot exactly, its neighbours in float64, and random points."""
    breaks = space.breaks.numpy()
    near = np.concatenate([np.nextafter(breaks, 2.0)[:-1], np.nextafter(breaks, -1.0)[1:]])
    return torch.from_numpy(np.concatenate([breaks, near, np.random.default_rng(space.n).random(40)]))


def cox_de_boor(t: np.ndarray, p: int, x: np.ndarray) -> np.ndarray:
    """All basis functions by the textbook recursion (thesis 2.4.3) with 0 / 0 = 0; the last span is closed: (m, n)."""
    last = np.flatnonzero(np.diff(t) > 0)[-1]
    rows = [(t[i] <= x) & ((x < t[i + 1]) | ((i == last) & (x == t[i + 1]))) for i in range(len(t) - 1)]
    basis = np.array(rows, dtype=float)
    for k in range(1, p + 1):
        nxt = []
        for i in range(len(t) - k - 1):
            a, b = t[i + k] - t[i], t[i + k + 1] - t[i + 1]
            left = (x - t[i]) / a * basis[i] if a > 0 else 0.0 * x
            right = (t[i + k + 1] - x) / b * basis[i + 1] if b > 0 else 0.0 * x
            nxt.append(left + right)
        basis = np.array(nxt)
    return basis.T


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_is_scipys_and_cox_de_boors(degree):
    checked = 0
    for space in random_spaces(degree, 10):
        x, t = awkward_points(space), space.knots.numpy()
        ours = space.matrix(x).numpy()
        scipy = BSpline.design_matrix(x.numpy(), t, degree).toarray()
        np.testing.assert_allclose(ours, scipy, rtol=0, atol=BASIS)
        np.testing.assert_allclose(ours, cox_de_boor(t, degree, x.numpy()), rtol=0, atol=BASIS)
        checked += len(x)
    assert checked > 400


@pytest.mark.parametrize("degree", DEGREES)
def test_derivatives_are_scipys(degree):
    """Relative to the largest value: an r-th derivative scales as (p / gap)^r, and so does the rounding of its differences."""
    checked = 0
    for space in random_spaces(degree, 5):
        x = awkward_points(space)
        oracle = BSpline(space.knots.numpy(), np.eye(space.n), degree)
        for order in range(1, min(degree, 4) + 1):
            theirs = oracle(x.numpy(), nu=order)
            np.testing.assert_allclose(space.matrix(x, order).numpy(), theirs, rtol=0, atol=BASIS * np.abs(theirs).max())
            checked += 1
        assert not space.matrix(x, degree + 1).any()
    assert checked >= 5


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_is_a_partition_of_unity_and_not_negative(degree):
    """p + 1 terms, each off by a few units in the last place: 1e-14 is 45 of them."""
    for space in random_spaces(degree, 10):
        values = space.basis(awkward_points(space))[1]
        assert float((values.sum(-1) - 1.0).abs().max()) < 1e-14
        slopes = space.basis(awkward_points(space), 1)[1]
        assert float(slopes.sum(-1).abs().max()) < 1e-14 * float(slopes.abs().max())
        assert float(values.min()) >= -1e-17  # a product of non-negative factors: not even rounding makes it negative


@pytest.mark.parametrize("degree", DEGREES)
def test_ends_and_full_knots_interpolate_exactly(degree):
    space = SplineSpace(degree, knots_with(degree, [0.3, 0.7], [degree, 1]))
    at = space.matrix(torch.tensor([0.0, 1.0, 0.3], dtype=torch.float64))
    expected = torch.zeros(3, space.n, dtype=torch.float64)
    expected[0, 0] = expected[1, -1] = expected[2, degree] = 1.0  # 0.3 has multiplicity p: one basis function is 1 there
    torch.testing.assert_close(at, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize(("degree", "multiplicity"), [(p, m) for p in (1, 2, 3, 5) for m in range(1, p + 1)])
def test_a_knot_of_multiplicity_m_leaves_p_minus_m_continuous_derivatives(degree, multiplicity):
    space = SplineSpace(degree, knots_with(degree, [0.2, 0.5, 0.9], [1, multiplicity, 1]))
    knot = torch.tensor([math.nextafter(0.5, 0.0), 0.5], dtype=torch.float64)
    for order in range(degree + 1):
        below, above = space.matrix(knot, order)
        jump = float((above - below).abs().max() / above.abs().max())
        if order <= degree - multiplicity:
            assert jump < 1e-12
        else:
            assert jump > 1e-2


@pytest.mark.parametrize("degree", DEGREES)
def test_control_points_at_the_greville_abscissae_give_the_identity(degree):
    for space in random_spaces(degree, 10):
        x = awkward_points(space)
        torch.testing.assert_close(space.matrix(x) @ space.greville, x, rtol=0, atol=1e-14)


def test_control_positions_and_slopes_follow_the_aperture():
    """The height field of z = a x + b y has slopes a and b everywhere, over whatever aperture: (u, v) -> (x, y) is linear."""
    lens = Lens(size=(7.0, 3.0), control=(9, 6), degree=(4, 2))
    field = HeightField.of(lens)
    x, y = field.control_xy()
    assert (float(x[0]), float(x[-1]), float(y[0]), float(y[-1])) == (-3.5, 3.5, -1.5, 1.5)
    heights = 0.3 * x[:, None] - 0.7 * y[None, :]
    u, v = torch.rand(50, dtype=torch.float64), torch.rand(60, dtype=torch.float64)
    one = torch.ones((), dtype=torch.float64)
    grid = field.prepare(Sample(u, v, True, one), torch.float64)(heights)
    scattered = field.prepare(Sample(u, v[:50], False, one), torch.float64)(heights)
    for _, zx, zy in (grid, scattered):
        torch.testing.assert_close(zx, torch.full_like(zx, 0.3), rtol=0, atol=1e-13)
        torch.testing.assert_close(zy, torch.full_like(zy, -0.7), rtol=0, atol=1e-13)
    torch.testing.assert_close(grid[0], 0.3 * (7 * u - 3.5)[:, None] - 0.7 * (3 * v - 1.5), rtol=0, atol=1e-13)
    torch.testing.assert_close(scattered[0], grid[0].diagonal(), rtol=0, atol=1e-13)


def test_slope_bound_holds_and_is_attained_by_a_plane():
    lens = Lens(control=(8, 9), degree=(3, 4))
    field = HeightField.of(lens)
    x, y = field.control_xy()
    assert field.slope_bound(3.0 * x[:, None] + 4.0 * y) == pytest.approx(5.0, rel=1e-13)
    heights = torch.randn(8, 9, dtype=torch.float64)
    u = torch.linspace(0, 1, 200, dtype=torch.float64)
    _, zx, zy = field.prepare(Sample(u, u, True, torch.ones(())), torch.float64)(heights)
    steepest = float(torch.hypot(zx, zy).max())
    assert 0.3 * field.slope_bound(heights) < steepest <= field.slope_bound(heights)


@pytest.mark.parametrize("degree", DEGREES)
def test_differences_are_the_derivatives_control_points(degree):
    """Inner knots stay below multiplicity p, so that the derivative has no tears (degree 1 has them always: SciPy allows it)."""
    inner = [0.2, 0.5, 0.51]
    space = SplineSpace(degree, knots_with(degree, inner, [1, max(1, degree - 1), 1]))
    control = torch.randn(space.n, dtype=torch.float64)
    x = torch.rand(100, dtype=torch.float64)
    expected = (space.matrix(x, 1) @ control).numpy()
    ours = BSpline(space.knots.numpy()[1:-1], space.differences(control).numpy(), degree - 1)(x.numpy())
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("degree", DEGREES)
def test_banded_products_and_interpolation_are_those_of_the_dense_matrix(degree):
    space = SplineSpace(degree, knots_with(degree, [0.2, 0.5, 0.51], [1, max(1, degree - 1), 1]))
    other, x = SplineSpace.uniform(degree + 5, degree), torch.rand(40, dtype=torch.float64)
    net = torch.randn(space.n, other.n, dtype=torch.float64, requires_grad=True)
    by = torch.randn(40, other.n, dtype=torch.float64)
    for derivative in range(3):
        u, v = (s.matrix(t, derivative) for s, t in ((space, x), (other, other.greville)))
        dense = u @ net @ v.T
        banded = over_grid(space.banded(x, derivative), net, other.banded(other.greville, derivative))
        scale = 1e-13 * float(u.abs().max() * v.abs().max() * net.detach().abs().max())
        torch.testing.assert_close(banded, dense, rtol=0, atol=scale)
        pulled = [torch.autograd.grad(z, net, by)[0] for z in (banded, dense)]
        torch.testing.assert_close(*pulled, rtol=1e-12, atol=scale)
    values = torch.randn(space.n, other.n, dtype=torch.float64)
    at, inverse = space.matrix(space.greville), space.interpolated(values)
    torch.testing.assert_close(at @ inverse, values, rtol=0, atol=1e-14 * float(torch.linalg.cond(at)) * float(inverse.abs().max()))


@st.composite
def spaces(draw):
    """Any admissible space of degree 1 to 15 with knots on multiples of 0.01."""
    degree = draw(st.integers(1, MAX_DEGREE))
    inner = sorted(draw(st.lists(st.integers(1, 99), max_size=5, unique=True)))
    counts = [draw(st.integers(1, degree)) for _ in inner]
    return SplineSpace(degree, knots_with(degree, [x / 100.0 for x in inner], counts))


@given(spaces(), st.lists(st.integers(1, 99), min_size=1, max_size=4, unique=True))
def test_knot_insertion_leaves_the_spline_unchanged(space, where):
    """Boehm's ratios are convex combinations: no digits are lost.  Inserted knots may coincide with old ones."""
    old = space.knots.tolist()
    new = [x / 100.0 for x in where if old.count(x / 100.0) < space.degree]
    finer, matrix = space.insert(new)
    assert finer.n == space.n + len(new)
    assert finer.knots.tolist() == sorted(old + new)
    x = awkward_points(finer)
    control = torch.linspace(-1, 1, space.n, dtype=torch.float64).sin()
    torch.testing.assert_close(finer.matrix(x) @ (matrix @ control), space.matrix(x) @ control, rtol=0, atol=1e-13)
    torch.testing.assert_close(matrix.sum(1), torch.ones(finer.n, dtype=torch.float64), rtol=0, atol=1e-14)


def test_inserting_a_knot_once_too_often_is_refused():
    space = SplineSpace.uniform(6, 3)
    with pytest.raises(InputError, match="repeated at most 3 times"):
        space.insert([0.4] * 4)
    for outside in (0.0, 1.0, -0.1, math.nan):
        with pytest.raises(InputError, match="strictly between 0 and 1"):
            space.insert([outside])


def wavy_surface(weighted: bool) -> Surface:
    """A surface over knots with repeats, degrees (3, 2), in 3-D."""
    spaces_uv = (SplineSpace(3, knots_with(3, [0.2, 0.5], [1, 3])), SplineSpace(2, knots_with(2, [0.4], [2])))
    g = torch.Generator().manual_seed(5)
    points = torch.rand(spaces_uv[0].n, spaces_uv[1].n, 3, generator=g, dtype=torch.float64)
    weights = torch.rand(points.shape[:2], generator=g, dtype=torch.float64) + 0.3
    return Surface(spaces_uv, points, weights if weighted else None)


@pytest.mark.parametrize("weighted", [False, True])
def test_knot_insertion_leaves_a_surface_unchanged(weighted):
    surface = wavy_surface(weighted)
    finer = surface.insert([0.2, 0.7, 0.71], [0.1, 0.9])
    assert finer.points.shape == (surface.points.shape[0] + 3, surface.points.shape[1] + 2, 3)
    u, v = torch.rand(2, 200, dtype=torch.float64)
    for du, dv, tolerance in ((0, 0, 1e-13), (1, 0, 1e-11), (1, 1, 1e-10)):  # a derivative multiplies rounding by p / gap = 300
        torch.testing.assert_close(finer.evaluate(u, v, du, dv), surface.evaluate(u, v, du, dv), rtol=0, atol=tolerance)


@pytest.mark.parametrize("degree", [1, 2, 3, 5, 7])
def test_change_of_basis_is_exact_for_nested_spaces(degree):
    coarse = SplineSpace(degree, knots_with(degree, [0.25, 0.5], [1, degree]))
    control = torch.randn(coarse.n, dtype=torch.float64)
    x = torch.rand(100, dtype=torch.float64)
    knots_finer = SplineSpace(degree, knots_with(degree, [0.1, 0.25, 0.5, 0.8], [1, degree, degree, 1]))
    higher = SplineSpace(degree + 2, knots_with(degree + 2, [0.25, 0.5], [3, degree + 2]))  # every coarse spline lies in it
    for finer in (coarse, knots_finer, higher):
        moved = coarse.change_of_basis(finer) @ control
        assert moved.shape == (finer.n,)
        torch.testing.assert_close(finer.matrix(x) @ moved, coarse.matrix(x) @ control, rtol=0, atol=1e-11)  # cond <= p 2^p


@pytest.mark.parametrize("degree", [1, 3, 7, 15])
def test_change_of_basis_to_more_knots_is_knot_insertion(degree):
    """Not an interpolation, which would lose p + 1 binary digits or more: every new point is a convex combination of old ones."""
    coarse = SplineSpace(degree, knots_with(degree, [0.25, 0.5], [1, degree]))
    finer, matrix = coarse.insert([0.1, 0.6, 0.6, 0.9] if degree > 1 else [0.1, 0.9])
    assert torch.equal(coarse.change_of_basis(finer), matrix)
    assert float(matrix.min()) >= 0


def test_change_of_basis_to_a_space_not_nested_interpolates_at_the_greville_abscissae():
    fine, other = SplineSpace.uniform(30, 3), SplineSpace.uniform(11, 4)
    control = torch.randn(30, dtype=torch.float64)
    moved = fine.change_of_basis(other) @ control
    at = other.greville
    torch.testing.assert_close(other.matrix(at) @ moved, fine.matrix(at) @ control, rtol=0, atol=1e-12)
    ones = fine.change_of_basis(other) @ torch.ones(30, dtype=torch.float64)
    torch.testing.assert_close(ones, torch.ones(11, dtype=torch.float64), rtol=0, atol=1e-12)


def cylinder(radius: float = 2.0, height: float = 3.0) -> Surface:
    """The nine-point circle of Piegl & Tiller, ex. 7.3, drawn out along z."""
    w = math.sqrt(0.5)
    circle = [(1, 0, 1), (1, 1, w), (0, 1, 1), (-1, 1, w), (-1, 0, 1), (-1, -1, w), (0, -1, 1), (1, -1, w), (1, 0, 1)]
    around = SplineSpace(2, knots_with(2, [0.25, 0.5, 0.75], [2, 2, 2]))
    points = [[(radius * x, radius * y, along) for along in (0.0, height)] for x, y, _ in circle]
    weights = [[c[2], c[2]] for c in circle]
    return Surface(
        (around, SplineSpace.uniform(2, 1)), torch.tensor(points, dtype=torch.float64), torch.tensor(weights, dtype=torch.float64)
    )


def test_nurbs_cylinder_is_exact():
    u, v = torch.linspace(0, 1, 401, dtype=torch.float64), torch.rand(401, dtype=torch.float64)
    point = cylinder().evaluate(u, v)
    torch.testing.assert_close(point[:, :2].norm(dim=1), torch.full_like(u, 2.0), rtol=0, atol=2e-15)
    torch.testing.assert_close(point[:, 2], 3.0 * v, rtol=0, atol=2e-15)
    assert float(point[:, :2].mean(0).norm()) < 0.01  # it goes all the way round
    tangent = cylinder().evaluate(u, v, 1, 0)
    assert float((tangent[:, :2] * point[:, :2]).sum(1).abs().max()) < 1e-12  # radius times speed is 25: 50 roundings
    assert float(tangent[:, :2].norm(dim=1).min()) > 5.0
    assert float(tangent[:, 2].abs().max()) < 1e-13


@pytest.mark.parametrize("orders", [(1, 0), (0, 1), (1, 1), (2, 0), (2, 1), (3, 2)])
@pytest.mark.parametrize("surface", [cylinder(), wavy_surface(True), wavy_surface(False)], ids=["cylinder", "nurbs", "b-spline"])
def test_surface_derivatives_are_autograds(surface, orders):
    u, v = 0.01 + 0.98 * torch.rand(2, 30, dtype=torch.float64)
    u, v = u.requires_grad_(), v.requires_grad_()
    value = surface.evaluate(u, v)
    ours = surface.evaluate(u, v, *orders).detach()
    for axis in range(value.shape[-1]):
        d = value[:, axis]
        for variable, order in zip((u, v), orders, strict=True):
            for _ in range(order):
                (d,) = torch.autograd.grad(d.sum(), variable, create_graph=True, allow_unused=True, materialize_grads=True)
        scale = 1.0 + float(ours.abs().max())
        torch.testing.assert_close(d.detach(), ours[:, axis], rtol=0, atol=1e-11 * scale)
    # the cylinder is straight along v: only there may a derivative vanish
    assert float(ours.abs().max()) > 0.1 or (surface.points.shape[1] == 2 and orders[1] > 0 and orders != (0, 1))


def test_equal_weights_are_no_weights():
    plain = wavy_surface(False)
    rational = Surface(plain.spaces, plain.points, torch.full(plain.points.shape[:2], 0.37, dtype=torch.float64))
    u, v = torch.rand(2, 100, dtype=torch.float64)
    for orders in ((0, 0), (1, 0), (1, 1)):
        torch.testing.assert_close(rational.evaluate(u, v, *orders), plain.evaluate(u, v, *orders), rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(3, 4), (4, 9), (17, 30)])
def test_the_spline_through_a_grid_is_that_of_scipy(shape):
    rng = np.random.default_rng(3)
    lines = [np.sort(rng.uniform(-4.0, 3.0, n)) + np.arange(n) for n in shape]
    values = rng.normal(size=shape)
    ours = GridSpline(*lines, values)
    theirs = RectBivariateSpline(*lines, values, kx=min(3, shape[0] - 1), ky=min(3, shape[1] - 1), s=0)
    at = [np.linspace(c[0] - 1.0, c[-1] + 1.0, n) for c, n in zip(lines, (40, 23), strict=True)]  # held beyond the ends
    assert np.abs(ours(*lines) - values).max() <= 1e-12
    assert np.abs(ours(*at) - theirs(*at)).max() <= 1e-11
    for found, (dx, dy) in zip(ours.derivatives(*at, [(1, 0), (0, 1)]), [(1, 0), (0, 1)], strict=True):
        inside = theirs(*(np.clip(p, c[0], c[-1]) for p, c in zip(at, lines, strict=True)), dx=dx, dy=dy)
        assert np.abs(found - inside).max() <= 1e-10


BAD_KNOTS = {
    "degree 0": (0, [0, 1], "degree must be 1 to 15, got 0"),
    "degree 16": (16, [0] * 17 + [1] * 17, "degree must be 1 to 15, got 16"),
    "too short": (2, [0, 0, 0, 1, 1], "at least 6 knots"),
    "decreasing": (1, [0, 0, 0.6, 0.4, 1, 1], "non-decreasing"),
    "not a number": (1, [0, 0, math.nan, 1, 1], "finite"),
    "infinite": (1, [0, 0, math.inf, 1, 1], "finite"),
    "not open": (2, [0, 0, 0.1, 1, 1, 1], "begin with 3 zeros"),
    "other interval": (1, [0, 0, 2, 2], "end with 2 ones"),
    "inner multiplicity p + 1": (2, [0, 0, 0, 0.5, 0.5, 0.5, 1, 1, 1], "repeated at most 2 times"),
    "end multiplicity p + 2": (2, [0, 0, 0, 0, 1, 1, 1], "strictly between 0 and 1"),
    "end multiplicity p + 2, above": (1, [0, 0, 1, 1, 1], "strictly between 0 and 1"),
    "nearly equal": (2, [0, 0, 0, 0.5, 0.5 + 1e-14, 1, 1, 1], "apart"),
    "two-dimensional": (1, [[0, 0, 1, 1], [0, 0, 1, 1]], "at least 4 knots"),
}


@pytest.mark.parametrize(("degree", "knots", "sentence"), BAD_KNOTS.values(), ids=BAD_KNOTS.keys())
def test_bad_knot_vectors_are_refused(degree, knots, sentence):
    with pytest.raises(InputError, match=sentence):
        SplineSpace(degree, torch.tensor(knots, dtype=torch.float64))


def test_too_few_control_points_and_bad_surfaces_are_refused():
    with pytest.raises(InputError, match="at least 4 control points, got 3"):
        SplineSpace.uniform(3, 3)
    with pytest.raises(InputError, match="1 to 15, got 0"):
        SplineSpace.uniform(3, 0)
    space = SplineSpace.uniform(3, 2)
    with pytest.raises(InputError, match="control points must have shape"):
        Surface((space, space), torch.zeros(3, 4, 3))
    with pytest.raises(InputError, match="must all be positive"):
        Surface((space, space), torch.zeros(3, 3, 3), torch.zeros(3, 3))
    with pytest.raises(InputError, match="weights must have shape"):
        Surface((space, space), torch.zeros(3, 3, 3), torch.ones(3, 2))
