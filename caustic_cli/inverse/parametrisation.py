"""Parametrisations of the control heights: free, preconditioned, or the output of a network (thesis 5.1).

    heights = low + (1 + tanh(raw)) / 2 (high - low)                          eqs. 5.1.1, 5.1.2; low, high per control point

    none      raw = start + y, y the parameters, or with the Laplacian preconditioner
              raw = start + C_u^T (s o y) C_v, C orthonormal cosine transforms (DCT-II) and
              s_kl = 1 / (lambda_k + lambda_l), lambda_k = 4 sin^2(pi k / 2n), the inverse Laplacian of the control net
    sparse    1 -> a tanh layer of control-net size -> a locally connected layer, kernel (2p + 1) x (2q + 1), own weights
    dense     1 -> hidden layers, fully connected -> a fully connected layer of control-net size; in the thesis two hidden layers
              of control-net size and tanh, which eq. 5.1.1 makes three

A network may have further inputs c beside the 1, with weights of their own in the first layer: a lens for each c
(`scene_parameters`).  With the Laplacian preconditioner its outputs are the coordinates y above, not raw values.

The caustic depends on the Laplacian of the surface: in the preconditioned coordinates all length scales of the picture contribute
equally to the gradient, and L-BFGS needs tens of iterations where gradient descent needs thousands.  After a start by transport
the large scales are right, and what is left are details of a few pixels: these converge several times as fast without it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from scipy.fft import dctn, idctn
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.errors import InputError
from caustic_cli.schema import checks
from caustic_cli.schema.table import check, check_all, default

NETWORKS = ("none", "sparse", "dense")
#: zero-last: random but for a zero last layer of the network, which then starts at the initial surface.
INITIAL = ("zero", "uniform", "random", "zero-last")
PRECONDITIONERS = ("none", "laplacian")
#: Least distance to the limits at which tanh is inverted: raw stays below 8.4, where the gradient does not vanish.
SATURATION = 1e-7
UNIFORM_SPREAD = 1e-4  # thesis 6.2.1
ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "tanh": torch.tanh,
    "relu": torch.relu,
    "silu": torch.nn.functional.silu,
    "sine": torch.sin,
}
#: Most weights of the dense network: 2 n^4 of the thesis' for an n x n net (erratum E10); 5e8 are 6 GB with Adam's moments.
MAX_DENSE = 500_000_000


@dataclass(frozen=True)
class Architecture:
    """Architecture of a dense network: hidden layers, neurons in each (0 for as many as control points), and activation.

    Raises:
        InputError: out of range, see the table.
    """

    layers: int = default("design.network_layers")
    width: int = default("design.network_width")
    activation: str = default("design.activation")

    def __post_init__(self):
        check("design.network_layers", self.layers)
        check("design.network_width", self.width)
        check("design.activation", self.activation)


@dataclass(frozen=True)
class Parametrisation:
    """How control heights follow from the parameters that are optimised, see above.

    Raises:
        InputError: out of range, see the table, or an architecture for another network than a dense one.
    """

    network: str = "none"
    initial: str = "zero"
    preconditioner: str = "laplacian"
    architecture: Architecture = field(default_factory=Architecture)

    def __post_init__(self):
        check_all("design", self, "network", "initial", "preconditioner")
        if self.network != "dense" and self.architecture != Architecture():
            raise InputError(
                "⟨design.network_layers⟩, ⟨design.network_width⟩ and ⟨design.activation⟩ belong to ⟨+design.network⟩ dense,"
                f" got {self.network}"
            )

    @property
    def free(self) -> bool:
        """Whether the parameters are the heights themselves, and not those of a network."""
        return self.network == "none"

    def heights(self, low: Tensor, high: Tensor, start: Tensor | None, **options: Any) -> Heights:
        """`parametrise` with these options; degree, seed and inputs as there."""
        return parametrise(
            low,
            high,
            self.network,
            start=start,
            initial=self.initial,
            preconditioner=self.preconditioner,
            architecture=self.architecture,
            **options,
        )


def cosine_transform(n: int) -> Tensor:
    """Orthonormal DCT-II matrix C (n, n), float64: row k is cos(pi k (i + 1/2) / n) normalised."""
    k, i = torch.arange(n, dtype=torch.float64)[:, None], torch.arange(n, dtype=torch.float64)
    c = torch.cos(math.pi * k * (i + 0.5) / n) * math.sqrt(2.0 / n)
    c[0] *= math.sqrt(0.5)
    return c


class _Inverse(torch.autograd.Function):
    """Inverse cosine transform C_u^T x C_v over the last two axes of x, with adjoint C_u x C_v^T, in O(n m log(n m))."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        return torch.from_numpy(idctn(x.detach().numpy(), axes=(-2, -1), norm="ortho", workers=torch.get_num_threads()))

    @staticmethod
    @once_differentiable
    def backward(ctx, by: Tensor) -> Tensor:
        return torch.from_numpy(dctn(by.numpy(), axes=(-2, -1), norm="ortho", workers=torch.get_num_threads()))


