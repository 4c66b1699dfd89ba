"""Networks with one to three random changes: of operations, arguments, references, tensors."""

import copy
import pickle
import random

import torch
from torch import nn

from attacks.children import RAN, REFUSED
from roboarm_nmp.networks import operations as network_operations
from roboarm_nmp.networks.exported_networks import ExportedNetwork, save_network
from roboarm_nmp.networks.untrusted import NetworkError

NUMBERS = (0, 1, -1, 2, 3, 7, -7, 255, 2**15, 2**31, -(2**31), 2**40, 2**62, -(2**63), 2**63, 2**70)
ODD = (*NUMBERS, 0.5, float("nan"), float("inf"), 1e300, True, None, "mean", "floor", [])


class Mixed(nn.Module):
    """Most kinds of operations that a network may have."""

    def __init__(self):
        super().__init__()
        self.images = nn.Sequential(
            nn.Conv2d(3, 6, 3, 2, 1), nn.GroupNorm(2, 6), nn.ELU(), nn.MaxPool2d(2), nn.AvgPool2d(2)
        )
        self.grow = nn.Sequential(nn.ConvTranspose2d(6, 3, 2, 2), nn.BatchNorm2d(3), nn.Sigmoid())
        self.book = nn.Embedding(9, 5)
        self.layer = nn.Sequential(nn.Linear(12, 5), nn.LayerNorm(5), nn.GELU(), nn.Softplus())

    def forward(self, image, points, numbers):
        encoded = self.images(image.float() / 255)
        parts = [encoded.mean((2, 3)), self.grow(encoded).amax((2, 3)), numbers]
        x = self.layer(torch.cat(parts, 1))
        nearest = torch.cdist(x, self.book.weight).argmin(1)
        x = x + self.book(nearest) + self.book((nearest + 9) // 2)
        near = torch.cdist(points, points[:, :2]).topk(3, dim=1, largest=False)
        group = points.gather(1, near.indices[:, :, :1].expand(-1, -1, 3)) - points[:, :1]
        group = torch.where(group.norm(dim=-1, keepdim=True) < 0.5, group, 0)
        order = numbers.sort(1).values.clamp(-1, 1).pow(2).unsqueeze(1) @ points[:, :3]
        weights = torch.softmax(x, 1) * torch.log_softmax(x, 1).relu()
        index = torch.arange(x.shape[0], device=x.device)
        picked = points[index[:, None], nearest[:, None].clamp(0, 7)]
        return torch.cat([weights, group.flatten(1), order[:, 0], picked[:, 0].tanh()], 1)


def inputs(rows=2):
    generator = torch.Generator().manual_seed(0)
    return {
        "image": torch.randint(0, 255, (rows, 3, 16, 16), generator=generator).byte(),
        "points": torch.rand(rows, 8, 3, generator=generator),
        "numbers": torch.rand(rows, 3, generator=generator),
    }


def hostile(content, rng):
    """A copy with one to three changes; `rng` is a `random.Random`."""
    content = copy.deepcopy(content)
    for _ in range(rng.randint(1, 3)):
        nodes = content["nodes"]
        node, kind = rng.choice(nodes), rng.random()
        if kind < 0.25:
            known = [*network_operations.ALLOWED, *network_operations.PYTHON]
            node[1] = rng.choice(sorted(known) if rng.random() < 0.9 else ["aten._fft_c2r.default"])
        elif kind < 0.7:
            _change(rng.choice([node[2], node[3]]), rng, nodes, content)
        elif kind < 0.8:
            nodes.insert(rng.randrange(len(nodes)), copy.deepcopy(node))
        elif kind < 0.9:
            name = rng.choice(sorted(content["tensors"]))
            content["tensors"][name] = _tensor(content["tensors"][name], rng)
        else:
            node[2], other = copy.deepcopy(rng.choice(nodes)[2]), node[2]
            node[2] = node[2] if rng.random() < 0.5 else other[: rng.randint(0, len(other))]
    return content


def _change(arguments, rng, nodes, content):
    """Change one of the arguments in place, or one inside of it."""
    keys = list(arguments) if isinstance(arguments, dict) else list(range(len(arguments)))
    if not keys or rng.random() < 0.05:
        if isinstance(arguments, list):
            arguments.append(rng.choice(ODD))
        else:
            arguments[rng.choice(["dtype", "dim", "keepdim", "rounding_mode"])] = rng.choice(ODD)
        return
    key = rng.choice(keys)
    inside = arguments[key]
    if isinstance(inside, list) and inside and rng.random() < 0.7:
        return _change(inside, rng, nodes, content)
    if isinstance(inside, dict) or rng.random() < 0.2:
        references = [{"node": node[0]} for node in nodes]
        references += [{"tensor": name} for name in content["tensors"]]
        references += [{"torch": name} for name in ("int64", "bool", "uint8", "float32", "float64")]
        arguments[key] = rng.choice(references)
    elif isinstance(inside, list) and rng.random() < 0.3:
        arguments[key] = inside * rng.choice([0, 2, 1000])
    else:
        arguments[key] = rng.choice(ODD)


def _tensor(tensor, rng):
    kind = rng.randrange(5)
    if kind == 0:
        is_float = tensor.is_floating_point()
        return torch.full_like(tensor, float("nan")) if is_float else tensor + 2**40
    if kind == 1:
        return tensor.flatten()[: rng.randint(0, tensor.numel())].clone()
    if kind == 2:
        return torch.tensor(rng.choice([0, -1, 2**62, -(2**63)])).expand(tensor.shape).clone()
    if kind == 3:
        return tensor.expand(1000, *tensor.shape)
    return tensor.reshape(1, *tensor.shape, 1).clone()


def attempts(seed, folder):
    """A function from a number to the outcome of loading and running such a network."""
    path = folder / "mixed.pt"
    torch.manual_seed(seed)
    save_network(path, Mixed(), inputs(), {"kind": "encoder"})
    content = torch.load(path, weights_only=True)

    def attempt(number):
        changed = hostile(content, random.Random(f"{seed} {number}"))
        try:
            # As read from a file; contents that cannot be unpickled belong to the attack on files.
            ExportedNetwork(pickle.loads(pickle.dumps(changed)))(**inputs())
        except NetworkError as error:
            return "out of memory" if "allocate" in str(error) else REFUSED
        return RAN

    return attempt
