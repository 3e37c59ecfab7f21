"""B-spline surfaces from scattered slopes: against the spline they were taken from, and against dense least squares."""

import numpy as np
import pytest
import torch

from caustic_cli.inverse import surface_from_slopes
from caustic_cli.inverse.surface_from_slopes import fitted
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Lens

FIELD = HeightField.of(Lens((8.0, 6.0), control=(13, 11)))


def scattered(count: int, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    places = torch.rand(2, count, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    x, y = ((2.0 * p - 1.0) * r for p, r in zip(places, FIELD.half_size, strict=True))
    return x, y


def net(seed: int = 2) -> torch.Tensor:
    return torch.randn(FIELD.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_a_spline_is_found_again_from_its_slopes(monkeypatch):
    monkeypatch.setattr(surface_from_slopes, "SMOOTH", 0.0)
    monkeypatch.setattr(surface_from_slopes, "STEPS", 1000)
    monkeypatch.setattr(surface_from_slopes, "ENOUGH", 1e-12)
    points, wanted = scattered(4000), net()
    _, gx, gy = FIELD.at(wanted, *points)
    found = fitted(
        FIELD, points, (gx, gy), torch.ones(4000, dtype=torch.float64), torch.full(FIELD.shape, 3.0, dtype=torch.float64)
    )
    assert found.mean() == pytest.approx(3.0)
    assert torch.allclose(found - found.mean(), wanted - wanted.mean(), atol=1e-8)


def test_it_is_the_weighted_least_squares_of_slopes_and_second_differences(monkeypatch):
    monkeypatch.setattr(surface_from_slopes, "STEPS", 3000)
    monkeypatch.setattr(surface_from_slopes, "ENOUGH", 1e-13)
    points, count = scattered(300), 300
    slopes = torch.randn(2, count, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    weight = torch.rand(count, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    found = fitted(FIELD, points, (slopes[0], slopes[1]), weight, net())
    n, m = FIELD.shape
    unit = torch.eye(n * m, dtype=torch.float64).view(-1, n, m)
    columns = [torch.cat(FIELD.at(u, *points)[1:]) for u in unit]
    root = (weight / weight.mean()).sqrt().repeat(2)
    rows = [torch.stack(columns, 1) * root[:, None]]
    right = [slopes.flatten() * root]
    for axis in (1, 2):
        apart = torch.diff(FIELD.control_xy()[axis - 1])
        apart = apart[:, None] if axis == 1 else apart
        bent = (
            torch.diff(torch.diff(unit, dim=axis) / apart, dim=axis).flatten(1).T
            * (surface_from_slopes.SMOOTH * count / (n * m)) ** 0.5
        )
        rows.append(bent)
        right.append(torch.zeros(len(bent), dtype=torch.float64))
    wanted = np.linalg.lstsq(torch.cat(rows).numpy(), torch.cat(right).numpy(), rcond=1e-12)[0].reshape(n, m)
    assert np.allclose(found - found.mean(), wanted - wanted.mean(), atol=1e-6 * np.abs(wanted).max())


def test_where_there_are_no_points_it_goes_on_smoothly(monkeypatch):
    monkeypatch.setattr(surface_from_slopes, "STEPS", 1000)
    x, y = scattered(3000)
    kept = x < 1.0
    _, gx, gy = FIELD.at(FIELD.control_xy()[0][:, None] * torch.full(FIELD.shape, 0.2, dtype=torch.float64), x, y)
    found = fitted(
        FIELD,
        (x[kept], y[kept]),
        (gx[kept], gy[kept]),
        torch.ones(int(kept.sum()), dtype=torch.float64),
        torch.zeros(FIELD.shape).double(),
    )
    assert (FIELD.at(found, x, y)[1] - gx).abs().max() < 0.02