class InverseLaplacian:
    """y (.., n, m) -> C_u^T (s o y) C_v, the coordinates in which the caustic's response is well conditioned.

    Args:
        mean: factor s of the mean, which does not affect the image of one surface, relative to that of the longest wave.
        power: of the inverse Laplacian, less than 1 where the large scales are right at the start.
    """

    def __init__(self, like: Tensor, mean: float = 0.0, power: float = 1.0):
        n, m = like.shape[-2:]
        if like.device.type != "cpu":
            self.cu, self.cv = cosine_transform(n).to(like), cosine_transform(m).to(like)
        lam = [4.0 * torch.sin(0.5 * math.pi * torch.arange(k).to(like) / k) ** 2 for k in (n, m)]
        total = lam[0][:, None] + lam[1][None, :]
        total[0, 0] = math.inf
        self.scale = (float(lam[0][1] + lam[1][1]) / total) ** power
        self.scale[0, 0] = mean

    def __call__(self, y: Tensor) -> Tensor:
        scaled = self.scale * y
        return _Inverse.apply(scaled) if scaled.device.type == "cpu" else self.cu.T @ scaled @ self.cv


class Heights(torch.nn.Module):
    """Control heights between two bounds; `forward()` gives (n, m) float64, mm; of two sides all are (2, n, m).

    Those of a network with inputs (k, d) are (k, n, m); without them, as of inputs 0, (n, m).

    Args:
        low, high: (n, m) bounds of the heights, mm.
    """

    def __init__(self, low: Tensor, high: Tensor):
        super().__init__()
        self.low, self.span = low, high - low

    def raw(self, inputs: Tensor | None = None) -> Tensor:
        """Unbounded values (n, m); 0 gives the middle of the range."""
        raise NotImplementedError

    def forward(self, inputs: Tensor | None = None) -> Tensor:
        return self.low + 0.5 * (1.0 + torch.tanh(self.raw(inputs).double())) * self.span

    def initial_heights(self) -> Tensor:
        """The heights (n, m), mm, at which parameters that are relative to an initial surface are zero; else the current ones."""
        return self().detach()

    def invert(self, heights: Tensor) -> Tensor:
        """Raw values (n, m) that give `heights`, kept SATURATION away from the bounds."""
        y = (2.0 * (heights - self.low) / self.span - 1.0).clamp(-1.0 + SATURATION, 1.0 - SATURATION)
        return torch.atanh(y)


class FreeHeights(Heights):
    """Free control heights, relative to initial ones; with `laplacian`, in coordinates where the response of the caustic at all
    scales is well conditioned.

    Args:
        start: (n, m) initial heights, mm, or None for the middle of the range.
    """

    #: Of the inverse Laplacian.
    power = 1.0

    def __init__(self, low: Tensor, high: Tensor, start: Tensor | None = None, laplacian: bool = False):
        super().__init__(low, high)
        self.laplacian = InverseLaplacian(low, power=self.power) if laplacian else None
        self.register_buffer("start", torch.zeros_like(low) if start is None else self.invert(start))
        self.y = torch.nn.Parameter(torch.zeros_like(low))

    def raw(self, inputs: Tensor | None = None) -> Tensor:
        return self.start + (self.y if self.laplacian is None else self.laplacian(self.y))

    def initial_heights(self) -> Tensor:
        return self.low + 0.5 * (1.0 + torch.tanh(self.start.double())) * self.span


class SidesTogether(FreeHeights):
    """Heights of two surfaces, (2, n, m), with coupled parameters that decouple positions and directions of the rays.

    A change of the entrance is also added to the exit where its rays leave: the optical path length of every ray, and so, to first
    order, the direction in which it leaves, is unchanged.  So the first parameter moves light on the exit, the second deflects it.

    Args:
        origins: (n, m, 2) points of the entrance, see `internal_rays.entrance_points`; None where they are loaded.
    """

    power = 0.75  # after their transport start 10 iterations reach what 20 do with 1, or 0 (the heights themselves)

    def __init__(self, low: Tensor, high: Tensor, start: Tensor, laplacian: bool, origins: Tensor | None):
        super().__init__(low, high, start, laplacian)
        self.register_buffer("origins", low.new_zeros(*low.shape[1:], 2) if origins is None else origins)

    def raw(self, inputs: Tensor | None = None) -> Tensor:
        entrance, exit = self.y if self.laplacian is None else self.laplacian(self.y)
        seen = torch.nn.functional.grid_sample(entrance[None, None], self.origins[None], align_corners=True, padding_mode="border")
        return self.start + torch.stack([entrance, exit + seen[0, 0]])


