"""Networks with one to three random changes: of operators, attributes, inputs, tensors, shapes."""

import random

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import nn

from attacks.children import RAN, REFUSED
from roboarm_nmp.networks.export import save_network
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.networks.untrusted import OPERATORS, NetworkError

INTEGERS = (0, 1, -1, 2, 3, 7) * 6
INTEGERS += (-7, 255, 2**15, 2**31, -(2**31), 2**40, 2**62, -(2**63), 2**63 - 1)
FLOATS = (0.0, 0.5, 1.0, -1.0, 7.0, -(2.0**63), 3e38, float("nan"), float("inf"))
TEXTS = ("SAME_UPPER", "VALID", "reflect", "edge", "wrap", "tanh", "")
DTYPES = ("float32", "float32", "int64", "int64", "float64", "float16", "int32", "uint8", "bool")
ONNX_NAMES = {"float32": "float", "float64": "double"}


class Mixed(nn.Module):
    """Most kinds of operators that a network may have."""

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
        x = x + self.book(nearest) + self.book(8 - nearest)
        near = torch.cdist(points, points[:, :2]).topk(2, dim=1, largest=False)
        group = points.gather(1, near.indices[:, :, :1].expand(-1, -1, 3)) - points[:, :1]
        group = torch.where(group.norm(dim=-1, keepdim=True) < 0.5, group, 0)
        order = numbers.topk(3, dim=1).values.clamp(-1, 1).pow(2).unsqueeze(1) @ points[:, :3]
        weights = torch.softmax(x, 1) * torch.log_softmax(x, 1).relu()
        index = torch.ones_like(nearest).cumsum(0) - 1
        picked = points[index[:, None], nearest[:, None].clamp(0, 7)]
        return torch.cat([weights, group.flatten(1), order[:, 0], picked[:, 0].tanh()], 1)


def inputs(rows=2):
    generator = torch.Generator().manual_seed(0)
    return {
        "image": torch.randint(0, 255, (rows, 3, 16, 16), generator=generator).byte(),
        "points": torch.rand(rows, 8, 3, generator=generator),
        "numbers": torch.rand(rows, 3, generator=generator),
    }


def hostile(model, rng):
    """A copy with one to three changes; `rng` is a `random.Random`."""
    changed = onnx.ModelProto()
    changed.CopyFrom(model)
    graph = changed.graph
    for _ in range(rng.randint(1, 3)):
        kind, node = rng.random(), rng.choice(graph.node)
        if kind < 0.35:
            _add_node(graph, rng)
        elif kind < 0.4:
            node.op_type = rng.choice(sorted(OPERATORS))
        elif kind < 0.6:
            names = sorted(onnx.defs.get_schema(node.op_type).attributes)
            _set_attribute(node, rng.choice([*names, "axis"]), rng)
        elif kind < 0.7:
            _change_inputs(graph, node, rng)
        elif kind < 0.75:
            graph.node.remove(node)
            for other in graph.node:
                for i, name in enumerate(other.input):
                    other.input[i] = "points" if name in node.output else name
        elif kind < 0.95:
            tensor = rng.choice(graph.initializer)
            dtype = rng.choice([numpy_helper.to_array(tensor).dtype] * 9 + [*DTYPES])
            array = _array(rng, dtype, tensor.dims)
            tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))
        elif kind < 0.97:
            changed.opset_import[0].version = rng.randint(6, 25)
        else:
            declared = rng.choice(graph.input).type.tensor_type
            rng.choice(declared.shape.dim).dim_value = rng.choice(INTEGERS)
            declared.elem_type = rng.choice([declared.elem_type] * 3 + [*range(25)])
    return changed


