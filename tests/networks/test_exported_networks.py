"""Saving and loading networks: the same results for any batch size, and never a stranger's code."""

import os
import pickle
import resource
import shutil
import time
import zipfile
from pathlib import Path

import pytest
import torch
from torch import nn

from roboarm_nmp import envs
from roboarm_nmp.networks import operations as network_operations
from roboarm_nmp.networks.exported_networks import load_network, save_network, to_float16
from roboarm_nmp.networks.operations import NetworkError
from roboarm_nmp.policies.registry import make_policy, policy_file


class Actor(nn.Module):
    """An actor with most of what an MLP policy may use."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(16, 64), nn.LayerNorm(64), nn.ReLU(), nn.Dropout(0.5), nn.Linear(64, 64)
        )
        self.head = nn.Sequential(nn.GELU(), nn.SiLU(), nn.Linear(64, 14))
        self.register_buffer("scale", torch.full((7,), 0.06))

    def forward(self, observation, achieved_goal, desired_goal):
        x = torch.cat([observation, achieved_goal, desired_goal - achieved_goal], -1)
        mean, log_std = self.head(self.net(x)).chunk(2, -1)
        action = torch.tanh(mean) * self.scale * torch.tensor([0.5])
        length = action.norm(dim=-1, keepdim=True)
        shrunk = action / torch.clamp(length / 0.03, min=1.0)
        return torch.clamp(shrunk + 0 * nn.functional.softplus(log_std[:, :7]), -1, 1)


class ConvNet(nn.Module):
    """Images (N, 3, 32, 32) as bytes -> features; with a size that depends on the batch."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(
            nn.Conv2d(3, 8, 4, 2, 1), nn.BatchNorm2d(8), nn.ReLU(), nn.MaxPool2d(2)
        )
        self.head = nn.Sequential(nn.Conv2d(8, 8, 3), nn.GroupNorm(2, 8), nn.ELU(), nn.Flatten())
        self.up = nn.ConvTranspose2d(8, 3, 4, 2, 1)

    def forward(self, image):
        x = self.net(image.float() / 255)
        pixels = x.permute(0, 2, 3, 1).reshape(-1, 8)
        again = pixels.view(x.shape[0], 8, 8, 8).permute(0, 3, 1, 2)
        return {"code": self.head(x), "images": [torch.sigmoid(self.up(again)), x.mean((2, 3))]}


class VectorQuantiser(nn.Module):
    def __init__(self):
        super().__init__()
        self.book = nn.Embedding(32, 8)

    def forward(self, code):
        index = torch.cdist(code.reshape(-1, 8), self.book.weight).argmin(-1)
        quantised = self.book(index).view_as(code)
        return code + (quantised - code).detach(), index.view(code.shape[0], -1)


