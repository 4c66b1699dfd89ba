"""What a network file from a stranger may hold, checked before ONNX Runtime receives it.

Plain tensors and standard operators: no control flow, no random numbers, no code and no other
files. So memory and time follow from the shapes of the inputs, and are limited for a batch of one.
"""

import math
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # it takes a while to import
    import onnx

MAX_BYTES = 100_000_000  # of a file
MAX_OTHER_BYTES = 1_000_000  # without weights: parsed, they may take a hundred times the memory
MAX_NODES = 10_000
MAX_ELEMENTS = 2**24  # numbers in a tensor, stored or computed
MAX_KNOWN = 100  # numbers in a tensor of sizes or indices
MAX_COMPUTED = 2**26  # numbers that all operators read and compute
MAX_PRODUCTS = 2**31  # multiplications
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
_NAMES_OF_SIZES = """
Add Cast Concat Gather Mul Range Reshape Shape Slice Squeeze Sub Unsqueeze
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
            # By these, and by an input that is left out, the process would end.
            numbers = [attribute.i, *attribute.ints]
            lowest = -10 if attribute.name in ("axis", "axes") else 0
            outputs = len(node.output) if attribute.name == "num_outputs" else attribute.i
            if min(numbers) < lowest or max(numbers) > MAX_ELEMENTS or attribute.i != outputs:
                raise NetworkError(f"{node.op_type} has a wrong {attribute.name}")
            tensors += [*attribute.tensors, attribute.t]
        if "" in node.input and node.op_type != "Clip":
            raise NetworkError(f"{node.op_type} lacks an input")
    for tensor in tensors:
        if tensor.external_data or tensor.data_location:
            raise NetworkError("its tensors are in another file")
        if min(tensor.dims, default=0) < 0 or math.prod(tensor.dims) > MAX_ELEMENTS:
            raise NetworkError(f"it has a tensor of more than {MAX_ELEMENTS:,} numbers")
        if tensor.data_type == onnx.TensorProto.STRING:
            raise NetworkError("it holds text")
        if tensor.data_type:
            onnx.numpy_helper.to_array(tensor)  # raises if a part of it is missing


def _check_computation(model):
    """Raise NetworkError unless what it computes, for a batch of one, is within the limits."""
    import onnx
    from onnx.reference import ReferenceEvaluator

    graph = model.graph
    versions = {one.domain: one.version for one in model.opset_import}
    integers = (onnx.TensorProto.INT32, onnx.TensorProto.INT64)
    types: dict[str, Any] = {}  # of tensors by name
    sizes = {}
    known = {}  # tensors of sizes and indices
    for value in graph.input:
        kind = types[value.name] = onnx.TypeProto()
        kind.CopyFrom(value.type)
        for axis, size in enumerate(kind.tensor_type.shape.dim):
            if not size.HasField("dim_value"):
                size.dim_value = 1 if axis == 0 else 64
            elif size.dim_value < 1:
                raise NetworkError(f"the size of {value.name} is not positive")
    for tensor in graph.initializer:
        types[tensor.name] = onnx.helper.make_tensor_type_proto(tensor.data_type, tensor.dims)
        if tensor.data_type in integers and math.prod(tensor.dims) <= MAX_KNOWN:
            known[tensor.name] = tensor
    computed = products = 0
    for node in graph.node:
        inputs = [name for name in node.input if name]
        if not types.keys().isdisjoint(node.output):
            raise NetworkError(f"a result of {node.op_type} has the name of another tensor")
        schema = onnx.defs.get_schema(node.op_type, versions[node.domain], node.domain)
        types |= onnx.shape_inference.infer_node_outputs(
            schema, node, {name: types[name] for name in inputs}, known, None, model.opset_import
        )
        for name in (*inputs, *filter(None, node.output)):
            kind: Any = types.get(name, onnx.TypeProto()).tensor_type
            shape = kind.shape.dim
            if not kind.HasField("shape") or not all(size.HasField("dim_value") for size in shape):
                raise NetworkError(f"the shape of a result of {node.op_type} depends on values")
            sizes[name] = [size.dim_value for size in shape]
            number = math.prod(sizes[name])
            if number > MAX_ELEMENTS or min(sizes[name], default=0) < 0:
                raise NetworkError(f"{node.op_type} computes more than {MAX_ELEMENTS:,} numbers")
            if kind.elem_type == onnx.TensorProto.STRING:
                raise NetworkError("it holds text")
            computed += number
        is_known = node.op_type == "Shape" or known.keys() >= {*inputs}
        is_size = node.op_type in _NAMES_OF_SIZES.split() and kind.elem_type in integers
        if is_known and is_size and number <= MAX_KNOWN:
            if node.op_type == "Shape":
                arrays = {inputs[0]: np.broadcast_to(np.float32(0), sizes[inputs[0]])}
            else:
                arrays = {name: onnx.numpy_helper.to_array(known[name]) for name in inputs}
            (array,) = ReferenceEvaluator(node, opsets=versions).run(None, arrays)
            known[node.output[0]] = onnx.numpy_helper.from_array(np.asarray(array))
        if node.op_type in ("MatMul", "Gemm") and number:
            products += number * math.prod(sizes[node.input[1]]) // sizes[name][-1]
        elif node.op_type in ("Conv", "ConvTranspose"):
            weights = sizes[node.input[1]]
            most = max(number, math.prod(sizes[node.input[0]])) * math.prod(weights[1:])
            products += most
            computed += most // weights[0]  # patches of the image, as a matrix
        elif node.op_type in ("AveragePool", "MaxPool"):
            kernels = [one.ints for one in node.attribute if one.name == "kernel_shape"]
            products += 8 * number * math.prod(kernels[0])  # slower than the others
        # By zero, the process would end.
        if node.op_type == "Div" and kind.elem_type != onnx.TensorProto.FLOAT:
            raise NetworkError("it divides integers")
    if computed > MAX_COMPUTED or products > MAX_PRODUCTS:
        raise NetworkError("it computes too much")
