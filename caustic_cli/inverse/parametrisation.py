"""From trainable parameters to control heights (thesis 5.1).

    heights = low + (1 + tanh(raw)) / 2 (high - low)                          eqs. 5.1.1, 5.1.2; low, high per control point

    none      raw = parameters themselves, or with the Laplacian preconditioner
              raw = start + C_u^T (s o y) C_v, y the parameters, C orthonormal cosine transforms (DCT-II) and
              s_kl = 1 / (lambda_k + lambda_l), lambda_k = 4 sin^2(pi k / 2n), the inverse Laplacian of the control net;
              or raw = start + y, counted from the start
    sparse    1 -> a tanh layer of control-net size -> a locally connected layer, kernel (2p + 1) x (2q + 1), own weights
    dense     1 -> three tanh layers of control-net size joined by two full matrices

The caustic responds to the Laplacian of the surface: in the preconditioned coordinates every length scale of the
picture pulls equally hard, and L-BFGS needs tens of iterations where a plain gradient needs thousands.
"""

from __future__ import annotations

import math

import torch
from scipy.fft import dctn, idctn
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.config import checks
from caustic_cli.errors import InputError

NETWORKS = ("none", "sparse", "dense")
INITIAL = ("zero", "uniform", "random")
PRECONDITIONERS = ("none", "laplacian")
#: tanh is inverted no closer than this to its limits: raw stays below 8.4 and a gradient remains.
SATURATION = 1e-7
UNIFORM_SPREAD = 1e-4  # thesis 6.2.1
#: Most weights of the dense network: 2 n^4 of them for an n x n net (erratum E10); 5e8 are 6 GB with Adam's moments.
MAX_DENSE = 500_000_000


def cosine_transform(n: int) -> Tensor:
    """Orthonormal DCT-II matrix C (n, n), float64: row k is cos(pi k (i + 1/2) / n) normalised."""
    k, i = torch.arange(n, dtype=torch.float64)[:, None], torch.arange(n, dtype=torch.float64)
    c = torch.cos(math.pi * k * (i + 0.5) / n) * math.sqrt(2.0 / n)
    c[0] *= math.sqrt(0.5)
    return c


class Heights(torch.nn.Module):
    """Control heights between two bounds; `forward()` gives (n, m) float64, mm; of two sides all are (2, n, m).

    Args:
        low, high: (n, m) bounds of the heights, mm.
    """

    def __init__(self, low: Tensor, high: Tensor):
        super().__init__()
        self.low, self.span = low, high - low

    def raw(self) -> Tensor:
        """Unbounded values (n, m); 0 gives the middle of the range."""
        raise NotImplementedError

    def forward(self) -> Tensor:
        return self.low + 0.5 * (1.0 + torch.tanh(self.raw().double())) * self.span

    def begun(self) -> Tensor:
        """The heights (n, m) that parameters are counted from, or where they are counted from none, those of now."""
        return self().detach()

    def invert(self, heights: Tensor) -> Tensor:
        """Raw values (n, m) that give `heights`, kept SATURATION away from the bounds."""
        y = (2.0 * (heights - self.low) / self.span - 1.0).clamp(-1.0 + SATURATION, 1.0 - SATURATION)
        return torch.atanh(y)