class PointNet(nn.Module):
    """Farthest points, their neighbours, and a maximum over them."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Conv1d(3, 16, 1), nn.LeakyReLU(), nn.Conv1d(16, 8, 1))

    def forward(self, points):
        batch, count, _ = points.shape
        farthest = torch.zeros(batch, dtype=torch.long, device=points.device)
        distance = torch.full((batch, count), 1e10, device=points.device)
        chosen = []
        for _ in range(4):
            chosen.append(farthest)
            centre = points.gather(1, farthest[:, None, None].expand(-1, 1, 3))
            distance = torch.minimum(distance, (points - centre).square().sum(-1))
            farthest = distance.argmax(-1)
        centres = points[torch.arange(batch)[:, None], torch.stack(chosen, 1)]
        near = torch.cdist(centres, points).topk(5, largest=False).indices
        shape = (batch, 4, count, 3)
        groups = points[:, None].expand(shape).gather(2, near[..., None].expand(-1, -1, -1, 3))
        groups = groups - centres[:, :, None]
        groups = torch.where(groups.norm(dim=-1, keepdim=True) < 0.5, groups, 0)
        features = self.net(groups.reshape(batch * 4, 5, 3).mT).max(-1).values
        return features.view(batch, 4, 8).amax(1)


class Transformer(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.TransformerEncoderLayer(16, 2, 32, batch_first=True)
        self.gru = nn.GRU(16, 8, batch_first=True)

    def forward(self, tokens):
        return self.gru(self.layer(tokens))[0][:, -1]


def _inputs(rows, generator=None):
    sizes = {"observation": 10, "achieved_goal": 3, "desired_goal": 3}
    return {name: torch.randn(rows, size, generator=generator) for name, size in sizes.items()}


ARCHITECTURES = {
    "actor": (Actor, lambda n: _inputs(n)),
    "conv": (ConvNet, lambda n: {"image": torch.randint(0, 255, (n, 3, 32, 32)).byte()}),
    "quantiser": (VectorQuantiser, lambda n: {"code": torch.randn(n, 6, 8)}),
    "points": (PointNet, lambda n: {"points": torch.rand(n, 40, 3)}),
    "transformer": (Transformer, lambda n: {"tokens": torch.randn(n, 5, 16)}),
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
    for name in ("actor", "conv", "points"):  # constants, integers, new tensors in the forward
        torch.manual_seed(0)
        make, inputs = ARCHITECTURES[name]
        module, batch = make().eval(), inputs(3)
        save_network(tmp_path / f"{name}.pt", module, batch, {})
        expected = _leaves(load_network(tmp_path / f"{name}.pt")(**batch))
        with torch_default():
            before = torch.get_default_dtype()
            save_network(tmp_path / "again.pt", module, batch, {})
            for path in (tmp_path / f"{name}.pt", tmp_path / "again.pt"):
                for found, leaf in zip(_leaves(load_network(path)(**batch)), expected, strict=True):
                    assert found.dtype == leaf.dtype and torch.equal(found, leaf)
            assert torch.get_default_dtype() == before


def test_policies_do_not_depend_on_torch_defaults(torch_default):
    env = envs.make("wall", goal_type="ee")
    observation, path = env.reset(seed=0)[0], policy_file("sac-ee-wall-p1-s1")
    expected = make_policy(path, env)(0, None).act(observation)
    with torch_default():
        action = make_policy(path, env)(0, None).act(observation)
    assert action.dtype == expected.dtype and action.tolist() == expected.tolist()
    env.close()


def test_loaded_network_returns_outputs_in_the_same_structure(tmp_path):
    save_network(
        tmp_path / "net.pt", ConvNet(), {"image": torch.zeros(2, 3, 32, 32).byte()}, metadata={}
    )
    outputs = load_network(tmp_path / "net.pt")(torch.zeros(4, 3, 32, 32).byte())
    assert set(outputs) == {"code", "images"}
    assert [len(image) for image in outputs["images"]] == [4, 4]


def test_saving_does_not_touch_the_module_or_the_random_numbers(tmp_path):
    module = Actor().train()
    before = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    save_network(tmp_path / "net.pt", module, _inputs(2, torch.Generator()), {})
    assert torch.equal(torch.rand(3), expected)
    assert module.training and all(parameter.requires_grad for parameter in module.parameters())
    assert all(torch.equal(before[name], tensor) for name, tensor in module.state_dict().items())
    assert os.listdir(tmp_path) == ["net.pt"]  # no temporary file is left


def test_file_contains_views_without_the_rest_of_their_storage(tmp_path):
    module = nn.Linear(4, 4)
    module.weight = nn.Parameter(torch.zeros(1_000_000)[:16].view(4, 4))
    save_network(tmp_path / "net.pt", module, {"input": torch.zeros(1, 4)}, {})
    assert (tmp_path / "net.pt").stat().st_size < 20_000


def test_float16_network_computes_in_float32_from_rounded_numbers(tmp_path):
    torch.manual_seed(0)
    module, batch = Actor().eval(), _inputs(5)
    save_network(tmp_path / "net.pt", module, batch, {"kind": "policy"})
    for _ in range(2):  # the second time changes nothing
        to_float16(tmp_path / "net.pt", tmp_path / "half.pt")
        (tmp_path / "half.pt").rename(tmp_path / "net.pt")
    for name, tensor in module.state_dict().items():
        module.state_dict()[name].copy_(tensor.half().float())
    network = load_network(tmp_path / "net.pt")
    with torch.no_grad():
        assert torch.allclose(network(**batch), module(**batch), rtol=0, atol=1e-6)
    assert network.metadata == {"kind": "policy"}


def test_float16_file_is_half_as_large_and_too_large_numbers_are_rejected(tmp_path):
    module, batch = nn.Linear(100, 1000), {"input": torch.zeros(1, 100)}
    save_network(tmp_path / "net.pt", module, batch, {})
    to_float16(tmp_path / "net.pt", tmp_path / "half.pt")
    sizes = [(tmp_path / name).stat().st_size for name in ("half.pt", "net.pt")]
    assert sizes[0] < 0.51 * sizes[1]
    nn.init.constant_(module.bias, 1e5)
    save_network(tmp_path / "large.pt", module, batch, {})
    with pytest.raises(NetworkError, match=r"large.pt: .*bias has numbers too large for float16"):
        to_float16(tmp_path / "large.pt", tmp_path / "half2.pt")
    assert not (tmp_path / "half2.pt").exists()


class _Branches(nn.Module):
    def forward(self, x):
        return x if x.sum() > 0 else -x


class _Random(nn.Module):
    def forward(self, x):
        return x + torch.randn_like(x)


class _ChangesItsInput(nn.Module):
    def forward(self, x):
        return x.add_(1)


class _DependsOnTheBatchSize(nn.Module):
    def forward(self, x):
        return x if x.shape[0] == 1 else 2 * x


@pytest.mark.parametrize("make", [_Branches, _Random, _ChangesItsInput, _DependsOnTheBatchSize])
def test_module_that_cannot_be_exported_is_rejected_and_the_old_file_stays(make, tmp_path):
    path = tmp_path / "net.pt"
    path.write_text("old")
    with pytest.raises(NetworkError, match="net.pt"):
        save_network(path, make(), {"x": torch.ones(2, 3)}, {})
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["net.pt"]


@pytest.mark.parametrize("kind", [_Branches, _Random])
def test_module_that_cannot_be_exported_gives_one_line_and_prints_no_graph(kind, tmp_path, capfd):
    with pytest.raises(NetworkError) as caught:
        save_network(tmp_path / "net.pt", kind(), {"x": torch.ones(2, 3)}, {})
    reason = {
        _Branches: "its forward branches on a value (test_exported_networks.py, line ",
        _Random: "the operation 'aten.randn_like.default' is not allowed",
    }[kind]
    message = str(caught.value)
    assert reason in message and "\n" not in message and len(message) < 500
    output = "".join(capfd.readouterr())
    assert "torch.ops" not in output and "Unable to find" not in output


def test_metadata_must_be_json(tmp_path):
    with pytest.raises(NetworkError, match="JSON"):
        save_network(tmp_path / "net.pt", nn.ReLU(), {"input": torch.ones(1, 3)}, {"a": object()})


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
    with pytest.raises(NetworkError, match="image"):
        network(**inputs, image=torch.zeros(2))
    with pytest.raises(NetworkError, match="by name"):
        network(*inputs.values(), observation=inputs["observation"])
    with pytest.raises(NetworkError, match=r"actor.pt: aten.cat.default failed"):
        network(**(inputs | {"observation": torch.zeros(3, 10)}))


class _Malicious:
    """Unpickled by an unsafe reader, this makes a file."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return open, (str(self.target), "w")