def _add_node(graph, rng):
    """Add an operator with random inputs and attributes; its results are outputs of the network."""
    place = rng.randint(0, len(graph.node))
    node = onnx.NodeProto(op_type=rng.choice(sorted(OPERATORS)))
    schema = onnx.defs.get_schema(node.op_type)
    dtypes = {}  # of the schema's types
    for i in range(rng.randint(schema.min_input, min(schema.max_input, schema.min_input + 3))):
        kind = schema.inputs[min(i, len(schema.inputs) - 1)]
        fits = [one for one in DTYPES if f"tensor({ONNX_NAMES.get(one, one)})" in kind.types]
        dtype = dtypes.setdefault(kind.type_str, rng.choice(fits))
        if dtype == "float32" and rng.random() < 0.5:
            node.input.append(rng.choice(_known(graph, place)))
        else:
            node.input.append(f"new{len(graph.initializer)}")
            tensor = numpy_helper.from_array(_array(rng, dtype), node.input[i])
            graph.initializer.append(tensor)
    for name, attribute in sorted(schema.attributes.items()):
        if attribute.required or rng.random() < 0.3:
            _set_attribute(node, name, rng)
    for i in range(rng.randint(schema.min_output, min(schema.max_output, 3))):
        node.output.append(f"added{len(graph.node)}.{i}")
        graph.output.append(onnx.ValueInfoProto(name=node.output[i]))
    graph.node.insert(place, node)


def _known(graph, place):
    """Names of the values that are known before the operator at a place."""
    names = [one.name for one in (*graph.input, *graph.initializer)]
    return names + [name for node in graph.node[:place] for name in node.output]


def _set_attribute(node, name, rng):
    """Give an attribute another value, mostly of the right type, or remove it."""
    others = [one for one in node.attribute if one.name != name]
    del node.attribute[:]
    node.attribute.extend(others)
    schema = onnx.defs.get_schema(node.op_type).attributes
    kind = schema[name].type.name if name in schema and rng.random() < 0.95 else "INTS"
    if kind == "TENSOR":
        value = numpy_helper.from_array(_array(rng, rng.choice(DTYPES)))
    elif kind in ("INT", "FLOAT", "STRING"):
        value = rng.choice({"INT": INTEGERS, "FLOAT": FLOATS, "STRING": TEXTS}[kind])
    else:
        value = rng.choices(INTEGERS, k=rng.choice((1, 2, 2, 3, 4)))
    if rng.random() < 0.9:
        node.attribute.append(helper.make_attribute(name, value))


def _change_inputs(graph, node, rng):
    """Exchange, add, drop or replace inputs of an operator."""
    names = list(node.input)
    known = [*_known(graph, list(graph.node).index(node)), ""]
    kind = rng.randrange(4)
    if kind == 0:
        rng.shuffle(names)
    elif kind == 1:
        names.append(rng.choice(known))
    elif names and kind == 2:
        names.pop()
    elif names:
        names[rng.randrange(len(names))] = rng.choice(known)
    node.input[:] = names


def _array(rng, dtype, shape=None):
    """A small array; mostly one that may be the axes, sizes or indices of an operator."""
    if shape is None or rng.random() < 0.3:
        shape = rng.choice(
            [(), (1,), (1,), (2,), (2,), (3,), (4,), (0,), (1, 2), (2, 3), (2, 2, 3)]
        )
    numbers = rng.choices(INTEGERS if rng.random() < 0.8 else FLOATS, k=20)
    with np.errstate(all="ignore"):
        return np.resize(np.array(numbers).astype(dtype), shape)


def attempts(seed, folder):
    """A function from a number to the outcome of loading and running such a network."""
    path = folder / "mixed.onnx"
    torch.manual_seed(seed)
    save_network(path, Mixed(), inputs(), {"kind": "encoder"}, ["latent"])
    model = onnx.load(path)

    def attempt(number):
        changed = hostile(model, random.Random(f"{seed} {number}"))
        path.write_bytes(changed.SerializeToString())
        try:
            load_network(path)(**inputs())
        except NetworkError as error:
            return "out of memory" if "allocate" in str(error) else REFUSED
        return RAN

    return attempt
