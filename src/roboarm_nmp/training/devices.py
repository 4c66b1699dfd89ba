"""PyTorch on a CPU or a GPU: seeds, optimisers, copies."""

import os
from collections.abc import Iterable
from typing import Any

import llvmlite.binding
import numpy as np
import torch
from torch.utils import deterministic


def seed_torch(args: Any) -> torch.device:
    """Seed PyTorch with `args.seed` and make it deterministic. Returns `args.device`."""
    if "OMP_NUM_THREADS" not in os.environ:  # one thread is fastest for small networks
        torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # or cuBLAS is not deterministic
    torch.use_deterministic_algorithms(True)
    # Otherwise, deterministic mode also fills every new tensor with NaN, a check that costs time.
    deterministic.fill_uninitialized_memory = False  # pyright: ignore[reportAttributeAccessIssue]
    return torch.device(args.device)


def has_fast_bfloat16() -> bool:
    """Whether a CPU is faster in bfloat16: with AMX, and AMD's with AVX512-BF16.

    Intel's that have only AVX512-BF16 take twice as long as in float32.
    """
    amd = llvmlite.binding.get_host_cpu_name().startswith("znver")
    return torch.cpu._is_amx_tile_supported() or (amd and torch.cpu._is_avx512_bf16_supported())


def adam(parameters: Iterable, rate: float, device: torch.device) -> torch.optim.Adam:
    """Fused Adam; on a GPU, one whose step and learning rate may be part of a graph."""
    if device.type != "cuda":
        return torch.optim.Adam(parameters, lr=rate, fused=True)
    tensor = torch.tensor(rate, device=device)  # a graph would repeat a number
    return torch.optim.Adam(parameters, lr=tensor, fused=True, capturable=True)


def set_learning_rate(optimizer: torch.optim.Optimizer, value: float) -> None:
    """Change the learning rate, also of the graphs that have the optimiser's steps in them."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], torch.Tensor):
            group["lr"].fill_(value)
        else:
            group["lr"] = value


def to_device(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """A NumPy array as a tensor on the device; on a GPU without waiting for the copy."""
    tensor = torch.as_tensor(array)
    if device.type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)
