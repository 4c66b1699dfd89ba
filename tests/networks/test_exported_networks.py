"""Saving and loading networks: the same results for any batch size, and never a stranger's code."""

import os
import pickle
import resource
import shutil
import zipfile
from pathlib import Path

import pytest
import torch
from torch import nn

from roboarm_nmp.networks import operations as network_operations
from roboarm_nmp.networks.exported_networks import load_network, save_network, to_float16
from roboarm_nmp.networks.operations import NetworkError


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
        return {"code": self.head(again), "images": [torch.sigmoid(x), x.mean((2, 3))]}


def _inputs(rows, generator=None):
    sizes = {"observation": 10, "achieved_goal": 3, "desired_goal": 3}
    return {name: torch.randn(rows, size, generator=generator) for name, size in sizes.items()}


ARCHITECTURES = {
    "actor": (Actor, lambda n: _inputs(n)),
    "conv": (ConvNet, lambda n: {"image": torch.randint(0, 255, (n, 3, 32, 32)).byte()}),
}


def _leaves(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        return [leaf for one in value for leaf in _leaves(one)]
    return [value]


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_loaded_network_computes_the_same_as_its_module_for_any_batch(name, tmp_path):
    torch.manual_seed(0)
    make, inputs = ARCHITECTURES[name]
    module = make().eval()
    save_network(tmp_path / "net.pt", module, inputs(1), {"kind": name})
    network = load_network(tmp_path / "net.pt")
    assert network.metadata == {"kind": name}
    assert network.inputs == list(inputs(1))
    for rows in (1, 2, 7):
        batch = inputs(rows)
        with torch.no_grad():
            expected = _leaves(module(**batch))
        got = _leaves(network(**batch))
        assert len(got) == len(expected)
        for one, other in zip(got, expected, strict=True):
            assert one.dtype == other.dtype and one.shape == other.shape
            assert not one.requires_grad
            assert torch.allclose(one, other, rtol=0, atol=1e-6)


def test_networks_do_not_depend_on_torch_defaults(tmp_path, torch_default):
    """Saved, loaded and called under another default dtype or device, they compute the same."""
    module, batch = Actor().eval(), _inputs(3)
    save_network(tmp_path / "net.pt", module, batch, {})
    expected = load_network(tmp_path / "net.pt")(**batch)
    with torch_default():
        save_network(tmp_path / "again.pt", module, batch, {})
        for name in ("net.pt", "again.pt"):
            action = load_network(tmp_path / name)(**batch)
            assert action.dtype == expected.dtype and torch.equal(action, expected)


def test_float16_network_computes_in_float32_from_rounded_numbers(tmp_path):
    module, batch = Actor().eval(), _inputs(5)
    save_network(tmp_path / "net.pt", module, batch, {"kind": "policy"})
    to_float16(tmp_path / "net.pt", tmp_path / "half.pt")
    for tensor in module.state_dict().values():
        tensor.copy_(tensor.half().float())
    network = load_network(tmp_path / "half.pt")
    with torch.no_grad():
        assert torch.allclose(network(**batch), module(**batch), rtol=0, atol=1e-6)
    assert network.metadata == {"kind": "policy"}
    nn.init.constant_(module.net[4].bias, 1e5)
    save_network(tmp_path / "large.pt", module, batch, {})
    with pytest.raises(NetworkError, match=r"large.pt: .*bias has numbers too large for float16"):
        to_float16(tmp_path / "large.pt", tmp_path / "half2.pt")


class _Branches(nn.Module):
    def forward(self, x):
        return x if x.sum() > 0 else -x


class _Random(nn.Module):
    def forward(self, x):
        return x + torch.randn_like(x)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (_Branches, "its forward branches on a value (test_exported_networks.py, line "),
        (_Random, "the operation 'aten.randn_like.default' is not allowed"),
    ],
)
def test_module_that_cannot_be_exported_is_rejected_and_the_old_file_stays(make, reason, tmp_path):
    path = tmp_path / "net.pt"
    path.write_text("old")
    with pytest.raises(NetworkError, match="net.pt") as caught:
        save_network(path, make(), {"x": torch.ones(2, 3)}, {})
    assert reason in str(caught.value)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["net.pt"]


@pytest.fixture(scope="module")
def actor_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "actor.pt"
    save_network(path, Actor(), _inputs(2), {"kind": "policy"})
    return path


@pytest.fixture
def saved(actor_file, tmp_path):
    """A good network file, to be damaged."""
    return Path(shutil.copy(actor_file, tmp_path))


