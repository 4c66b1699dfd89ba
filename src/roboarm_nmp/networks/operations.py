"""Operations that a network file may name, and limits of what they may compute.

PyTorch's kernels trust their arguments: some write where a size or an index says, some divide by a
number of groups. A network file (`networks.exported_networks`) may come from a stranger, so

- only the operations in `ALLOWED` are run: those that the trainers, the encoders and the examples
  in the docs need, common layers, and harmless elementwise ones. `allow` adds one, in your own code
  and for that process;
- before a network runs on inputs of new shapes, it runs on PyTorch's meta device, without numbers:
  shapes that do not fit and tensors that are too large are rejected there;
- arguments that the meta device does not check are checked here.
"""

import operator
from collections.abc import Callable
from typing import Any

import torch

MAX_NODES = 20_000
"""Operations in a network."""
MAX_VALUES = 1_000_000
"""Values in a file, arguments and metadata included."""
MAX_DEPTH = 32
"""Nested lists or dicts."""
MAX_ELEMENTS = 2**26
"""Numbers in a tensor, stored or computed."""
MAX_COMPUTED = 2**28
"""Numbers in all tensors together that a network computes."""
DTYPES = (torch.float32, torch.int64, torch.bool, torch.uint8)
"""Of tensors, stored or computed."""

_FORMATS = torch.strided, torch.contiguous_format, torch.preserve_format, torch.channels_last
_CONSTANTS = {str(one).removeprefix("torch."): one for one in (*DTYPES, *_FORMATS)}

_ELEMENTWISE = (
    *("relu", "leaky_relu", "elu", "gelu", "silu", "softplus", "sigmoid", "tanh", "sin", "cos"),
    "atan2",
    *("exp", "log", "sqrt", "rsqrt", "abs", "neg", "floor", "clamp", "minimum", "maximum"),
    *("logical_not", "logical_and", "bitwise_not", "alias", "clone", "_to_copy"),
)
_WITH_OTHER = ("add.Tensor", "sub.Tensor", "mul.Tensor", "mul.Scalar", "div.Tensor")
_COMPARED = tuple(f"{name}.Scalar" for name in ("eq", "ne", "lt", "le", "gt", "ge"))
_REDUCED = ("sum.dim_IntList", "mean.dim", "max.dim", "any.dim")
_SHAPED = ("squeeze.dims", "slice.Tensor", "select.int", "sym_size.int", "index.Tensor")
ALLOWED = {
    f"aten.{name}" if "." in name else f"aten.{name}.default"
    for name in (
        *_ELEMENTWISE,
        *_WITH_OTHER,
        *_COMPARED,
        *("where.self", *_REDUCED),
        *_SHAPED,
        *("div.Tensor_mode", "pow.Tensor_Scalar", "bitwise_and.Tensor"),
        *("amax", "argmax", "argmin", "sort", "topk", "linalg_vector_norm", "cdist"),
        *("view", "unsqueeze", "permute", "expand", "cat", "split_with_sizes", "gather"),
        *("full", "full_like", "scalar_tensor", "arange.start_step", "embedding"),
        *("linear", "mm", "bmm", "convolution", "avg_pool2d", "max_pool2d_with_indices"),
        *("layer_norm", "native_group_norm", "_native_batch_norm_legit_no_training"),
        *("_softmax", "_log_softmax"),
    )
}
"""Names of the operations of `torch.ops.aten` that are allowed in a network."""


class NetworkError(ValueError):
    """A network that cannot be saved, or a network file that cannot be loaded or run."""


def allow(name: str) -> None:
    """Allow one more operation, such as `aten.erf.default`, in networks of your own.

    Raises ValueError: there is none of that name, or it does more than compute (random operations,
    those that change their arguments, or read uninitialised memory).
    """
    operation = _aten(name)
    if operation is None:
        raise ValueError(f"{name!r} is no operation of torch.ops.aten")
    packet = name.split(".")[1]
    if (
        operation._schema.is_mutable
        or torch.Tag.nondeterministic_seeded in operation.tags
        or packet.startswith(("as_strided", "empty", "from_file"))
        or packet.endswith("_backward")
    ):
        raise ValueError(f"{name} cannot be allowed in a network: it does more than compute")
    ALLOWED.add(name)


def find(name: Any) -> Any:
    """The function of an operation's name. Raises NetworkError: it is not allowed."""
    if isinstance(name, str):
        if name in PYTHON:
            return PYTHON[name]
        if name in ALLOWED:
            return _divide if name == "aten.div.Tensor_mode" else _aten(name)
    raise NetworkError(
        f"the operation {name!r} is not allowed in a network (in your own code, "
        f"roboarm_nmp.networks.operations.allow({name!r}) allows it)"
    )


def _aten(name):
    space, _, rest = name.partition(".")
    packet_name, _, overload = rest.partition(".")
    packet = getattr(torch.ops.aten, packet_name, None) if space == "aten" else None
    if isinstance(packet, torch._ops.OpOverloadPacket) and overload in packet.overloads():
        return getattr(packet, overload)
    return None


