"""Network files: ONNX, run by ONNX Runtime on one thread.

    network = load_network("policy.onnx")
    action = network(observation=..., achieved_goal=..., desired_goal=...)    # batches (N, ...)

What policies and encoders receive and return, and their metadata: docs/reference/file_formats.md.
"""

import copy
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roboarm_nmp.networks.untrusted import NetworkError, first_line, read_model

if TYPE_CHECKING:  # it takes a while to import
    import onnx


def load_network(path: str | Path, provider: str = "CPUExecutionProvider") -> "Network":
    """Load a network file, which may come from a stranger (`networks.untrusted`).

    Args:
        path: of an ONNX file.
        provider: of ONNX Runtime; `CUDAExecutionProvider` needs `onnxruntime-gpu`.

    Raises:
        NetworkError: the file or provider does not exist, or the file is damaged or has contents
            that are not allowed.
    """
    return Network(read_model(path), path, provider)


class Network:
    """A loaded network: call it with all its inputs, by name.

    NumPy arrays (N, ...) give an array, or a list of them if the network has several outputs;
    PyTorch's tensors give tensors on the same device, without gradients. Where the network adds one
    input to others, it may be a batch of one. Raises NetworkError for inputs that do not fit.

    Attributes:
        metadata: dict, as given to `save_network`.
        inputs, outputs: dict of name -> shape, a tuple with None for a size that varies.
    """

    def __init__(
        self, model: "onnx.ModelProto", path: str | Path, provider: str = "CPUExecutionProvider"
    ):
        import onnxruntime

        self._path = path
        self._provider = provider
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = 4
        if provider not in onnxruntime.get_available_providers():
            raise NetworkError(f"{path}: ONNX Runtime has no {provider} here")
        model = copy.deepcopy(model)
        try:
            for one in model.graph.input:  # ONNX Runtime takes equal names for equal sizes
                size = one.type.tensor_type.shape.dim[0]
                if size.dim_param:
                    size.dim_param = f"N of {one.name}"
            self._session = onnxruntime.InferenceSession(
                model.SerializeToString(), options, providers=[provider]
            )
            self.metadata: dict[str, Any] = {
                entry.key: json.loads(entry.value) for entry in model.metadata_props
            }
        except Exception as error:  # ONNX Runtime's are of many kinds
            raise NetworkError(f"{path}: {first_line(error)}") from error
        self.inputs = {one.name: _shape(one) for one in self._session.get_inputs()}
        self.outputs = {one.name: _shape(one) for one in self._session.get_outputs()}

    def __reduce__(self):
        return load_network, (self._path, self._provider)

    def __call__(self, **inputs: Any) -> Any:
        device = next((one.device for one in inputs.values() if hasattr(one, "detach")), None)
        if device is None:
            outputs = self._run(inputs)
        else:
            import torch

            arrays = {name: tensor.detach().cpu().numpy() for name, tensor in inputs.items()}
            outputs = [torch.from_numpy(array).to(device) for array in self._run(arrays)]
        return outputs[0] if len(outputs) == 1 else outputs

    def predict_one(self, inputs: Mapping[str, np.ndarray], *sizes: int | None) -> list[np.ndarray]:
        """The outputs for one input: arrays float32 (size,), one for each of `sizes`.

        Args:
            inputs: dict of arrays without the axis N; others than the network's are ignored.
            sizes: of the outputs; None for any.

        Raises:
            NetworkError: an input does not fit, or an output has another type or size, or is not
                finite.
        """
        outputs = self._run({name: inputs[name][None] for name in self.inputs})
        if len(outputs) != len(sizes):
            raise NetworkError(f"{self._path}: it has {len(outputs)} outputs, not {len(sizes)}")
        for output, size in zip(outputs, sizes, strict=True):
            fits = output.ndim == 2 and output.shape == (1, size or output.shape[1])
            if output.dtype != np.float32 or not fits:
                raise NetworkError(f"{self._path}: its output is not float32 (1, {size or 'any'})")
            if not np.isfinite(output).all():
                raise NetworkError(f"{self._path}: its output is not finite")
        return [output[0] for output in outputs]

    def _run(self, arrays: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        if arrays.keys() != self.inputs.keys():
            got = ", ".join(arrays) or "none"
            raise NetworkError(f"{self._path}: its inputs are {', '.join(self.inputs)}, not {got}")
        try:
            return self._session.run(None, arrays)  # pyright: ignore[reportReturnType]
        except Exception as error:  # wrong shapes or types, of many kinds
            raise NetworkError(f"{self._path}: {first_line(error)}") from error


def _shape(value) -> tuple[int | None, ...]:
    return tuple(size if isinstance(size, int) else None for size in value.shape)