def test_inputs_are_checked_when_it_is_called(saved):
    network = load_network(saved)
    inputs = _inputs(2)
    assert torch.equal(network(*inputs.values()), network(**inputs))
    with pytest.raises(NetworkError, match=r"actor.pt: its inputs are observation, achieved_goal"):
        network(observation=inputs["observation"])
    with pytest.raises(NetworkError, match=r"actor.pt: aten.cat.default failed"):
        network(**(inputs | {"observation": torch.zeros(3, 10)}))


class _Malicious:
    """Unpickled by an unsafe reader, this makes a file."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return open, (str(self.target), "w")


def test_file_with_code_in_it_is_rejected_and_runs_nothing(saved, tmp_path):
    target = tmp_path / "made by the file"
    content = torch.load(saved, weights_only=True) | {"metadata": _Malicious(target)}
    torch.save(content, tmp_path / "bad.pt")
    with pytest.raises(NetworkError, match=r"bad.pt: not a network file"):
        load_network(tmp_path / "bad.pt")
    assert not target.exists()
    torch.load(tmp_path / "bad.pt", weights_only=False)  # the file would have worked
    assert target.exists()


def _edit(path, change):
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)


@pytest.mark.parametrize(
    "operation",
    [
        "aten.relu_.default",  # in place
        "aten.from_file.default",  # reads files
        "aten._fft_c2r.default",  # trusts a size: writes outside of its tensor
        "os.system",
    ],
)
def test_unknown_or_unsafe_operation_is_rejected(operation, saved):
    def change(content):
        content["nodes"][0][1] = operation

    _edit(saved, change)
    with pytest.raises(NetworkError, match=r"actor.pt: the operation .* is not allowed"):
        load_network(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(format="another"), "not a network file"),
        (lambda content: content.update(version=2), "network version 2, this code reads 1"),
        (lambda content: content.update(outputs={"node": "nowhere"}), "damaged network"),
    ],
)
def test_damaged_and_foreign_contents_are_rejected(change, message, saved):
    _edit(saved, change)
    with pytest.raises(NetworkError, match=message) as error:
        load_network(saved)
    assert str(saved) in str(error.value)


X = {"input": "x"}


def _network(tmp_path, node):
    """A network of one input and one operation, made by hand."""
    content = {"format": "roboarm-nmp program", "version": 1, "metadata": {}}
    content |= {"inputs": ["x"], "nodes": [["last", *node]], "tensors": {}}
    content["outputs"] = {"node": "last"}
    torch.save(content, tmp_path / "net.pt")
    return load_network(tmp_path / "net.pt")


HOSTILE = {
    "no groups": ["aten.native_group_norm.default", [X, None, None, 2, 3, 1, 0, 1e-5], {}],
    "expanded": ["aten.expand.default", [X, [2**31, 2, 3]], {}],
    "filled": ["aten.full.default", [[2**20, 2**20], 1.0], {"device": {"device": ""}}],
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_networks_are_rejected_before_they_run(name, tmp_path):
    """No large tensor is made, no kernel receives such arguments."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(NetworkError, match=r"net.pt"):
        _network(tmp_path, HOSTILE[name])(torch.ones(2, 3))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1_000_000  # kB


def test_further_operation_can_be_allowed_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(network_operations, "ALLOWED", set(network_operations.ALLOWED))
    erf = ["aten.erf.default", [X], {}]
    with pytest.raises(NetworkError, match=r"allow\('aten.erf.default'\)"):
        _network(tmp_path, erf)
    network_operations.allow("aten.erf.default")
    assert torch.equal(_network(tmp_path, erf)(torch.ones(2)), torch.erf(torch.ones(2)))
    with pytest.raises(ValueError, match="cannot be allowed"):
        network_operations.allow("aten.randn.default")


def test_damaged_and_foreign_files_are_rejected(saved, tmp_path):
    whole = saved.read_bytes()
    with zipfile.ZipFile(saved) as archive:
        weights = max(archive.infolist(), key=lambda entry: entry.file_size)
    flipped = bytearray(whole)
    flipped[weights.header_offset + 200] ^= 1
    cases = {
        "truncated": whole[: len(whole) // 2],
        "flipped": bytes(flipped),
        "pickle": pickle.dumps({"format": "roboarm-nmp program"}),
    }
    for name, content in cases.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(NetworkError, match=name):
            load_network(path)
    with pytest.raises(NetworkError, match="missing"):
        load_network(tmp_path / "missing")
