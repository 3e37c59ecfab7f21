"""One design by several processes (`torchrun`): each rank traces its part of the rays, and images and gradients are summed.

All ranks walk through the same design with the same numbers; only what they trace differs.  So whatever depends on a clock or
on a signal is decided by rank 0 for all.  In a single process every function here does nothing.
"""

from __future__ import annotations

import os

import torch
import torch.distributed as dist
from torch import Tensor

from caustic_cli.errors import CausticError


def join(device: str) -> None:
    """Meet the other ranks if torchrun started this process: over gloo on CPUs, over nccl on GPUs, one for each rank."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or "MASTER_ADDR" not in os.environ:
        return
    if not dist.is_available():
        raise CausticError("this torch was built without torch.distributed, which torchrun needs")
    if device == "cuda":
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    dist.init_process_group("nccl" if device == "cuda" else "gloo")


def leave() -> None:
    """Part from the other ranks."""
    if place()[1] > 1:
        dist.destroy_process_group()


def place() -> tuple[int, int]:
    """This process' rank, and how many there are."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank(), dist.get_world_size()
    return 0, 1


def add(*tensors: Tensor) -> None:
    """Replace each tensor by its sum over all ranks; every rank gets the same bits."""
    if place()[1] > 1:
        for tensor in tensors:
            dist.all_reduce(tensor)


def share(*tensors: Tensor) -> None:
    """Replace each tensor by that of rank 0."""
    if place()[1] > 1:
        for tensor in tensors:
            dist.broadcast(tensor, 0)


def agree(answer: bool, device: str | torch.device = "cpu") -> bool:
    """Rank 0's answer."""
    if place()[1] == 1:
        return answer
    said = torch.tensor(int(answer), device=device)
    dist.broadcast(said, 0)
    return bool(said)
