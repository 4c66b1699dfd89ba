"""Updates as CUDA graphs: a GPU repeats all kernels of an update at a single launch.

An update of small networks consists of hundreds of kernels of a few microseconds, and their
launches from Python take longer than their work. `graphed(update, device)` makes one launch of a
function that does the same at every call: it reads nothing but tensors that stay where they are,
it has no `.item()`, and nothing on the CPU depends on its results. On a CPU nothing changes.
"""

import warnings
from collections.abc import Callable

import torch

WARM_UP = 3  # ordinary calls before a capture, in which libraries and optimisers allocate


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
