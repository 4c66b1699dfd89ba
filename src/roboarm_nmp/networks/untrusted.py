"""What a network file from a stranger may hold, checked before ONNX Runtime receives it.

Plain tensors and standard operators: no control flow, no random numbers, no code and no other
files. So memory and time follow from the shapes of the inputs, and are limited for a batch of one.
"""

import math
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # it takes a while to import
    import onnx

MAX_BYTES = 100_000_000  # of a file
MAX_OTHER_BYTES = 4_000_000  # without weights: parsed, they may take a hundred times the memory
MAX_NODES = 20_000
MAX_ELEMENTS = 2**25  # numbers in a tensor, stored or computed
MAX_COMPUTED = 2**27  # numbers in all computed tensors
MAX_PRODUCTS = 2**34  # multiplications: about a second
_NAMES = """
Abs Add And ArgMax ArgMin Atan AveragePool BatchNormalization Cast Ceil Clip Concat Constant
ConstantOfShape Conv ConvTranspose Cos CumSum Div Elu Equal Erf Exp Expand Flatten Floor Gather
GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual HardSwish
Identity InstanceNormalization IsInf IsNaN LayerNormalization LeakyRelu Less LessOrEqual Log
LogSoftmax MatMul Max MaxPool Min Mish Mul Neg Not Or PRelu Pad Pow Range Reciprocal ReduceL2
ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum Relu Reshape Round Selu Shape
Sigmoid Sign Sin Slice Softmax Softplus Split Sqrt Squeeze Sub Sum Tan Tanh Tile TopK Transpose
Trilu Unsqueeze Where Xor
"""
OPERATORS = set(_NAMES.split())
"""Names of the ONNX operators that a network may use. Your own code may add to them."""


class NetworkError(ValueError):
    """A network that cannot be saved, or a network file that cannot be loaded or run."""


def read_model(path: str | Path) -> "onnx.ModelProto":
    """The model in an ONNX file. Raises NetworkError: it is not one, or not within the limits."""
    import onnx

    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES or len(data) - _weight_bytes(memoryview(data)) > MAX_OTHER_BYTES:
            raise NetworkError("it is too large")
        model = onnx.load_model_from_string(data)
        check_model(model)
    except OSError as error:
        raise NetworkError(f"{path}: cannot be read: {error.strerror or error}") from error
    except NetworkError as error:
        raise NetworkError(f"{path}: {error}") from error
    except Exception as error:  # whatever broken bytes lead to
        reason = first_line(error)
        raise NetworkError(f"{path}: not a network file, or a damaged one: {reason}") from error
    return model


def first_line(error: BaseException) -> str:
    """What an exception of PyTorch, ONNX or ONNX Runtime says, without the pages that follow."""
    return (str(error).strip() or repr(error)).splitlines()[0][:300]


def _weight_bytes(data: memoryview) -> int:
    """How many bytes of a model are `graph.initializer[i].raw_data`, found without parsing it."""
    total = count()
    return sum(
        len(raw)
        for number, graph in _fields(data, total)
        for number, tensor in (_fields(graph, total) if number == 7 else ())
        for number, raw in (_fields(tensor, total) if number == 5 else ())
        if number == 9
    )


def _fields(message: memoryview, total: "count[int]") -> Iterator[tuple[int, memoryview]]:
    """Numbers and contents of a protobuf message's fields; `total` counts those of all messages."""
    from google.protobuf.internal.decoder import _DecodeVarint as varint  # pyright: ignore

    position = 0
    while position < len(message):
        key, position = varint(message, position)
        kind = key % 8
        length = {0: 0, 1: 8, 5: 4}.get(kind)
        if kind == 0:
            _, position = varint(message, position)
        elif kind == 2:
            length, position = varint(message, position)
        if length is None or position + length > len(message):
            raise NetworkError("not a network file, or a truncated one")
        if next(total) > 10 * MAX_NODES:
            raise NetworkError(f"it has more than {MAX_NODES:,} operators and tensors")
        yield key // 8, message[position : position + length]
        position += length