class NetworkHeights(Heights):
    """A network with input 1 (5.1.1), and `inputs` more, float32 weights; of several surfaces, (k, n, m), one network: a sparse one
    has a locally connected layer for each.

    Args:
        kind: sparse or dense; degree: of the spline, for the kernel of a sparse one.
        start: (n, m) heights, mm, relative to which a preconditioned network is defined, or None for the middle of the range.
        laplacian: outputs are coordinates of the preconditioner.
    """

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        kind: str,
        degree: tuple[int, int],
        initial: str,
        seed: int,
        architecture: Architecture,
        inputs: int = 0,
        start: Tensor | None = None,
        laplacian: bool = False,
    ):
        super().__init__(low, high)
        self.kind, self.degree = kind, degree
        self.activation = ACTIVATIONS[architecture.activation]
        self.net = tuple(low.shape)
        size, kernel = low.numel(), (2 * degree[0] + 1) * (2 * degree[1] + 1)
        if kind == "sparse":
            layers = [(1, (size,), size), (kernel, (kernel, size), size)]  # (fan-in, shape of weights, of biases)
        else:
            widths = [architecture.width or size] * architecture.layers + [size]
            weights = sum(a * b for a, b in itertools.pairwise(widths))
            net = " x ".join(map(str, self.net))
            if weights > MAX_DENSE:
                raise InputError(
                    f"⟨design.network⟩ dense needs {weights:.3g} weights for a {net} control net; at most"
                    f" {MAX_DENSE:.3g} are supported (16000 control points unless ⟨+design.network_width⟩ says less): use sparse or"
                    " none"
                )
            layers = [(1, (widths[0],), widths[0])]
            layers += [(a, (b, a), b) for a, b in itertools.pairwise(widths)]
        generator = torch.Generator().manual_seed(seed)

        def parameter(shape: tuple[int, ...], spread: float) -> torch.nn.Parameter:
            return torch.nn.Parameter(((2.0 * torch.rand(shape, generator=generator) - 1.0) * spread).to(low.device))

        def spread(fan_in: int, last: bool) -> float:
            random = 1.0 / math.sqrt(fan_in)
            return {"zero": 0.0, "uniform": UNIFORM_SPREAD, "random": random, "zero-last": 0.0 if last else random}[initial]

        self.weights, self.biases = torch.nn.ParameterList(), torch.nn.ParameterList()
        for k, (fan_in, shape, width) in enumerate(layers):
            of_layer = spread(fan_in, k == len(layers) - 1)
            self.weights.append(parameter(shape, of_layer))
            self.biases.append(parameter((width,), of_layer))
        self.seen = (
            parameter((layers[0][2], inputs), spread(1, False)) if inputs else None
        )  # weights of the inputs in the first layer
        self.laplacian = InverseLaplacian(low) if laplacian else None
        self.register_buffer("start", (torch.zeros_like(low) if start is None else self.invert(start)) if laplacian else None)

    def raw(self, inputs: Tensor | None = None) -> Tensor:
        x = self.weights[0] + self.biases[0]  # input 1: (width,)
        if inputs is not None and self.seen is not None:
            x = x + inputs.to(x) @ self.seen.T  # (k, width)
        for weights, biases in zip(self.weights[1:], self.biases[1:], strict=True):
            x = self.activation(x)
            if self.kind == "sparse":
                p, q = self.degree
                net = x.view(-1, 1, *self.net[-2:])
                near = torch.nn.functional.unfold(net, (2 * p + 1, 2 * q + 1), padding=(p, q))  # (k, kernel, n m), zero beyond
                near = near.view(-1, x.shape[-1] // near.shape[-1], *near.shape[1:]).transpose(1, 2).flatten(2)  # of all surfaces
                x = (weights * near).sum(-2).view(x.shape) + biases
            else:
                x = torch.nn.functional.linear(x, weights, biases)
        y = x.view(*x.shape[:-1], *self.net)
        return y if self.laplacian is None else self.start + self.laplacian(y.double())


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
    architecture: Architecture | None = None,
    inputs: int = 0,
) -> Heights:
    """The parametrisation with these options; inputs: number of inputs of a network beside the 1.

    Raises:
        InputError: an unknown name, an initial surface for a network that does not take one, or a network that is too large.
    """
    checks.choice("⟨design.network⟩", network, NETWORKS)
    checks.choice("⟨design.initial⟩", initial, INITIAL)
    checks.choice("⟨design.preconditioner⟩", preconditioner, PRECONDITIONERS)
    if network == "none":
        if start is None and initial in ("uniform", "random"):
            spread = UNIFORM_SPREAD if initial == "uniform" else 1.0
            noise = torch.rand(low.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            module = FreeHeights(low, high, None, False)
            module.y.data = ((2.0 * noise - 1.0) * spread).to(low)
            start = module().detach()
        return FreeHeights(low, high, start, preconditioner == "laplacian")
    if start is not None and preconditioner == "none":
        raise InputError(
            f"⟨design.network⟩ {network} begins from its own initial state; a start surface needs network none, or"
            " ⟨+design.preconditioner⟩ laplacian, which counts from one"
        )
    shape, laplacian = architecture or Architecture(), preconditioner == "laplacian"
    return NetworkHeights(low, high, network, degree, initial, seed, shape, inputs, start, laplacian)
