"""From PyTorch to network files: ONNX, exported by `torch.onnx`.

save_network("encoder.onnx", encoder, {"points": points}, {"kind": "encoder"}, ["latent"])
to_float16("encoder.onnx", "smaller.onnx")
"""

import copy
import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from roboarm_nmp.networks.network_file import Network
from roboarm_nmp.networks.untrusted import NetworkError, check_model, first_line, read_model
from roboarm_nmp.utils.files import write_atomically


class _ByName(torch.nn.Module):
    """Passes positional inputs on by name: `torch.export` keeps the order of those."""

    def __init__(self, module, names):
        super().__init__()
        self.module = module
        self.names = names

    def forward(self, *inputs):
        outputs = self.module(**dict(zip(self.names, inputs, strict=True)))
        if isinstance(outputs, torch.Tensor):
            outputs = [outputs]
        return [output.clone() for output in outputs]  # one may be an input


def save_network(
    path: str | Path,
    module: torch.nn.Module,
    example_inputs: Mapping[str, torch.Tensor],
    metadata: Mapping[str, Any],
    output_names: Sequence[str],
    variable_axes: Mapping[str, Sequence[int]] | None = None,
) -> None:
    """Write a network as an ONNX file, atomically. The module itself stays as it is.

    It is exported in eval mode, on the CPU, for any batch size, and compared with the module on the
    example inputs before anything is written.

    Args:
        path: the file to write; its folder must exist.
        module: its `forward` takes the inputs by name and returns one tensor or a sequence of them,
            float32 (N, ...); it may not branch on values or draw random numbers.
        example_inputs: dict from input name to a tensor (N, ...), N >= 1, on any device.
        metadata: a dict that JSON can write; the file's `metadata_props`, each as JSON.
        output_names: names of the outputs.
        variable_axes: dict from input name to its axes, besides the first, whose sizes may vary.

    Raises:
        NetworkError: the network cannot be exported, uses an operator that is not allowed, or the
            file would compute something else.
        OSError: the file cannot be written.
    """
    module = copy.deepcopy(getattr(module, "_orig_mod", module)).cpu().eval()  # undo torch.compile
    numbers = torch.arange(32, device="cpu")
    inputs = {name: one.detach().cpu()[numbers % len(one)] for name, one in example_inputs.items()}
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with torch.no_grad(), torch.device("cpu"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of PyTorch, about itself
            logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # torchvision is not needed
            model = _export(module, inputs, output_names, variable_axes or {})
            for name, value in metadata.items():
                model.metadata_props.add(key=name, value=json.dumps(value))
            check_model(model)
            _compare(Network(model, "saved"), module, inputs)
    except Exception as error:  # PyTorch's are of many kinds
        while error.__cause__ is not None and not isinstance(error, NetworkError):
            error = error.__cause__  # PyTorch wraps the reason
        raise NetworkError(f"{path}: it cannot be saved: {first_line(error)}") from error
    finally:
        torch.set_default_dtype(before)
    write_atomically(Path(path), model.SerializeToString())


def _export(module, inputs, output_names, variable_axes):
    """The `onnx.ModelProto` of a module."""
    import onnxscript.optimizer

    axes = [
        {axis: torch.export.Dim.DYNAMIC for axis in (0, *variable_axes.get(name, ()))}
        for name in inputs
    ]
    translations = {torch.ops.aten._cdist_forward.default: _distances}
    program = torch.export.export(
        _ByName(module, tuple(inputs)), tuple(inputs.values()), dynamic_shapes=(tuple(axes),)
    )
    exported = torch.onnx.export(
        program,
        input_names=list(inputs),
        output_names=output_names,
        optimize=False,
        verbose=False,
        custom_translation_table=translations,
    )
    assert exported is not None
    # Transposed weights would lose their names.
    keep_weights = lambda node: False if node.op_type == "Transpose" else None  # noqa: E731
    onnxscript.optimizer.optimize_ir(
        exported.model, should_fold=keep_weights, output_size_limit=1_000
    )
    model = exported.model_proto
    del model.graph.value_info[:]
    for node in model.graph.node:
        del node.metadata_props[:]  # source lines of PyTorch
        node.name = ""
        for i, name in enumerate(node.input):
            node.input[i] = name.removeprefix("module.")
    for tensor in model.graph.initializer:
        tensor.name = tensor.name.removeprefix("module.")
    for value in (*model.graph.input, *model.graph.output):
        value.type.tensor_type.shape.dim[0].dim_param = "N"
    return model


def _distances(x, y, p, mode=None):
    """`torch.cdist` of few points, which `torch.onnx` does not translate."""
    from onnxscript import opset20

    op: Any = opset20

    if p != 2:
        raise NetworkError("torch.cdist with another norm than the Euclidean one")
    return op.ReduceL2(op.Sub(op.Unsqueeze(x, [-2]), op.Unsqueeze(y, [-3])), [-1], keepdims=0)


def _compare(network, module, inputs):
    """Raise NetworkError unless both compute the same, for batches of 1, 2 and 32."""
    for number in (1, 2, 32):
        batch = {name: tensor[:number] for name, tensor in inputs.items()}
        saved, expected = network(**batch), module(**batch)
        if isinstance(expected, torch.Tensor):
            saved, expected = [saved], [expected]
        for one, other in zip(saved, expected, strict=True):
            if not torch.allclose(one, other, rtol=1e-4, atol=1e-5, equal_nan=True):
                raise NetworkError(
                    "saved, it would behave differently; does it depend on the batch size?"
                )


def read_weights(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors in a network file by name, float32: those of the module's `state_dict`, too."""
    import onnx

    tensors = read_model(path).graph.initializer
    return {one.name: onnx.numpy_helper.to_array(one).astype(np.float32) for one in tensors}


def to_float16(path: str | Path, output: str | Path) -> None:
    """Write a network file again with its weights rounded to float16: half as large.

    The network still computes in float32, from the rounded numbers (11 significant bits). So its
    results differ: evaluate the new file.

    Raises:
        NetworkError: as `load_network`; or a number in it is too large for float16 (65,504).
        OSError: the file cannot be written.
    """
    import onnx

    model = read_model(path)
    rounded = {}
    for tensor in model.graph.initializer:
        if tensor.data_type == onnx.TensorProto.FLOAT and np.prod(tensor.dims) >= 64:
            numbers = onnx.numpy_helper.to_array(tensor)
            half = numbers.astype(np.float16)
            if (np.isinf(half) & ~np.isinf(numbers)).any():
                raise NetworkError(f"{path}: {tensor.name} has numbers too large for float16")
            rounded[tensor.name] = f"{tensor.name}.float32"
            tensor.CopyFrom(onnx.numpy_helper.from_array(half, tensor.name))
    for node in model.graph.node:
        for i, name in enumerate(node.input):
            node.input[i] = rounded.get(name, name)
    casts = [
        onnx.helper.make_node("Cast", [name], [one], to=onnx.TensorProto.FLOAT)
        for name, one in rounded.items()
    ]
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    write_atomically(Path(output), model.SerializeToString())