def check_model(model: "onnx.ModelProto") -> None:
    """Raise NetworkError unless a model's contents and what it computes are allowed."""
    _check_contents(model)
    _check_computation(model)


def _check_contents(model):
    """Raise NetworkError unless the model consists of plain tensors and `OPERATORS`."""
    import onnx

    graph = model.graph
    if model.functions or model.training_info or graph.sparse_initializer:
        raise NetworkError("it holds functions, training or sparse tensors")
    if not 0 < len(graph.node) <= MAX_NODES:
        raise NetworkError(f"it has {len(graph.node):,} operators, not 1 to {MAX_NODES:,}")
    tensors = list(graph.initializer)
    for node in graph.node:
        name = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
        if name not in OPERATORS:
            raise NetworkError(
                f"the operator {name} is not allowed in a network (your own code may add to "
                f"roboarm_nmp.networks.untrusted.OPERATORS)"
            )
        for attribute in node.attribute:
            if attribute.HasField("g") or attribute.graphs or attribute.HasField("sparse_tensor"):
                raise NetworkError(f"{node.op_type} holds a graph or a sparse tensor")
            tensors += [*attribute.tensors, attribute.t]
    for tensor in tensors:
        if tensor.external_data or tensor.data_location:
            raise NetworkError("its tensors are in another file")
        if min(tensor.dims, default=0) < 0 or math.prod(tensor.dims) > MAX_ELEMENTS:
            raise NetworkError(f"it has a tensor of more than {MAX_ELEMENTS:,} numbers")
        if tensor.data_type:
            onnx.numpy_helper.to_array(tensor)  # raises if a part of it is missing


def _check_computation(model):
    """Raise NetworkError unless what it computes, for a batch of one, is within the limits."""
    import onnx

    shapes_only = onnx.ModelProto()
    shapes_only.CopyFrom(model)
    graph = shapes_only.graph
    del graph.initializer[:], graph.value_info[:]
    for value in (*graph.input, *graph.output):
        for axis, size in enumerate(value.type.tensor_type.shape.dim):
            if not size.HasField("dim_value"):
                size.dim_value = 1 if axis == 0 else 64
    for tensor in model.graph.initializer:
        if math.prod(tensor.dims) <= 1_000:
            graph.initializer.append(tensor)
        else:
            large = onnx.helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims)
            graph.input.append(large)
    graph = onnx.shape_inference.infer_shapes(shapes_only, True, True, True).graph
    sizes = {tensor.name: list(tensor.dims) for tensor in graph.initializer}
    dtypes = {}
    for value in (*graph.input, *graph.value_info, *graph.output):
        kind = value.type.tensor_type
        dtypes[value.name] = kind.elem_type
        if kind.HasField("shape") and all(size.HasField("dim_value") for size in kind.shape.dim):
            sizes[value.name] = [size.dim_value for size in kind.shape.dim]
    computed = products = 0
    for node in graph.node:
        for name in filter(None, node.output):
            if name not in sizes:
                raise NetworkError(f"the shape of a result of {node.op_type} depends on values")
            number = math.prod(sizes[name])
            if number > MAX_ELEMENTS or min(sizes[name], default=0) < 0:
                raise NetworkError(f"{node.op_type} computes more than {MAX_ELEMENTS:,} numbers")
            computed += number
            if node.op_type in ("MatMul", "Gemm", "Conv", "ConvTranspose") and number:
                channels = sizes[name][1 if "Conv" in node.op_type else -1]
                products += number * math.prod(sizes[node.input[1]]) // channels
            elif node.op_type in ("AveragePool", "MaxPool"):
                kernels = [one.ints for one in node.attribute if one.name == "kernel_shape"]
                products += number * math.prod(kernels[0])
        # By zero, the process would end.
        if node.op_type == "Div" and dtypes[node.output[0]] != onnx.TensorProto.FLOAT:
            raise NetworkError("it divides integers")
    if computed > MAX_COMPUTED or products > MAX_PRODUCTS:
        raise NetworkError("it computes too much")
