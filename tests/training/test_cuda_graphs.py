"""training/cuda_graphs.py without CUDA. (On a GPU: test_devices.py.)"""

import torch

from roboarm_nmp.training import cuda_graphs

CPU = torch.device("cpu")


def test_on_a_cpu_the_function_and_a_plain_adam_are_used():
    assert cuda_graphs.graphed(print, CPU) is print
    optimizer = cuda_graphs.adam([torch.zeros(2, requires_grad=True)], 0.5, CPU)
    (group,) = optimizer.param_groups
    assert group["lr"] == 0.5 and group["fused"] and not group["capturable"]
    cuda_graphs.set_learning_rate(optimizer, 0.25)
    assert group["lr"] == 0.25


def test_learning_rate_of_a_graph_changes_in_place():
    rate = torch.tensor(0.5)
    optimizer = torch.optim.Adam([torch.zeros(2, requires_grad=True)], lr=rate, capturable=True)
    cuda_graphs.set_learning_rate(optimizer, 0.25)
    assert optimizer.param_groups[0]["lr"] is rate and rate == 0.25
