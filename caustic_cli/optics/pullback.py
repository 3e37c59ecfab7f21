"""Derivatives by the inputs of a function from those by its outputs: the vector-Jacobian product."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


class _Contracted(torch.autograd.Function):
    """A number whose derivatives by tensors are those given."""

    @staticmethod
    def forward(ctx, by: Sequence[Tensor], *outputs: Tensor) -> Tensor:
        ctx.by = by
        return torch.zeros((), dtype=torch.float64, device=outputs[0].device)

    @staticmethod
    def backward(ctx, *_):
        return None, *ctx.by


def pull_back(outputs: Sequence[Tensor], inputs: Sequence[Tensor], by: Sequence[Tensor]) -> tuple[Any, ...]:
    """Derivatives by `inputs` from those `by` the outputs, of their shapes; None where no output depends on an input.

    As `torch.autograd.grad` with `grad_outputs`, for which torch 2.13 first loads SymPy: 0.4 s of a design.
    """
    with torch.enable_grad():  # also within the derivative of another function
        whole = _Contracted.apply(list(by), *outputs)
    return torch.autograd.grad(whole, list(inputs), allow_unused=True)
