"""training/cuda_graphs.py without CUDA. (On a GPU: test_devices.py.)"""

from types import SimpleNamespace

import pytest
import torch

from roboarm_nmp.training import cuda_graphs

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


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
