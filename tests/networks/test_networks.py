"""Saving and loading networks: the same results for any batch size, and never a stranger's code."""

import json
import math
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import onnx.parser
import pytest
import torch
from torch import nn

from roboarm_nmp.networks import untrusted
from roboarm_nmp.networks.export import read_weights, save_network, to_float16
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.networks.untrusted import NetworkError


@pytest.fixture(scope="module", autouse=True)
def exports_once():
    """Not here (tests/conftest.py)."""


class Actor(nn.Module):
    """An actor with most of what an MLP policy may use."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(16, 64), nn.LayerNorm(64), nn.ReLU(), nn.Dropout(0.5), nn.Linear(64, 7)
        )
        self.register_buffer("scale", torch.full((7,), 0.06))

    def forward(self, observation, achieved_goal, desired_goal):
        x = torch.cat([observation, achieved_goal, desired_goal - achieved_goal], -1)
        action = torch.tanh(self.net(x)) * self.scale * torch.tensor([0.5])
        length = action.norm(dim=-1, keepdim=True)
        return action / torch.clamp(length / 0.03, min=1.0)


class ConvNet(nn.Module):
    """Images (N, 3, 32, 32) as bytes -> features; with a size that depends on the batch."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Conv2d(3, 8, 4, 2, 1), nn.BatchNorm2d(8), nn.ReLU())
        self.head = nn.Sequential(nn.GroupNorm(2, 8), nn.ELU(), nn.Flatten())

    def forward(self, image):
        x = self.net(image.float() / 255)
        pixels = x.permute(0, 2, 3, 1).reshape(-1, 8)
        again = pixels.view(x.shape[0], 16, 16, 8).permute(0, 3, 1, 2)
        return self.head(again), torch.sigmoid(x), x.mean((2, 3))


class Points(nn.Module):
    """Points (N, p, 3), for any p, nearest ones first -> the three smallest distances (N, 3)."""

    def forward(self, points, limit):
        distances = torch.cdist(points, points.mean(1, keepdim=True)).squeeze(2)
        nearest = distances.topk(3, dim=1, largest=False)
        return torch.where(nearest.values < limit, nearest.values, limit)


def _inputs(rows, generator=None):
    sizes = {"observation": 10, "achieved_goal": 3, "desired_goal": 3}
    return {name: torch.randn(rows, size, generator=generator) for name, size in sizes.items()}


ARCHITECTURES = {
    "actor": (Actor, ["action"], _inputs),
    "conv": (
        ConvNet,
        ["code", "pixels", "mean"],
        lambda n: {"image": torch.randint(0, 255, (n, 3, 32, 32)).byte()},
    ),
    "points": (
        Points,
        ["distances"],
        lambda n: {"points": torch.rand(n, 9, 3), "limit": torch.rand(n, 1)},
    ),
}


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_loaded_network_computes_the_same_as_its_module_for_any_batch(name, tmp_path):
    torch.manual_seed(0)
    make, outputs, inputs = ARCHITECTURES[name]
    module = make().eval()
    metadata = {"kind": name, "env": {"max_step": 0.03, "encoder": None}}
    save_network(tmp_path / "net.onnx", module, inputs(1), metadata, outputs)
    network = load_network(tmp_path / "net.onnx")
    assert network.metadata == metadata
    assert list(network.inputs) == list(inputs(1)) and list(network.outputs) == outputs
    assert all(shape[0] is None for shape in network.inputs.values())
    for rows in (1, 2, 7, 32):
        batch = inputs(rows)
        with torch.no_grad():
            expected = module(**batch)
        got = network(**batch)
        arrays = network(**{name: tensor.numpy() for name, tensor in batch.items()})
        if len(outputs) == 1:
            got, arrays, expected = [got], [arrays], [expected]
        for ours, array, theirs in zip(got, arrays, expected, strict=True):
            assert ours.dtype == theirs.dtype and not ours.requires_grad
            np.testing.assert_allclose(array, theirs.numpy(), rtol=1e-6, atol=1e-6)
            assert np.array_equal(ours.numpy(), array)


