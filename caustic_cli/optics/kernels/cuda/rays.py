"""CUDA kernels of the stages ray by ray: refraction, reflection and transfer to a plane, with adjoint.

The functions of `kernels.refraction`, `kernels.mirror` and `kernels.transfer`, a batch of one ray at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from numba import cuda, float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import mirror, refraction, transfer
from caustic_cli.optics.kernels.axial_refraction import FRESNEL
from caustic_cli.optics.kernels.cuda.launch import device, start

refract_batch, refract_pull = device(refraction.refract_batch), device(refraction.pull_batch)
mirror_batch, mirror_pull = device(mirror.reflect_batch), device(mirror.pull_batch)
land_batch, land_pull = device(transfer.land_batch), device(transfer.pull_batch)
#: Rows of a batch's scratch, as numba wants the sizes of local arrays: names of numbers.
REFRACTION, MIRROR, TRANSFER = refraction.ROWS, mirror.ROWS, transfer.ROWS


@cuda.jit
def _refract(count, ray, surface, out, passes):
    v, (tx, ty, tz, after) = cuda.local.array((REFRACTION, 1), float64), out
    for k in range(cuda.grid(1), count, cuda.gridsize(1)):
        refract_batch(v, k, 1, ray, surface, (tx, ty, tz), after, passes)


@cuda.jit
def _refract_adjoint(count, ray, surface, given, out):
    v = cuda.local.array((REFRACTION, 1), float64)
    for k in range(cuda.grid(1), count, cuda.gridsize(1)):
        refract_pull(v, k, 1, ray, surface, given, out)


@cuda.jit
def _reflect(count, ray, surface, out, passes):
    v = cuda.local.array((MIRROR, 1), float64)
    for k in range(cuda.grid(1), count, cuda.gridsize(1)):
        mirror_batch(v, k, 1, ray, out)
        passes[k] = True


@cuda.jit
def _reflect_adjoint(count, ray, surface, given, out):
    v = cuda.local.array((MIRROR, 1), float64)
    for k in range(cuda.grid(1), count, cuda.gridsize(1)):
        mirror_pull(v, k, 1, ray, given, out)


@cuda.jit
def _land(count, ray, surface, out, on_way):
    v, (x, y) = cuda.local.array((TRANSFER, 1), float64), out
    for k in range(cuda.grid(1), count, cuda.gridsize(1)):
        land_batch(v, k, 1, ray, surface, x, y, on_way)


@cuda.jit
def _land_adjoint(count, ray, surface, given, out):
    v = cuda.local.array((TRANSFER, 1), float64)
    for k in range(cuda.grid(1), count, cuda.gridsize(1)):
        land_pull(v, k, 1, ray, surface, given, out)


class RayStage(NamedTuple):
    """Kernels, number of output components besides a boolean one, and further arguments of the kernels."""

    forward: object
    adjoint: object
    outputs: int
    surface: tuple


def interact(direction, slopes, power: Tensor, *, eta: float, reflects: bool, fresnel: str, field=None):
    """`kernels.interact.interact` of tensors on the device."""
    if reflects:
        *t, passes = _Stage.apply(RayStage(_reflect, _reflect_adjoint, 3, ()), *direction, *slopes)
        return tuple(t), power, passes
    polarised = field is not None and fresnel == "exact"
    surface = refraction.Interface(float(eta), FRESNEL[fresnel], polarised)
    stage = RayStage(_refract, _refract_adjoint, 4, surface)
    *t, after, passes = _Stage.apply(stage, *direction, *slopes, power, *(field if polarised else (0.0, 0.0, 0.0)))
    return tuple(t), after, passes


def land(origin, direction, point, axes, forward: float) -> tuple[Tensor, Tensor, Tensor]:
    """`kernels.transfer.land` of tensors on the device."""
    plane = transfer.TargetPlane._make([*(float(c) for vector in (point, *axes) for c in vector), float(forward)])
    return _Stage.apply(RayStage(_land, _land_adjoint, 2, plane), *origin, *direction)


class _Stage(torch.autograd.Function):
    """A stage and a ray's components, tensors (N,) or numbers for all rays -> its outputs."""

    @staticmethod
    def forward(stage: RayStage, *ray):
        like = _like(ray)
        out = tuple(torch.empty_like(like) for _ in range(stage.outputs))
        held = torch.empty(like.shape, dtype=torch.bool, device=like.device)
        start(stage.forward, len(like), len(like), _components(ray, like), stage.surface, out, held)
        return *out, held

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.stage, *ray = inputs
        tensors = [v if isinstance(v, Tensor) else None for v in ray]
        ctx.save_for_backward(*tensors)
        ctx.numbers = [None if isinstance(v, Tensor) else v for v in ray]
        ctx.mark_non_differentiable(output[-1])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        ray, stage = _kept(ctx), ctx.stage
        like, wanted = _like(ray), ctx.needs_input_grad[1:]
        out = tuple(torch.empty_like(like) if w else like.new_empty(0) for w in wanted)
        start(stage.adjoint, len(like), len(like), _components(ray, like), stage.surface, _components(by[:-1], like), out)
        return None, *(a if w else None for a, w in zip(out, wanted, strict=True))


def _kept(ctx) -> tuple:
    return tuple(n if t is None else t for t, n in zip(ctx.saved_tensors, ctx.numbers, strict=True))


def _like(ray) -> Tensor:
    """A component of all rays, float64."""
    return next(c for c in ray if isinstance(c, Tensor)).detach().double().contiguous()


def _components(values, like: Tensor) -> tuple[Tensor, ...]:
    """(N,) of a tensor, (1,) of a number; None stands for 0."""
    return tuple(
        v.detach().double().contiguous() if isinstance(v, Tensor) else like.new_full((1,), 0.0 if v is None else float(v))
        for v in values
    )