@pytest.mark.parametrize("zipped", [True, False])
def test_file_with_code_in_it_is_rejected_and_runs_nothing(zipped, saved, tmp_path):
    target = tmp_path / "made by the file"
    content = torch.load(saved, weights_only=True) | {"metadata": _Malicious(target)}
    torch.save(content, tmp_path / "bad.pt", _use_new_zipfile_serialization=zipped)
    with pytest.raises(NetworkError, match=r"bad.pt: not a network file"):
        load_network(tmp_path / "bad.pt")
    assert not target.exists()
    torch.load(tmp_path / "bad.pt", weights_only=False)  # the file would have worked
    assert target.exists()


def test_torch_export_archive_is_rejected(tmp_path):
    exported = torch.export.export(nn.ReLU(), (torch.ones(2),))
    torch.export.save(exported, tmp_path / "net.pt2")
    with pytest.raises(NetworkError, match="not a network file"):
        load_network(tmp_path / "net.pt2")


def _edit(path, change):
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)


@pytest.mark.parametrize(
    "operation",
    [
        "aten.relu_.default",  # in place
        "aten.add.out",
        "aten.randn.default",  # random
        "aten.from_file.default",  # reads files
        "aten.as_strided.default",
        "aten.empty.memory_format",
        "aten.max_pool2d_with_indices_backward.default",
        "aten._fft_c2r.default",  # trusts a size: writes outside of its tensor
        "aten._native_batch_norm_legit.no_stats",
        "aten._pdist_forward.default",
        "aten.copy.default",
        "aten.no_such_operation.default",
        "aten.relu.no_such_overload",
        "aten.__class__.__name__",
        "aten.relu",
        "prims.add.default",
        "operator.attrgetter",
        "os.system",
        "eval",
        7,
    ],
)
def test_unknown_or_unsafe_operation_is_rejected(operation, saved):
    def change(content):
        content["nodes"][0][1] = operation

    _edit(saved, change)
    with pytest.raises(NetworkError, match=r"actor.pt: the operation .* is not allowed"):
        load_network(saved)