def test_size_of_an_axis_may_vary_if_it_is_named(tmp_path):
    inputs = {"points": torch.rand(2, 9, 3), "limit": torch.rand(2, 1)}
    more = {"points": torch.rand(2, 40, 3), "limit": torch.rand(2, 1)}
    save_network(tmp_path / "net.onnx", Points(), inputs, {}, ["d"], {"points": [1]})
    network = load_network(tmp_path / "net.onnx")
    assert network.inputs == {"points": (None, None, 3), "limit": (None, 1)}
    assert torch.allclose(network(**more), Points()(**more), rtol=0, atol=1e-6)


def test_networks_do_not_depend_on_torch_defaults(tmp_path, torch_default):
    """Saved, loaded and called under another default dtype or device, they compute the same."""
    module, batch = Actor().eval(), _inputs(3)
    save_network(tmp_path / "net.onnx", module, batch, {}, ["action"])
    expected = load_network(tmp_path / "net.onnx")(**batch)
    with torch_default():
        save_network(tmp_path / "again.onnx", module, batch, {}, ["action"])
        for name in ("net.onnx", "again.onnx"):
            action = load_network(tmp_path / name)(**batch)
            assert action.dtype == expected.dtype and torch.equal(action, expected)


def test_float16_network_computes_in_float32_from_rounded_numbers(tmp_path):
    module, batch = Actor().eval(), _inputs(5)
    save_network(tmp_path / "net.onnx", module, batch, {"kind": "policy"}, ["action"])
    to_float16(tmp_path / "net.onnx", tmp_path / "half.onnx")
    for tensor in module.parameters():
        if tensor.numel() >= 64:
            tensor.data.copy_(tensor.half().float())
    network = load_network(tmp_path / "half.onnx")
    with torch.no_grad():
        assert torch.allclose(network(**batch), module(**batch), rtol=0, atol=1e-6)
    assert network.metadata == {"kind": "policy"}
    nn.init.constant_(module.net[1].bias, 1e5)
    save_network(tmp_path / "large.onnx", module, batch, {}, ["action"])
    with pytest.raises(NetworkError, match=r"large.onnx: .*bias has numbers too large for float16"):
        to_float16(tmp_path / "large.onnx", tmp_path / "half2.onnx")


def test_weights_can_be_read_by_the_names_that_pytorch_gives_them(tmp_path):
    module = Actor()
    save_network(tmp_path / "net.onnx", module, _inputs(2), {}, ["action"])
    weights = read_weights(tmp_path / "net.onnx")
    for name, tensor in module.named_parameters():
        assert np.array_equal(weights[name], tensor.detach().numpy())


class _Branches(nn.Module):
    def forward(self, x):
        return x if x.sum() > 0 else -x


class _Random(nn.Module):
    def forward(self, x):
        return x + torch.randn_like(x)


@pytest.mark.parametrize(
    ("make", "reason"),
    [(_Branches, "data-dependent"), (_Random, "the operator RandomNormalLike is not allowed")],
)
def test_module_that_cannot_be_exported_is_rejected_and_the_old_file_stays(make, reason, tmp_path):
    path = tmp_path / "net.onnx"
    path.write_text("old")
    with pytest.raises(NetworkError, match="net.onnx") as caught:
        save_network(path, make(), {"x": torch.ones(2, 3)}, {}, ["y"])
    assert reason in str(caught.value) and len(str(caught.value)) < 500
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["net.onnx"]


@pytest.fixture(scope="module")
def actor_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "actor.onnx"
    save_network(path, Actor(), _inputs(2), {"kind": "policy"}, ["action"])
    return path


@pytest.fixture
def saved(actor_file, tmp_path):
    """A good network file, to be damaged."""
    return Path(shutil.copy(actor_file, tmp_path))


