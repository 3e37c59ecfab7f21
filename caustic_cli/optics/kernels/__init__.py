"""Fused CPU kernels behind the functions of `optics`, each tested against its plain-torch reference.

`fused(device)` says whether they are used: on the CPU, unless CAUSTIC_KERNELS=torch asks for the reference.
"""

from __future__ import annotations

import os

import torch


def fused(device: torch.device | str) -> bool:
    """Whether arrays on `device` are handled by the kernels."""
    return torch.device(device).type == "cpu" and os.environ.get("CAUSTIC_KERNELS", "") != "torch"


def blocks() -> int:
    """Blocks of rays with an image of their own: torch's number of threads, so that --threads decides both."""
    return torch.get_num_threads()
