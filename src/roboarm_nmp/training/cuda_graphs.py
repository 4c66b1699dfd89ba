"""Updates as CUDA graphs: a GPU repeats all kernels of an update at a single launch.

An update of small networks consists of hundreds of kernels of a few microseconds, and their
launches from Python take longer than their work. `graphed(update, device)` makes one launch of a
function that does the same at every call: it reads nothing but tensors that stay where they are,
it has no `.item()`, and nothing on the CPU depends on its results. On a CPU nothing changes.
"""

import warnings
from collections.abc import Callable, Iterable

import numpy as np
import torch

WARM_UP = 3  # ordinary calls before a capture, in which libraries and optimisers allocate


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


def graphed(function: Callable[[dict], dict], device: torch.device) -> Callable[[dict], dict]:
    """A function from a dict of tensors, always of the same shapes, to such a dict, as a graph.

    What it returns is overwritten by its next call.
    """
    if device.type != "cuda":
        return function
    stream = torch.cuda.Stream()
    graph = torch.cuda.CUDAGraph()
    inputs, outputs = {}, {}
    calls = 0

    def call(tensors):
        nonlocal inputs, outputs, calls
        calls += 1
        if calls <= WARM_UP:  # on the stream of the capture, as PyTorch demands
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream), warnings.catch_warnings():
                warnings.filterwarnings("ignore", message=".*capturable=True.*")
                outputs = {name: one.detach() for name, one in function(tensors).items()}
            torch.cuda.current_stream().wait_stream(stream)
            return outputs
        if not inputs:
            inputs = {name: tensor.clone() for name, tensor in tensors.items()}
            with torch.cuda.graph(graph, stream=stream):
                outputs = {name: one.detach() for name, one in function(inputs).items()}
        for name, tensor in inputs.items():
            tensor.copy_(tensors[name])
        graph.replay()
        return outputs

    return call


def to_device(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """A NumPy array as a tensor on the device; on a GPU without waiting for the copy."""
    tensor = torch.as_tensor(array)
    if device.type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)