def test_inputs_are_checked_when_it_is_called(saved):
    network = load_network(saved)
    inputs = _inputs(2)
    with pytest.raises(
        NetworkError, match=r"actor.onnx: its inputs are observation, achieved_goal"
    ):
        network(observation=inputs["observation"])
    with pytest.raises(NetworkError, match=r"actor.onnx: .*observation"):
        network(**(inputs | {"observation": torch.zeros(2, 11)}))
    with pytest.raises(NetworkError, match=r"actor.onnx: .*double"):
        network(**{name: tensor.double() for name, tensor in inputs.items()})
    with pytest.raises(NetworkError, match=r"actor.onnx: "):
        network(**(inputs | {"observation": torch.zeros(3, 10)}))
    with pytest.raises(NetworkError, match="actor.onnx: .*NoExecutionProvider"):
        load_network(saved, provider="NoExecutionProvider")


def _model(nodes, stored="", x="float[N, 3]", imports="", functions=""):
    """A model from `x` to `y`, in ONNX's text format."""
    return onnx.parser.parse_model(
        f'<ir_version: 10, opset_import: ["": 20{imports}]> '
        f"main ({x} x) => (float[] y) <{stored}> {{ {nodes} }} {functions}"
    )


def _zeros(*sizes):
    return f"float[{', '.join(map(str, sizes))}] w = {{{', '.join('0' * math.prod(sizes))}}}"