def _constant(name):
    def change(content):
        content["nodes"][0][3]["dtype"] = {"torch": name}

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(format="another"), "not a network file"),
        (lambda content: content.update(version=2), "network version 2, this code reads 1"),
        (lambda content: content.pop("nodes"), "damaged network"),
        (lambda content: content.pop("metadata"), "damaged network"),
        (lambda content: content["nodes"].pop(0), "damaged network"),
        (lambda content: content["nodes"][0].pop(), "damaged network"),
        (lambda content: content["tensors"].clear(), "damaged network"),
        (lambda content: content.update(outputs={"node": "nowhere"}), "damaged network"),
        (lambda content: content["tensors"].update(a=nn.Parameter(torch.ones(1))), "not plain"),
        (lambda content: content.update(metadata=torch.Size([1])), "not plain"),
        (_constant("load"), "torch.load is not allowed"),
        (_constant("no_such_thing"), "torch.no_such_thing is not allowed"),
        (_constant("complex64"), "torch.complex64 is not allowed"),
        (_constant("sparse_coo"), "torch.sparse_coo is not allowed"),
    ],
)
def test_damaged_and_foreign_contents_are_rejected(change, message, saved):
    _edit(saved, change)
    with pytest.raises(NetworkError, match=message) as error:
        load_network(saved)
    assert str(saved) in str(error.value)


X = {"input": "x"}
LAST = {"node": "last"}


def _network(tmp_path, *nodes, metadata=None, **tensors):
    """A network of one input, made by hand; the last node is its output."""
    content = {"format": "roboarm-nmp program", "version": 1, "metadata": metadata or {}}
    names = [f"node {i}" for i in range(len(nodes) - 1)] + ["last"]
    content["nodes"] = [[name, *node] for name, node in zip(names, nodes, strict=True)]
    content |= {"inputs": ["x"], "tensors": tensors, "outputs": LAST}
    torch.save(content, tmp_path / "net.pt")
    return load_network(tmp_path / "net.pt")


def _doubled(times):
    return [
        ["aten.cat.default", [2 * [{"node": f"node {i - 1}"} if i else X]], {}]
        for i in range(times)
    ]


def _squared(times):
    nodes = [["aten.sym_size.int", [X, 1], {}]]
    for i in range(times):
        nodes.append(["operator.mul", 2 * [{"node": f"node {i}"}], {}])
    return nodes