def check_file(content: dict[str, Any]) -> None:
    """Raise NetworkError unless the content of a file is plain data, and not too much of it.

    `weights_only` still makes a few kinds of objects; a network has fewer.
    """
    left: list[tuple[Any, int]] = [(content, 0)]
    count = 0
    while left:
        value, depth = left.pop()
        kind = type(value)
        count += 1
        if count + len(left) > MAX_VALUES or depth > MAX_DEPTH:
            raise NetworkError(
                f"it has more than {MAX_VALUES:,} values, or more than {MAX_DEPTH} nested lists"
            )
        if kind is dict or kind is list:
            inside = [*value, *value.values()] if kind is dict else value
            left += [(one, depth + 1) for one in inside]
        elif kind is torch.Tensor:
            if value.layout != torch.strided or value.device.type != "cpu" or value.requires_grad:
                raise NetworkError("it holds a tensor that is not a plain one")
            if not value.is_contiguous():
                raise NetworkError("it holds a tensor that is larger than its memory")
            _check_tensor(value, (*DTYPES, torch.float16))
        elif value is not None and kind not in (bool, int, float, str):
            raise NetworkError(f"it holds a {kind.__name__}, which is not plain data")
    if len(content["nodes"]) > MAX_NODES:
        raise NetworkError(f"it has more than {MAX_NODES:,} operations")


def constant(name: Any) -> Any:
    """The dtype, layout or memory format of a name. Raises NetworkError: not one of those."""
    if not isinstance(name, str) or name not in _CONSTANTS:
        raise NetworkError(f"torch.{name} is not allowed in a network")
    return _CONSTANTS[name]


class ShapeCheck:
    """Checks the operations of a network, one by one, while it runs on the meta device."""

    def __init__(self):
        self.computed = 0

    def before(self, name: str, args: list) -> None:
        """Raise NetworkError if a kernel would trust these arguments and should not."""
        if name in _RULES and not _RULES[name](*args):
            raise NetworkError(f"{name}: its arguments are out of range")

    def after(self, function: Callable, result: Any) -> None:
        """Raise NetworkError if a result is no plain tensor, or too large."""
        schema = getattr(function, "_schema", None)
        view = schema is not None and any(one.alias_info is not None for one in schema.returns)
        for one in result if isinstance(result, (list, tuple)) else [result]:
            if isinstance(one, torch.Tensor):
                _check_tensor(one, DTYPES)
                self.computed += 0 if view else one.numel()
        if self.computed > MAX_COMPUTED:
            raise NetworkError(f"it computes more than {MAX_COMPUTED:,} numbers")


def _check_tensor(tensor, dtypes):
    if tensor.dtype not in dtypes:
        raise NetworkError(f"it has a tensor of {tensor.dtype}")
    if tensor.layout != torch.strided or tensor.numel() > MAX_ELEMENTS:
        raise NetworkError(f"it has a tensor of more than {MAX_ELEMENTS:,} numbers")


# --- Arguments that kernels and the meta device trust


def _at_least(least, *values):
    """Whether all integers, or lists of them, are from `least` to 32,767."""
    flat = [one for value in values for one in (value if isinstance(value, list) else [value])]
    return all(type(one) is int and least <= one < 2**15 for one in flat)


def _convolution(x, weight, bias, stride, padding, dilation, transposed, output_padding, groups):
    return _at_least(1, stride, dilation, groups) and _at_least(0, padding, output_padding)


def _pool(x, kernel, stride=(), padding=0, *others):
    return _at_least(1, kernel, list(stride)) and _at_least(0, padding)


def _group_norm(x, weight, bias, rows, channels, size, groups, eps):
    shape = [rows, channels, size]
    return _at_least(1, groups) and channels % groups == 0 and list(x.flatten(2).shape) == shape


def _batch_norm(x, weight, bias, mean, variance, momentum, eps):
    return all(one is None or one.shape == x.shape[1:2] for one in (weight, bias, mean, variance))


_RULES = {
    "aten.convolution.default": _convolution,
    "aten.avg_pool2d.default": _pool,
    "aten.max_pool2d_with_indices.default": _pool,
    "aten.native_group_norm.default": _group_norm,
    "aten._native_batch_norm_legit_no_training.default": _batch_norm,
}


def _divide(one, other, *, rounding_mode=None):
    """Division that rejects integer divisors below 1: the least integer by -1 ends the process."""
    divisor = torch.as_tensor(other, device=one.device)
    integers = not (one.is_floating_point() or divisor.is_floating_point())
    if integers and not divisor.is_meta and not (divisor > 0).all():
        raise NetworkError("integers are divided by something that is not positive")
    return torch.ops.aten.div.Tensor_mode(one, other, rounding_mode=rounding_mode)


# --- Arithmetic on sizes, where a shape depends on the batch, and one of several results


def _of_sizes(function):
    def compute(*sizes):
        if any(type(size) is not int for size in sizes):
            raise NetworkError("arithmetic is allowed on sizes only")
        result = function(*sizes)
        if abs(result) >= 2**62:
            raise NetworkError("a size is too large")
        return result

    return compute


def _select(several, i):
    if type(several) not in (list, tuple) or type(i) is not int:
        raise NetworkError("only one of several results can be selected")
    return several[i]


PYTHON = {
    f"operator.{name}": _of_sizes(getattr(operator, name))
    for name in ("add", "sub", "mul", "floordiv", "mod", "neg")
} | {"operator.getitem": _select}
"""Name -> function."""
