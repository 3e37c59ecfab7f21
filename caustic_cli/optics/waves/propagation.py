"""Light from the plane behind a lens to the screen: Fresnel's integral as one Fourier transform, with its complex adjoint.

    U(X) = 1 / (i lambda L) exp(i k X^2 / 2 L)  integral  u(x) exp(i k x^2 / 2 L) exp(-i k x X / L) dx

Of U only |U|^2 is asked for, so the factor before the integral is left out; what remains is a discrete transform of samples dx
apart (`sampling`), and unitary: sum |U|^2 = sum |u|^2 to rounding.  Light's path is given so that this integral, which is exact for
parabolic wavefronts, lands every ray where the trace says (`wavefront`).

Large transforms are made in pieces (decimation in frequency): the outputs k = r + B m along x are the transform of length N / B of
the inputs, turned by exp(-2 pi i r j / N) and added up modulo N / B.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from caustic_cli.optics.waves.sampling import Sampling

TURN = 2.0 * math.pi


def ramp(sampling: Sampling, wavelength: float, axis: int, device: torch.device) -> Tensor:
    """Phase (n,) rad of the integral's kernel along one axis, for a screen whose samples begin at `Sampling.first`; float64."""
    j = torch.arange(sampling.count[axis], dtype=torch.float64, device=device)
    x = sampling.low[axis] + (j + 0.5) * sampling.step[axis]
    k, x0 = TURN / wavelength, sampling.first(wavelength)[axis]
    return torch.remainder(k * (0.5 * x * x - x0 * x) / sampling.distance, TURN)


def cells(low: float, width: float, count: int, first: float, spacing: float, samples: int, device: torch.device) -> Tensor:
    """Parts of the screen's samples, `spacing` wide about their middles, that fall on each pixel along one axis: (count, N).

    low, width: of the first pixel; first: middle of the first sample; all mm.
    """
    edges = low + width * torch.arange(count + 1, dtype=torch.float64, device=device)
    start = first + spacing * (torch.arange(samples, dtype=torch.float64, device=device) - 0.5)
    reach = ((edges[:, None] - start[None, :]) / spacing).clamp(0.0, 1.0)  # of each sample, the part below each edge
    return reach[1:] - reach[:-1]


class _Illuminance(torch.autograd.Function):
    """Phase and amplitude of a field (n, m) -> power on pixels, of one transform; see `power_on_pixels`."""

    @staticmethod
    def forward(ctx, phase: Tensor, amplitude: Tensor, shape: tuple[int, int], rows: Tensor, columns: Tensor) -> Tensor:
        u = torch.polar(amplitude, phase)
        big = torch.fft.fft2(u, s=shape, norm="ortho")
        ctx.save_for_backward(phase, amplitude, big, rows, columns)
        return rows @ (big.real.square() + big.imag.square()) @ columns.T

    @staticmethod
    def backward(ctx, by_pixel: Tensor):
        phase, amplitude, big, rows, columns = ctx.saved_tensors
        n, m = phase.shape
        back = torch.fft.ifft2(big * (rows.T @ by_pixel @ columns), norm="ortho")[:n, :m]
        unit = torch.polar(torch.ones_like(phase), phase)
        turned = back * unit.conj()
        return 2.0 * amplitude * turned.imag, 2.0 * turned.real, None, None, None


def power_on_pixels(phase: Tensor, amplitude: Tensor, shape: tuple[int, int], rows: Tensor, columns: Tensor) -> Tensor:
    """Power on the pixels of a screen, (a, b), of a field on the plane behind the lens; differentiable by phase and amplitude.

    Args:
        phase, amplitude: (n, m), rad, the kernel's `ramp` added, and the root of the power of each sample.
        shape: (N, M) of the transform.
        rows, columns: (a, N) and (b, M), see `cells`.
    """
    return _Illuminance.apply(phase, amplitude, shape, rows, columns)


def power_in_pieces(field: Callable[[slice], Tensor], sampling: Sampling, pieces: int, rows: Tensor, columns: Tensor,
                    block: int = 256) -> tuple[Tensor, float]:
    """The same without derivatives for a field that is given block of rows by block of rows, complex (rows, m), in bounded memory.

    Returns:
        power on the pixels (a, b) float64, and that of the whole transform.
    """
    (n, m), (big, wide) = sampling.count, sampling.padded
    short = big // pieces
    image, whole = 0.0, 0.0
    for r in range(pieces):
        folded = None
        for start in range(0, n, block):
            u = field(slice(start, min(n, start + block)))
            j = torch.arange(start, start + len(u), device=u.device)
            if folded is None:
                folded = torch.zeros(short, m, dtype=u.dtype, device=u.device)
            turn = torch.remainder(r * j, big).double() * (-TURN / big)
            folded.index_add_(0, j % short, u * torch.polar(torch.ones_like(turn), turn).to(u.dtype)[:, None])
        transformed = torch.fft.fft2(folded, s=(short, wide))
        power = (transformed.real.square() + transformed.imag.square()) / (float(big) * wide)
        whole += float(power.sum(dtype=torch.float64))
        image = image + (rows[:, r::pieces] @ power @ columns.T).double()
    return image, whole