class _Inverse(torch.autograd.Function):
    """C_u^T x C_v over the last two axes of x, whose adjoint is C_u x C_v^T: by fast transforms, in n m log(n m) steps."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        return torch.from_numpy(idctn(x.detach().numpy(), axes=(-2, -1), norm="ortho", workers=torch.get_num_threads()))

    @staticmethod
    @once_differentiable
    def backward(ctx, by: Tensor) -> Tensor:
        return torch.from_numpy(dctn(by.numpy(), axes=(-2, -1), norm="ortho", workers=torch.get_num_threads()))


class FreeHeights(Heights):
    """No network; with `laplacian`, in coordinates where the caustic's response is well conditioned.

    Args:
        start: (n, m) heights to start from, or None for the middle of the range.
        counted: parameters are counted from the start, which `begun` tells.
    """

    def __init__(self, low: Tensor, high: Tensor, start: Tensor | None = None, laplacian: bool = False, counted: bool = False):
        super().__init__(low, high)
        self.laplacian, counted = laplacian, counted or laplacian
        raw = torch.zeros_like(low) if start is None else self.invert(start)
        self.register_buffer("start", raw if counted else None)
        self.y = torch.nn.Parameter(torch.zeros_like(raw) if counted else raw.clone())
        if laplacian:
            n, m = low.shape[-2:]
            if low.device.type != "cpu":
                self.cu, self.cv = cosine_transform(n).to(low), cosine_transform(m).to(low)
            lam = [4.0 * torch.sin(0.5 * math.pi * torch.arange(k).to(low) / k) ** 2 for k in (n, m)]
            total = lam[0][:, None] + lam[1][None, :]
            total[0, 0] = math.inf  # the mean height moves no light: leave it where the start put it
            self.scale = float(lam[0][1] + lam[1][1]) / total

    def raw(self) -> Tensor:
        if not self.laplacian:
            return self.y if self.start is None else self.start + self.y
        scaled = self.scale * self.y
        return self.start + (_Inverse.apply(scaled) if scaled.device.type == "cpu" else self.cu.T @ scaled @ self.cv)

    def begun(self) -> Tensor:
        if self.start is None:
            return super().begun()
        return self.low + 0.5 * (1.0 + torch.tanh(self.start.double())) * self.span


class NetworkHeights(Heights):
    """A network with trivial input 1 (5.1.1), float32 weights, tanh everywhere."""

    def __init__(self, low: Tensor, high: Tensor, kind: str, degree: tuple[int, int], initial: str, seed: int):
        super().__init__(low, high)
        self.kind, self.degree = kind, degree
        n, m = self.net = tuple(low.shape)
        size, kernel = n * m, (2 * degree[0] + 1) * (2 * degree[1] + 1)
        layers = [(1, (size,))]  # (fan-in, weight shape)
        if kind == "sparse":
            layers += [(kernel, (kernel, size))]
        else:
            if 2 * size * size > MAX_DENSE:
                raise InputError(
                    f"⟨design.network⟩ dense needs {2 * size * size:.3g} weights for a {n} x {m} control net;"
                    f" at most {MAX_DENSE:.3g} are supported (16000 control points): use sparse or none"
                )
            layers += [(size, (size, size)), (size, (size, size))]
        generator = torch.Generator().manual_seed(seed)
        self.weights, self.biases = torch.nn.ParameterList(), torch.nn.ParameterList()
        for fan_in, shape in layers:
            spread = {"zero": 0.0, "uniform": UNIFORM_SPREAD, "random": 1.0 / math.sqrt(fan_in)}[initial]
            for group, s in ((self.weights, shape), (self.biases, (size,))):
                group.append(torch.nn.Parameter(((2.0 * torch.rand(s, generator=generator) - 1.0) * spread).to(low.device)))

    def raw(self) -> Tensor:
        x = torch.tanh(self.weights[0] + self.biases[0])  # input 1
        for k in range(1, len(self.weights)):
            if k > 1:
                x = torch.tanh(x)
            if self.kind == "sparse":
                p, q = self.degree
                near = torch.nn.functional.unfold(x.view(1, 1, *self.net), (2 * p + 1, 2 * q + 1), padding=(p, q))[0]
                x = (self.weights[k] * near).sum(0) + self.biases[k]  # near: (kernel, n m), zero beyond the net
            else:
                x = self.weights[k] @ x + self.biases[k]
        return x.view(self.net)


def parametrise(
    low: Tensor,
    high: Tensor,
    network: str = "none",
    *,
    start: Tensor | None = None,
    degree=(3, 3),
    initial: str = "zero",
    preconditioner: str = "none",
    seed: int = 0,
) -> Heights:
    """The parametrisation a design asks for.

    Raises:
        InputError: an unknown name, a start or a preconditioner given to a network, or a network too large.
    """
    checks.choice("⟨design.network⟩", network, NETWORKS)
    checks.choice("⟨design.initial⟩", initial, INITIAL)
    checks.choice("⟨design.preconditioner⟩", preconditioner, PRECONDITIONERS)
    if network == "none":
        if start is None and initial != "zero":
            spread = UNIFORM_SPREAD if initial == "uniform" else 1.0
            noise = torch.rand(low.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            module = FreeHeights(low, high, None, False)
            module.y.data = ((2.0 * noise - 1.0) * spread).to(low)
            if preconditioner == "none":
                return module
            start = module().detach()
        return FreeHeights(low, high, start, preconditioner == "laplacian")
    if start is not None or preconditioner != "none":
        raise InputError(
            f"⟨design.network⟩ {network} begins from its own initial state with preconditioner none;"
            " a start surface or the laplacian preconditioner need network none"
        )
    return NetworkHeights(low, high, network, degree, initial, seed)
