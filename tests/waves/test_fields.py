"""The kernels of wave images against their reference in float64: images, derivatives by the paths and by the heights."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from caustic_cli.optics.kernels import fields
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.waves.propagation import TURN, Exposure, cells, phase_of, ramp
from caustic_cli.optics.waves.sampling import Sampling
from caustic_cli.optics.waves.wavefront import LastSurface, PathChange
from caustic_cli.scene import Lens

SHAPE, PADDED = (37, 50), (44, 56)
#: Pixels of several samples and of less than one, inside the samples, beyond them, and at fractions of them.
EDGES = {
    "wide": (torch.linspace(3.3, 41.9, 8, dtype=torch.float64), torch.linspace(0.0, 56.0, 8, dtype=torch.float64)),
    "narrow": (torch.linspace(10.1, 17.9, 13, dtype=torch.float64), torch.linspace(20.0, 30.0, 41, dtype=torch.float64)),
    "clamped": (
        torch.tensor([0.0, 0.0, 0.4, 20.5, 44.0, 44.0], dtype=torch.float64),
        torch.tensor([0.0, 7.0, 56.0, 56.0], dtype=torch.float64),
    ),
}


def rough(seed: int, *shape: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def exposures(name: str) -> tuple[fields.FusedExposure, Exposure, torch.Tensor]:
    """Both of the same light, and a change of its paths of some wavelengths."""
    phase, amplitude, factor = TURN * rough(1, *SHAPE).abs().remainder(1.0), rough(2, *SHAPE).abs(), TURN / 5e-4
    single = phase.float(), amplitude.float()
    args = factor, PADDED, EDGES[name]
    return fields.FusedExposure(*single, *args), Exposure(*(c.double() for c in single), *args), 2e-3 * rough(3, *SHAPE)


@pytest.mark.parametrize("name", EDGES)
@pytest.mark.parametrize("keep", [True, False])
def test_images_and_derivatives_are_those_of_the_reference(name, keep):
    fused, exact, change = exposures(name)
    rounded = change.float()
    image, expected = fused.image(rounded, keep), exact.image(rounded.double())
    assert image.dtype == torch.float64 and image.shape == fused.resolution
    torch.testing.assert_close(image, expected, rtol=1e-5, atol=1e-5 * float(expected.max()))
    pull = rough(4, *fused.resolution)
    found, goal = rough(5, *SHAPE).float(), torch.zeros(SHAPE, dtype=torch.float64)
    before = found.double()
    fused.pull(pull, rounded, found)
    exact.pull(pull, rounded.double(), goal)
    assert float((found.double() - before - goal).abs().max()) < 1e-4 * float(goal.abs().max())


def test_cosine_and_sine_are_accurate_for_phases_of_many_turns():
    """In units of the amplitude, for phases up to 60 rad, whose own rounding is 4e-6."""
    phase = torch.linspace(-60.0, 60.0, 10_001).view(1, -1)
    out = np.zeros((1, 2 * phase.numel()), np.float32)
    zero, one = np.zeros(phase.shape, np.float32), np.ones(phase.shape, np.float32)
    fields.make_field(fields.ALL, phase.numpy(), np.float32(1.0), zero, one, out, 2)
    exact = torch.polar(torch.ones_like(phase).double(), phase.double()).numpy()
    assert np.abs(out.view(np.complex64) - exact).max() < 5e-7


def test_phases_are_reduced_before_they_are_rounded():
    """Paths of a hundred thousand wavelengths keep the digits that matter."""
    sampling = Sampling((-1.0, -2.0), (2.0 / 37, 4.0 / 50), SHAPE, PADDED, (3.0, 0.1), 300.0)
    path = 50.0 + rough(6, *SHAPE)
    across, along = (ramp(sampling, 4e-4, k, path.device) for k in (0, 1))
    exact = (TURN / 5e-4 * path + across[:, None] + along).remainder(TURN)
    apart = (phase_of(path, sampling, 5e-4, 4e-4).float().double() - exact).remainder(TURN)
    assert float(torch.minimum(apart, TURN - apart).max()) < 2e-6


@pytest.mark.parametrize("degree", [(3, 3), (2, 5)])
def test_path_changes_are_those_of_the_reference(degree):
    field = HeightField.of(Lens((10.0, 8.0), control=(11, 14), degree=degree))
    x, y = 5.0 * torch.sin(rough(7, *SHAPE)), 4.0 * torch.sin(rough(8, *SHAPE))
    last = LastSurface(x, y, -0.5 + 0.1 * rough(9, *SHAPE))
    fused, exact = fields.FusedPathChange(field, last, torch.float32), PathChange(field, last, torch.float64)
    heights, by = 1e-3 * rough(10, 11, 14), rough(11, *SHAPE)
    goal = exact.of(heights)
    assert float((fused.of(heights).double() - goal).abs().max()) < 5e-6 * float(goal.abs().max())
    goal = exact.pull(by)
    assert float((fused.pull(by.float()) - goal).abs().max()) < 5e-6 * float(goal.abs().max())


def test_masks_hold_the_same_shares_as_edges():
    """The reference's overlap matrices: every sample inside the pixels is shared out whole."""
    for edges in EDGES.values():
        for e, n in zip(edges, PADDED, strict=True):
            whole = cells(e, n)
            assert float(whole.sum()) == pytest.approx(float(e[-1] - e[0])) and float(whole.min()) >= 0.0
            assert math.isclose(float(whole[0].sum()), float(e[1] - e[0]), abs_tol=1e-12)
