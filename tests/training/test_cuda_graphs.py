"""training/cuda_graphs.py, with a stand-in for CUDA's graphs. (On a GPU: test_devices.py.)"""

import contextlib
from types import SimpleNamespace

import pytest
import torch

from roboarm_nmp.training import cuda_graphs

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


class Stream:
    def wait_stream(self, other):
        pass


class Graph:
    """Replays what was called during its capture: here the function, into the same outputs."""

    def replay(self):
        for name, value in self.function(self.inputs, *self.options).items():
            self.outputs[name].copy_(value.detach())


@pytest.fixture
def graphs(monkeypatch):
    """The graphs that were captured."""
    captured = []
    fake = SimpleNamespace(CUDAGraph=Graph, Stream=Stream, current_stream=Stream)
    fake.stream = lambda _: contextlib.nullcontext()

    @contextlib.contextmanager
    def graph(one, stream):
        assert isinstance(stream, Stream)
        captured.append(one)
        yield

    fake.graph = graph
    monkeypatch.setattr(cuda_graphs.torch, "cuda", fake)
    capture = cuda_graphs.Graphed._capture

    def capture_and_note(self, tensors, options):
        one, inputs, outputs = capture(self, tensors, options)
        one.function, one.options, one.inputs, one.outputs = (
            self._function,
            options,
            inputs,
            outputs,
        )
        return one, inputs, outputs

    monkeypatch.setattr(cuda_graphs.Graphed, "_capture", capture_and_note)
    return captured


def test_graph_receives_new_tensors_and_each_combination_of_options_has_its_own(graphs):
    weight, seen = torch.ones(3, requires_grad=True), []

    def function(batch, negative):
        seen.append(batch["x"].data_ptr())
        sign = -1 if negative else 1
        return {"sum": (sign * weight * batch["x"]).sum(), "shifted": weight + batch["y"]}

    learn = cuda_graphs.graphed(function, SimpleNamespace(compile=True), CUDA)
    for count in range(12):
        negative = count % 2 == 0
        given = {"x": torch.full((3,), float(count)), "y": torch.full((3,), count)}
        result = learn(given, negative)
        assert result["sum"].item() == (-3 if negative else 3) * count
        assert result["shifted"].tolist() == [count + 1.0] * 3
        assert not result["sum"].requires_grad
    assert len(graphs) == 2
    assert len(set(seen[-2:])) == 2  # each graph reads tensors of its own


@pytest.mark.parametrize(("compiles", "device"), [(True, CPU), (False, CUDA)])
def test_without_graphs_the_function_and_a_plain_adam_are_used(compiles, device):
    args, parameter = SimpleNamespace(compile=compiles), torch.zeros(2, requires_grad=True)
    assert cuda_graphs.graphed(print, args, device) is print
    optimizer = cuda_graphs.adam([parameter], 0.5, args, device)
    (group,) = optimizer.param_groups
    assert group["lr"] == 0.5 and group["fused"] and not group["capturable"]
    cuda_graphs.set_learning_rate(optimizer, 0.25)
    assert group["lr"] == 0.25


def test_learning_rate_of_a_graph_changes_in_place():
    rate = torch.tensor(0.5)
    optimizer = torch.optim.Adam([torch.zeros(2, requires_grad=True)], lr=rate, capturable=True)
    cuda_graphs.set_learning_rate(optimizer, 0.25)
    assert optimizer.param_groups[0]["lr"] is rate and rate == 0.25