BATCH_NORM = "aten._native_batch_norm_legit_no_training.default"
ONE = {"tensor": "one"}  # parameters of one channel
HOSTILE = {
    "no groups": [["aten.native_group_norm.default", [X, None, None, 2, 3, 1, 0, 1e-5], {}]],
    "channels": [[BATCH_NORM, [X, ONE, ONE, ONE, ONE, 0.1, 1e-5], {}]],
    "other sizes": [["aten.native_group_norm.default", [X, None, None, 9, 3, 9, 3, 1e-5], {}]],
    "no stride": [["aten.convolution.default", [X, X, None, [0], [0], [1], False, [0], 1], {}]],
    "no group": [["aten.convolution.default", [X, X, None, [1], [0], [1], False, [0], 0], {}]],
    "pool of nothing": [["aten.avg_pool2d.default", [X, [0, 0]], {}]],
    "other rank": [["aten.permute.default", [X, [0, 1, 2]], {}]],
    "dimension": [["aten.select.int", [X, 7, 0], {}]],
    "row": [["aten.select.int", [X, 0, 99], {}]],
    "expanded": [["aten.expand.default", [X, [2**31, 2, 3]], {}]],
    "counted": [["aten.arange.start_step", [0, 2**60], {"device": {"device": ""}}]],
    "filled": [["aten.full.default", [[2**20, 2**20], 1.0], {"device": {"device": ""}}]],
    "doubled": _doubled(60),
    "squared": _squared(40),
    "words": [["operator.mul", ["word", 2**31], {}]],
    "picked": [["operator.getitem", ["word", 0], {}]],
    "mask": [
        ["aten.gt.Scalar", [X, 0.0], {}],
        ["aten.index.Tensor", [X, [{"node": "node 0"}]], {}],
    ],
    "double": [["aten._to_copy.default", [X], {"dtype": {"torch": "float64"}}]],
    "arguments": [["aten.relu.default", [X, X, X], {"other": 3}]],
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_networks_are_rejected_before_they_run(name, tmp_path):
    """In a second and a gigabyte: no large tensor is made, no kernel receives such arguments."""
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    with pytest.raises(NetworkError, match=r"net.pt"):
        _network(tmp_path, *HOSTILE[name], one=torch.ones(1))(torch.ones(2, 3))
    assert time.perf_counter() - began < 5.0  # on a busy machine
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1_000_000  # kB


def test_indices_and_divisors_from_a_file_are_checked_when_it_runs(tmp_path):
    index = torch.tensor([[0, 2**40]])
    network = _network(tmp_path, ["aten.gather.default", [X, 1, {"tensor": "i"}], {}], i=index)
    with pytest.raises(NetworkError, match=r"aten.gather.default failed"):
        network(torch.ones(2, 3))
    least = torch.tensor([-(2**63)])
    divide = [
        "aten.div.Tensor_mode",
        [{"tensor": "a"}, {"tensor": "b"}],
        {"rounding_mode": "floor"},
    ]
    for divisor in (-1, 0):
        network = _network(tmp_path, divide, a=least, b=torch.tensor([divisor]))
        with pytest.raises(NetworkError, match="not positive"):
            network(torch.ones(2, 3))
    assert _network(tmp_path, divide, a=least, b=torch.tensor([2]))(torch.ones(1)) == -(2**62)


def test_too_many_values_in_a_file_are_rejected(tmp_path):
    relu = ["aten.relu.default", [X], {}]
    for tensor, message in (
        (torch.ones(1).expand(2**40), "larger than its memory"),
        (torch.ones(2, dtype=torch.complex64), "complex64"),
        (torch.ones(2).to_sparse(), "not a plain one|not a network file"),
    ):
        with pytest.raises(NetworkError, match=message):
            _network(tmp_path, relu, t=tensor)
    itself = []
    itself.append(itself)
    shared = [0.0] * 10
    for _ in range(20):
        shared = [shared] * 10
    for metadata in ({"a": itself}, {"a": shared}):
        with pytest.raises(NetworkError, match="values, or more than 32 nested lists"):
            _network(tmp_path, relu, metadata=metadata)
    with pytest.raises(NetworkError, match="20,000 operations"):
        _network(tmp_path, *[relu] * 20_001)


def test_compressed_file_is_rejected(saved):
    with zipfile.ZipFile(saved) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name, data + bytes(1_000_000))
    with pytest.raises(NetworkError, match="compressed"):
        load_network(saved)


class _ErrorFunction(nn.Module):
    def forward(self, x):
        return torch.erf(x)


def test_further_operation_can_be_allowed_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(network_operations, "ALLOWED", set(network_operations.ALLOWED))
    path, inputs = tmp_path / "net.pt", {"x": torch.ones(2, 3)}
    with pytest.raises(NetworkError, match=r"allow\('aten.erf.default'\)"):
        save_network(path, _ErrorFunction(), inputs, {})
    network_operations.allow("aten.erf.default")
    save_network(path, _ErrorFunction(), inputs, {})
    assert torch.equal(load_network(path)(**inputs), torch.erf(inputs["x"]))
    for name in (
        "aten.randn.default",
        "aten.relu_.default",
        "aten.as_strided.default",
        "os.system",
    ):
        with pytest.raises(ValueError, match="cannot be allowed|no operation"):
            network_operations.allow(name)


def test_damaged_and_foreign_files_are_rejected(saved, tmp_path):
    whole = saved.read_bytes()
    with zipfile.ZipFile(saved) as archive:
        weights = max(archive.infolist(), key=lambda entry: entry.file_size)
    flipped = bytearray(whole)
    flipped[weights.header_offset + 200] ^= 1
    folder = bytearray(whole)  # its entry in the directory at the end says that it is one
    entry = whole.rindex(weights.filename.encode())
    assert whole[entry - 46 : entry - 42] == b"PK\x01\x02"
    folder[entry - 8] ^= 16
    cases = {
        "empty": b"",
        "text": b"hello",
        "truncated": whole[: len(whole) // 2],
        "flipped": bytes(flipped),
        "folder": bytes(folder),
        "pickle": pickle.dumps({"format": "roboarm-nmp program"}),
    }
    for name, content in cases.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(NetworkError, match=name):
            load_network(path)
    torch.save([1, 2], tmp_path / "list")
    with zipfile.ZipFile(tmp_path / "zip", "w") as archive:
        archive.writestr("a", "b")
    for name in ("list", "zip", "missing", "."):
        with pytest.raises(NetworkError):
            load_network(tmp_path / name)