# Of each: what the message says, and arguments of `_model`.
HOSTILE = {
    "external": (
        "its tensors are in another file",
        "y = Add(x, w)",
        'float[3] w = ["location": "secret"]',
    ),
    "billion rounds": (
        "the operator Loop is not allowed",
        "y = Loop(rounds, go, x) <body = body (int64 i, bool go, float[M, 3] v) =>"
        "(bool go_on, float[M, 3] w) { go_on = Identity(go) w = Sin(v) }>",
        "int64 rounds = {1000000000}, bool go = {1}",
    ),
    "custom": (
        "the operator com.example.Evil is not allowed",
        "y = com.example.Evil(x)",
        "",
        "float[N, 3]",
        ', "com.example": 1',
    ),
    "function": (
        "it holds functions",
        "y = Abs(x)",
        "",
        "float[N, 3]",
        "",
        '<domain: "", opset_import: ["": 20]> Abs (a) => (b) { b = Neg(a) }',
    ),
    # Without inputs, so that it would be computed when the file is loaded.
    "filled": (
        "ConstantOfShape computes more than 16,777,216 numbers",
        "big = ConstantOfShape(size) sum = ReduceSum<keepdims = 0>(big) y = Add(x, sum)",
        "int64[2] size = {1048576, 1048576}",
    ),
    "large products": (
        "it computes too much",
        "a = Expand(one, size) b = MatMul(a, a) c = MatMul(b, b) d = MatMul(c, c)"
        "e = MatMul(d, d) max = ReduceMax<keepdims = 0>(e) y = Add(x, max)",
        "float one = {1}, int64[2] size = {4096, 4096}",
    ),
    # The process would end.
    "integer by zero": (
        "it divides integers",
        "i = Cast<to = 7>(x) j = Div(i, zero) y = Cast<to = 1>(j)",
        "int64 zero = {0}",
    ),
    "axis": ("LayerNormalization has a wrong axis", "y = LayerNormalization<axis = 2147483648>(x)"),
    "negative input": ("the size of x is not positive", "y = Abs(x)", "", "float[-1, 3]"),
    # A small image and a small result; between them, a matrix of gigabytes.
    "patches": (
        "it computes too much",
        "image = Expand(x, size) y = ConvTranspose<pads = [250, 250, 250, 250]>(image, w)",
        f"int64[4] size = {{1, 1, 512, 512}}, {_zeros(1, 1, 40, 40)}",
        "float[N, 1]",
    ),
    # Which of the two would be the size?
    "two of a name": (
        "a result of Constant has the name of another tensor",
        "size = Constant<value = int64[1] {1099511627776}>() big = Expand(one, size)"
        "max = ReduceMax<keepdims = 0>(big) y = Add(x, max)",
        "int64[1] size = {1}, float one = {1}",
    ),
    "size from a value": (
        "the shape of a result of ConstantOfShape depends on values",
        "i = Cast<to = 7>(x) size = Squeeze(i, axis) y = ConstantOfShape(size)",
        "int64[1] axis = {0}",
    ),
    "many": (
        "it has 25,001 operators, not 1 to 10,000",
        "v0 = Abs(x) " + "".join(f"v{i + 1} = Abs(v{i}) " for i in range(24_999)) + "y = Abs(v9)",
    ),
    "incomplete": ("damaged", "y = Gather(w, i)", "float[1000] w = {0}, int64[1] i = {0}"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_networks_are_rejected_before_they_run(name, tmp_path):
    reason, *arguments = HOSTILE[name]
    path = tmp_path / "net.onnx"
    path.write_bytes(_model(*arguments).SerializeToString())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    with pytest.raises(NetworkError, match=rf"net.onnx: .*({reason})"):
        load_network(path)
    assert time.process_time() - start < 5
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1_000_000  # kB


def _field(number, content):
    """A field of a protobuf message: its number, its length, and its content."""
    length = len(content)
    sizes = bytearray()
    while length > 127:
        sizes.append(length & 127 | 128)
        length >>= 7
    return bytes([number << 3 | 2, *sizes, length]) + content


def _nested():
    """Graphs as attributes of operators, a thousand of them one in the other."""
    graph = b""
    for _ in range(1_000):
        graph = _field(1, _field(5, _field(6, graph)))
    return graph


# Millions of empty operators, and of numbers in one tensor.
BOMBS = {
    "operators": lambda: _field(1, b"") * 40_000_000,
    "nested": _nested,
    "numbers": lambda: _field(5, _field(7, bytes(80_000_000))),
}


LOAD = """
import json, sys, time
from roboarm_nmp.networks.network_file import load_network
try:
    load_network(sys.argv[1])
    error = ""
except ValueError as caught:
    error = str(caught)
[peak] = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
print(json.dumps([error, time.process_time(), int(peak.split()[1]) / 1e6]))
"""


@pytest.mark.parametrize("name", BOMBS)
def test_files_that_would_fill_the_memory_are_rejected(name, tmp_path):
    path = tmp_path / "bomb.onnx"
    path.write_bytes(_field(7, BOMBS[name]()))
    process = subprocess.run(
        [sys.executable, "-c", LOAD, str(path)], capture_output=True, text=True, check=True
    )
    error, seconds, gigabytes = json.loads(process.stdout)
    assert "bomb.onnx: " in error and len(error) < 400
    assert seconds < 5 and gigabytes < 1


def test_huge_file_is_rejected(tmp_path):
    with open(tmp_path / "huge.onnx", "wb") as file:
        file.truncate(10**12)
    with pytest.raises(NetworkError, match="huge.onnx: "):
        load_network(tmp_path / "huge.onnx")


def test_further_operator_can_be_allowed_by_name(tmp_path, monkeypatch):
    path = tmp_path / "net.onnx"
    path.write_bytes(_model("y = Cosh(x)").SerializeToString())
    with pytest.raises(NetworkError, match="the operator Cosh is not allowed"):
        load_network(path)
    monkeypatch.setattr(untrusted, "OPERATORS", untrusted.OPERATORS | {"Cosh"})
    x = torch.rand(2, 3)
    assert torch.allclose(load_network(path)(x=x), x.cosh())


def test_damaged_and_foreign_files_are_rejected(saved, tmp_path):
    whole = saved.read_bytes()
    tail = len(whole) - 40
    cases = {
        "empty": b"",
        "truncated": whole[: len(whole) // 2],
        "cut": whole[:tail],
        "text": b"policy: none\n" * 100,
        "zip": b"PK\x03\x04" + whole,
        "noise": np.random.default_rng(0).bytes(10_000),
    }
    for name, content in cases.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(NetworkError, match=name):
            load_network(path)
    with pytest.raises(NetworkError, match="missing: cannot be read: No such file"):
        load_network(tmp_path / "missing")
    with pytest.raises(NetworkError, match="cannot be read: Is a directory"):
        load_network(tmp_path)
