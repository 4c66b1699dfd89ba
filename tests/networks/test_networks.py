"""Saving and loading networks: the same results for any batch size, and never a stranger's code."""

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from torch import nn

from roboarm_nmp.networks import untrusted
from roboarm_nmp.networks.export import read_weights, save_network, to_float16
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.networks.untrusted import NetworkError


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


def _model(nodes, tensors=(), shape=("N", 3), opset=20):
    """A model from `x` to `y`, made by hand."""
    graph = helper.make_graph(
        nodes,
        "main",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        list(tensors),
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=10)


def _constant(name, values, dtype=np.int64):
    return onnx.numpy_helper.from_array(np.array(values, dtype), name)


def _external(folder):
    (folder / "secret").write_bytes(bytes(12))
    tensor = _constant("w", np.zeros(3), np.float32)
    onnx.external_data_helper.set_external_data(tensor, "secret")
    tensor.ClearField("raw_data")
    return _model([helper.make_node("Add", ["x", "w"], ["y"])], [tensor])


def _loop(folder):
    """A billion rounds."""
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["go_on"]),
            helper.make_node("Sin", ["v"], ["w"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("v", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("w", TensorProto.FLOAT, None),
        ],
    )
    loop = helper.make_node("Loop", ["number", "true", "x"], ["y"], body=body)
    return _model([loop], [_constant("number", 10**9), _constant("true", True, bool)])


def _custom(folder):
    return _model([helper.make_node("Evil", ["x"], ["y"], domain="com.example")])


def _function(folder):
    model = _model([helper.make_node("Abs", ["x"], ["y"])])
    abs_node = helper.make_node("Neg", ["a"], ["b"])
    imports = [helper.make_opsetid("", 20)]
    model.functions.append(helper.make_function("", "Abs", ["a"], ["b"], [abs_node], imports))
    return model


def _filled(folder):
    """Without inputs, so that it would be computed when the file is loaded."""
    nodes = [
        helper.make_node("ConstantOfShape", ["size"], ["big"]),
        helper.make_node("ReduceSum", ["big"], ["sum"], keepdims=0),
        helper.make_node("Add", ["x", "sum"], ["y"]),
    ]
    return _model(nodes, [_constant("size", [2**20, 2**20])])


def _expanded(folder):
    nodes = [
        helper.make_node("Expand", ["x", "size"], ["big"]),
        helper.make_node("ReduceMax", ["big"], ["y"], keepdims=0),
    ]
    return _model(nodes, [_constant("size", [2**20, 2**14, 3])])


def _slow(folder):
    """Large products, each of small tensors."""
    nodes = [helper.make_node("Expand", ["one", "size"], ["a0"])]
    nodes += [helper.make_node("MatMul", [f"a{i}", f"a{i}"], [f"a{i + 1}"]) for i in range(7)]
    nodes += [helper.make_node("ReduceMax", ["a7"], ["max"], keepdims=0)]
    nodes += [helper.make_node("Add", ["x", "max"], ["y"])]
    return _model(nodes, [_constant("one", 1, np.float32), _constant("size", [4096, 4096])])


def _divided(folder):
    """An integer by zero: the process would end."""
    nodes = [
        helper.make_node("Cast", ["x"], ["i"], to=TensorProto.INT64),
        helper.make_node("Div", ["i", "zero"], ["j"]),
        helper.make_node("Cast", ["j"], ["y"], to=TensorProto.FLOAT),
    ]
    return _model(nodes, [_constant("zero", 0)])


def _data_dependent(folder):
    nodes = [
        helper.make_node("Cast", ["x"], ["i"], to=TensorProto.INT64),
        helper.make_node("Squeeze", ["i", "axis"], ["size"]),
        helper.make_node("ConstantOfShape", ["size"], ["y"]),
    ]
    return _model(nodes, [_constant("axis", [0])])


def _many(folder):
    nodes = [helper.make_node("Abs", [f"v{i}" if i else "x"], [f"v{i + 1}"]) for i in range(25_000)]
    return _model([*nodes, helper.make_node("Abs", ["v25000"], ["y"])])


def _incomplete(folder):
    tensor = _constant("w", np.zeros(1_000), np.float32)
    tensor.dims[0] = 2**24
    return _model([helper.make_node("Gather", ["w", "i"], ["y"])], [tensor, _constant("i", [0])])


def _inconsistent(folder):
    weights = _constant("w", np.zeros((4, 4)), np.float32)
    return _model([helper.make_node("MatMul", ["x", "w"], ["y"])], [weights])


def _one(operator, *sizes, outputs=("y",), **attributes):
    """A model of one operator: of `x` and of stored tensors of some sizes."""
    tensors = [_constant(f"w{i}", np.zeros(size), np.float32) for i, size in enumerate(sizes)]
    names = ["x", *(tensor.name for tensor in tensors)]
    return _model([helper.make_node(operator, names, outputs, **attributes)], tensors)


def _axis(folder):
    return _one("LayerNormalization", 3, outputs=("y", "mean"), axis=2**31)


def _missing(folder):
    model = _one("LayerNormalization", 3)
    model.graph.node[0].input.append("")
    return model


def _outputs(folder):
    return _one("Split", outputs=("y", "z", "w"), axis=1, num_outputs=1)


def _negative(folder):
    nodes = [helper.make_node("GatherND", ["x", "indices"], ["y"], batch_dims=-(2**31))]
    return _model(nodes, [_constant("indices", [[0]])])


def _negative_input(folder):
    nodes = [helper.make_node("Slice", ["x", "from", "to"], ["y"])]
    return _model(nodes, [_constant("from", [0]), _constant("to", [1])], shape=(-1, 3))


def _text(folder):
    return _one("Cast", to=TensorProto.STRING)


def _read(folder):
    """Little is computed, but from much, and again and again."""
    nodes = [helper.make_node("Expand", ["x", "size"], ["big"])]
    nodes += [helper.make_node("ReduceLogSumExp", ["big"], [f"v{i}"]) for i in range(1_000)]
    nodes += [helper.make_node("Max", [f"v{i}" for i in range(1_000)], ["y"])]
    return _model(nodes, [_constant("size", [2**20, 3])])


def _long(folder):
    """A vector, which ONNX could take for sizes, of a hundred bytes each."""
    nodes = [helper.make_node("Expand", ["one", "size"], ["v0"])]
    nodes += [helper.make_node("Add", [f"v{i}", f"v{i}"], [f"v{i + 1}"]) for i in range(9)]
    return _model(
        [*nodes, helper.make_node("ReduceMax", ["v9"], ["y"])],
        [_constant("one", [1]), _constant("size", [2**22])],
    )


def _patches(folder):
    """A small image and a small result; between them, a matrix of gigabytes."""
    nodes = [
        helper.make_node("Expand", ["x", "size"], ["image"]),
        helper.make_node("ConvTranspose", ["image", "w"], ["y"], pads=[250] * 4),
    ]
    weights = _constant("w", np.zeros((1, 1, 40, 40)), np.float32)
    return _model(nodes, [_constant("size", [1, 1, 512, 512]), weights], shape=("N", 1))


def _renamed(folder):
    """A result with the name of a stored tensor: which of them would be the size?"""
    value = _constant("", [2**40])
    nodes = [
        helper.make_node("Constant", [], ["size"], value=value),
        helper.make_node("Expand", ["one", "size"], ["big"]),
        helper.make_node("ReduceMax", ["big"], ["max"], keepdims=0),
        helper.make_node("Add", ["x", "max"], ["y"]),
    ]
    return _model(nodes, [_constant("size", [1]), _constant("one", 1, np.float32)])


HOSTILE = {
    _external: "its tensors are in another file",
    _loop: "the operator Loop is not allowed",
    _custom: "the operator com.example.Evil is not allowed",
    _function: "it holds functions",
    _filled: "ConstantOfShape computes more than 16,777,216 numbers",
    _expanded: "Expand computes more than 16,777,216 numbers",
    _slow: "it computes too much",
    _divided: "it divides integers",
    _axis: "LayerNormalization has a wrong axis",
    _missing: "LayerNormalization lacks an input",
    _outputs: "Split has a wrong num_outputs",
    _negative: "GatherND has a wrong batch_dims",
    _negative_input: "the size of x is not positive",
    _text: "it holds text",
    _read: "it computes too much",
    _long: "it computes too much",
    _patches: "it computes too much",
    _renamed: "a result of Constant has the name of another tensor",
    _data_dependent: "the shape of a result of ConstantOfShape depends on values",
    _many: "it has 25,001 operators, not 1 to 10,000",
    _incomplete: "damaged",
    _inconsistent: "damaged",
}


@pytest.mark.parametrize("make", HOSTILE, ids=lambda make: make.__name__.strip("_"))
def test_hostile_networks_are_rejected_before_they_run(make, tmp_path):
    path = tmp_path / "net.onnx"
    path.write_bytes(make(tmp_path).SerializeToString())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    with pytest.raises(NetworkError, match=rf"net.onnx: .*({HOSTILE[make]})"):
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


# Millions of empty operators, of attributes of one operator, and of numbers in one tensor.
BOMBS = {
    "operators": lambda: _field(1, b"") * 40_000_000,
    "attributes": lambda: _field(1, _field(5, b"") * 40_000_000),
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
    path.write_bytes(_model([helper.make_node("Cosh", ["x"], ["y"])]).SerializeToString())
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
