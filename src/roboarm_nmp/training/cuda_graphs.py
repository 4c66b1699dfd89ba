"""Updates as CUDA graphs: a GPU repeats all kernels of an update at a single launch.

An update of small networks consists of hundreds of kernels of a few microseconds. Their launches
from Python take longer than their work; a graph has one launch.

    optimizer = adam(parameters, 1e-3, args, device)
    learn = graphed(learn, args, device)       # a function of tensors that is called many times
    losses = learn(batch)

A function that becomes a graph does the same at every call: it reads nothing but tensors that stay
where they are, it has no `.item()`, and nothing on the CPU depends on its results. On a CPU
`graphed` returns the function itself.
"""

import collections
import warnings
from collections.abc import Callable, Iterable

import numpy as np
import torch

WARM_UP = 3  # ordinary calls before a capture, in which libraries and optimisers allocate


def uses_graphs(args, device: torch.device) -> bool:
    """Whether updates are graphs: on a GPU, with the flag `--compile`."""
    return args.compile and device.type == "cuda"


def adam(parameters: Iterable, rate: float, args, device: torch.device) -> torch.optim.Adam:
    """Fused Adam; with graphs, one whose step and learning rate may be part of them."""
    if not uses_graphs(args, device):
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


def graphed(function: Callable, args, device: torch.device) -> Callable:
    """The function as a CUDA graph, or the function itself where there are no graphs.

    Args:
        function: from a dict of tensors on the device, and possibly options, to a dict of tensors.
            Shapes must not change from call to call. Each combination of options, hashable, has a
            graph of its own.
        args: the flags, `compile` among them.
        device: of the tensors.
    """
    return Graphed(function) if uses_graphs(args, device) else function


class Graphed:
    """A function whose first calls are ordinary ones, and the later ones replays of a graph.

    What it returns is overwritten by its next call with the same options.
    """

    def __init__(self, function: Callable):
        self._function = function
        self._calls = collections.Counter()
        self._graphs = {}
        self._stream = torch.cuda.Stream()

    def __call__(self, tensors: dict, *options) -> dict:
        if options not in self._graphs:
            if self._calls[options] < WARM_UP:
                return self._warm_up(tensors, options)
            self._graphs[options] = self._capture(tensors, options)
        graph, inputs, outputs = self._graphs[options]
        torch._foreach_copy_(  # pyright: ignore[reportPrivateImportUsage]
            list(inputs.values()), [tensors[name] for name in inputs]
        )
        graph.replay()
        return outputs

    def _warm_up(self, tensors, options):
        """An ordinary call on the stream of the capture, as PyTorch demands."""
        self._calls[options] += 1
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*capturable=True.*")
            outputs = _detached(self._function(tensors, *options))
        torch.cuda.current_stream().wait_stream(self._stream)
        return outputs

    def _capture(self, tensors, options):
        """The graph, the tensors that it reads, and those that it writes."""
        inputs = {name: tensor.clone() for name, tensor in tensors.items()}
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=self._stream):
            outputs = _detached(self._function(inputs, *options))
        return graph, inputs, outputs


def _detached(tensors):
    """Without what backward passes need, which would outlive the call."""
    return {name: tensor.detach() for name, tensor in tensors.items()}


def to_device(array: np.ndarray, device: torch.device | str) -> torch.Tensor:
    """A NumPy array as a tensor on the device; on a GPU without waiting for the copy."""
    tensor = torch.as_tensor(array)
    if torch.device(device).type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)
