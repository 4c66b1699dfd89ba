"""Network files: networks that anybody can run safely, without the script that made them.

A network file is plain data: the network's graph as a list of named PyTorch operations, its
tensors, and metadata. `load_network` interprets that list; a file from a stranger runs no code,
because nothing in it is unpickled as an object (`weights_only`) and only the operations of
`networks.operations` may be named, with arguments that were checked. (`torch.export.load`
promises less: it may unpickle objects, and evaluates strings of the file as Python expressions.)

    save_network("encoder.pt", encoder, {"points": points}, {"kind": "encoder"})
    z = load_network("encoder.pt")(points=points)
    to_float16("encoder.pt", "smaller.pt")

PyTorch's default dtype and default device change nothing: networks compute in float32, on the
device that they were loaded for.

A **policy** of an arm with n joints is a network from `observation` (N, n + 3 or more),
`achieved_goal` and `desired_goal` (N, 3, n, n + 3 or 7), float32 as `RoboArmEnv` returns them, to
the deterministic action (N, n), float32 in [-1, 1]. Other keys of the observation may be inputs,
too. The metadata of a policy hold

- `kind`: "policy";
- `task`: name of the task it was trained on;
- `robot`: name and fingerprint of the `Robot`; without it, the robot is the Panda;
- `env`: dict of the arguments of `envs.make` it was trained with: `goal_type`, and, where they
  differ from the defaults, `action_mode`, `max_step`, `velocities`, `encoder`, `num_points`,
  `geometry_source`, `link_distances` and `append_link_distances`. Others (`horizon`, tolerances)
  are ignored: they define success. With `append_link_distances`, `observation` contains these, too
  (80 numbers of the Panda); with an `encoder`, it then ends with z_E. With `link_distances`,
  `link_distances` and `goal_link_distances` (N, l, 1 + n) of l links may be inputs;
- `safety_filter`, optional: dict of `margin` (m) and `escape` (bool). Whoever runs the policy by
  name (`policies.registry`) puts that `policies.safety_filter.SafetyFilter` around it;
- `recurrent_size`, optional: an int. The policy then has an input `recurrent_state`
  (N, recurrent_size), zeros at the start of an episode, and returns [action, next recurrent_state].

An **encoder** is a network from observations of sensors to z_E (N, size), float32. Inputs are the
images of cameras, uint8 (N, height, width, 3), by the sensor's name, and `<name>_points` and
`<name>_labels` of point clouds. Its metadata hold `kind` ("encoder"), `sensors`
(`envs.perception.sensors.sensors_to_json`) and, as a policy's, `robot`.
"""

import contextlib
import copy
import io
import json
import logging
import operator
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils import _pytree as pytree

from roboarm_nmp.networks import operations as network_operations
from roboarm_nmp.networks.operations import NetworkError
from roboarm_nmp.utils.files import check_archive, write_atomically

FORMAT = "roboarm-nmp program"
VERSION = 1

# Core ATen is what every exported network can be decomposed into. These few are kept whole beside
# it: decomposed they would be slower, and differ from the module in the last bits.
_ATEN = torch.ops.aten
_EXTRA = (
    _ATEN.linear.default,
    _ATEN.layer_norm.default,
    _ATEN.silu.default,
    _ATEN.softplus.default,
    _ATEN.cdist.default,
    _ATEN.linalg_vector_norm.default,
)
# On batches of these sizes a network is compared with its module before it is saved.
_BATCH_SIZES = (1, 2, 32)
# So many shapes of inputs are remembered as checked.
_MAX_CHECKED = 1_000
MAX_REASON = 300  # characters of PyTorch's reason in an error


def save_network(
    path: str | Path,
    module: torch.nn.Module,
    example_inputs: Mapping[str, torch.Tensor],
    metadata: Mapping[str, Any],
) -> None:
    """Write a network as a network file, atomically. The module itself is not touched.

    The network is exported in eval mode, on the CPU, for any batch size; the default dtype is
    float32. It is compared with the module on the example inputs before anything is written.

    Args:
        path: the file to write; its folder must exist.
        module: `nn.Module`. Its `forward` takes the inputs by name and returns tensors, alone or in
            (nested) sequences and dicts; it may not branch on values or draw random numbers.
        example_inputs: dict from input name to a tensor (N, ...), N >= 1, on any device.
        metadata: a dict that JSON can write.

    Raises:
        NetworkError: it cannot be exported, or uses an operation that is not allowed.
        OSError: the file cannot be written.
    """
    path = Path(path)
    module = copy.deepcopy(getattr(module, "_orig_mod", module)).cpu().eval()  # undo torch.compile
    numbers = torch.arange(max(_BATCH_SIZES), device="cpu")
    inputs = {
        name: tensor.detach().cpu()[numbers % len(tensor)]
        for name, tensor in example_inputs.items()
    }
    try:
        metadata = json.loads(json.dumps(dict(metadata)))
        content = {"format": FORMAT, "version": VERSION, "metadata": metadata}
        with torch.no_grad(), _float32_by_default(), torch.device("cpu"), warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # torch's, about itself
            with _without_graph():
                content |= _export(module, inputs)
            _compare(ExportedNetwork(content), module, inputs)
    except Exception as error:  # torch.export raises many kinds
        reason = _reason(error)
        raise NetworkError(f"{path}: this network cannot be saved: {reason}") from error
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_atomically(path, buffer.getbuffer())


def to_float16(path: str | Path, output: str | Path) -> None:
    """Write a network file again with float32 tensors rounded to float16: half as large.

    The network still computes in float32, from the rounded numbers (11 significant bits). So its
    results differ: evaluate the new file.

    Raises:
        NetworkError: as `load_network`; or a number in it is too large for float16 (65,504).
        OSError: the file cannot be written.
    """
    content = _read(path)
    ExportedNetwork(content, path)  # raises NetworkError for a bad file
    rounded = {
        name: tensor.half()
        for name, tensor in content["tensors"].items()
        if tensor.dtype == torch.float32
    }
    for name, tensor in rounded.items():
        if tensor.isinf().any() and not content["tensors"][name].isinf().any():
            raise NetworkError(f"{path}: {name} has numbers too large for float16")
    tensors = content["tensors"] | rounded
    names = sorted({*rounded, *content.get("halved", ())})
    buffer = io.BytesIO()
    torch.save(content | {"tensors": tensors, "halved": names}, buffer)
    write_atomically(Path(output), buffer.getbuffer())


def load_network(path: str | Path, device: str | torch.device = "cpu") -> "ExportedNetwork":
    """Load the network in a file, its tensors on `device`.

    Raises:
        NetworkError: no such file, not a network, damaged, or with contents that are not allowed.
            Nothing of the file has been executed.
    """
    return ExportedNetwork(_read(path), path, device)


def _read(path):
    """The content of a network file, of which only format and version are checked."""
    try:
        check_archive(Path(path))
        content = torch.load(path, weights_only=True, map_location="cpu")
    except OSError as error:
        raise NetworkError(f"{path}: cannot be read: {error.strerror or error}") from error
    except zipfile.BadZipFile as error:
        raise NetworkError(f"{path}: not a network file, or a truncated one") from error
    except pickle.UnpicklingError as error:
        raise NetworkError(
            f"{path}: not a network file: it holds Python objects, which could run code and are "
            f"never loaded"
        ) from error
    except Exception as error:  # whatever broken bytes lead to
        raise NetworkError(f"{path}: not a network file, or a damaged one: {error}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise NetworkError(f"{path}: not a network file")
    if content.get("version") != VERSION:
        raise NetworkError(
            f"{path}: network version {content.get('version')!r}, this code reads {VERSION}"
        )
    return content


class ExportedNetwork:
    """A loaded network: call it with its inputs (N, ...), by name or in the order of `inputs`.

    It returns what the module returned (sequences as lists), without gradients. Raises
    NetworkError for missing inputs and for tensors that do not fit.

    Attributes:
        metadata: dict, as given to `save_network`.
        inputs: names of the inputs.
    """

    def __init__(
        self,
        content: dict[str, Any],
        path: str | Path = "network",
        device: str | torch.device = "cpu",
    ):
        self._content = content
        self._path = path
        try:
            self._build(content, torch.device(device))
        except NetworkError as error:
            raise NetworkError(f"{path}: {error}") from error
        except Exception as error:  # whatever a file with parts missing leads to
            raise NetworkError(f"{path}: damaged network: {error!r}") from error

    def parameters(self) -> list[torch.Tensor]:
        """The parameters of the module that was saved, in its order, as `nn.Module.parameters`."""
        return [
            tensor
            for name, tensor in zip(self._content["tensors"], self._tensors, strict=False)
            if name.startswith("p_")  # torch.export's prefix
        ]

    def to(self, device: str | torch.device) -> "ExportedNetwork":
        """The same network on another device."""
        return ExportedNetwork(self._content, self._path, device)

    def _build(self, content, device):
        network_operations.check_file(content)
        self._checked = set()  # shapes of inputs
        self.metadata: dict[str, Any] = dict(copy.deepcopy(content["metadata"]))
        self.inputs: list[str] = list(content["inputs"])
        # While it runs, its values lie in one list: tensors, inputs, the results of the nodes.
        float16 = set(content.get("halved", ()))  # names of tensors that are stored in float16
        self._tensors = [
            tensor.to(device, torch.float32 if name in float16 else tensor.dtype)
            for name, tensor in content["tensors"].items()
        ]
        slots = {}
        for kind, names in (("tensor", content["tensors"]), ("input", self.inputs)):
            for name in names:
                slots[kind, name] = _Slot(len(slots))
        self._nodes = []
        for name, operation, args, kwargs in content["nodes"]:
            args = [_decode(value, slots, device) for value in args]
            kwargs = {key: _decode(value, slots, device) for key, value in kwargs.items()}
            # Most arguments stay as they are: the others are known by their place.
            places = [i for i, value in enumerate(args) if _has_slots(value)]
            filled = _has_slots(kwargs)
            function = network_operations.find(operation)
            self._nodes.append((function, args, places, kwargs, filled, operation))
            slots["node", name] = _Slot(len(slots))
        self._outputs = _decode(content["outputs"], slots, device)

    def __call__(self, *args: torch.Tensor, **inputs: torch.Tensor) -> Any:
        by_name = {**dict(zip(self.inputs, args, strict=False)), **inputs}
        if len(by_name) != len(args) + len(inputs) or set(by_name) != set(self.inputs):
            raise NetworkError(
                f"{self._path}: its inputs are {', '.join(self.inputs)}; it got {len(args)} "
                f"without a name and {', '.join(inputs) or 'none'} by name"
            )
        tensors = [by_name[name] for name in self.inputs]
        if not all(isinstance(tensor, torch.Tensor) for tensor in tensors):
            raise NetworkError(f"{self._path}: its inputs are tensors")
        shapes = tuple((tensor.shape, tensor.dtype) for tensor in tensors)
        with torch.no_grad(), _float32_by_default():
            if shapes not in self._checked:
                check = network_operations.ShapeCheck()
                self.to("meta")._run([tensor.to("meta") for tensor in tensors], check)
                if len(self._checked) == _MAX_CHECKED:
                    self._checked.clear()
                self._checked.add(shapes)
            return self._run(tensors)

    def predict_one(
        self, inputs: dict[str, torch.Tensor], size: int | None | tuple[int | None, ...] = None
    ) -> Any:
        """The output for a batch of one: NumPy float32 (size,).

        Args:
            inputs: dict of tensors (1, ...).
            size: int or None for any; or a tuple of them for a network that returns several
                outputs, which come as a list of arrays.

        Raises:
            NetworkError: the output has another type or size, or is not finite.
        """
        outputs = self(**inputs)
        if not isinstance(size, tuple):
            return self._one(outputs, size)
        if not isinstance(outputs, list) or len(outputs) != len(size):
            raise NetworkError(f"{self._path}: its output is not a sequence of {len(size)}")
        return [self._one(output, width) for output, width in zip(outputs, size, strict=True)]

    def _one(self, output, size) -> np.ndarray:
        if (
            not isinstance(output, torch.Tensor)
            or output.dtype != torch.float32
            or output.ndim != 2
            or output.shape != (1, size or output.shape[1])
        ):
            wanted = f"(1, {size or 'any'})"
            raise NetworkError(f"{self._path}: its output is not float32 {wanted} for a batch of 1")
        if not output.isfinite().all():
            raise NetworkError(f"{self._path}: its output is not finite")
        return output[0].numpy()

    def _run(self, inputs, check=None):
        values = self._tensors + inputs
        for function, args, places, kwargs, filled, operation in self._nodes:
            try:
                args = args.copy()
                for i in places:
                    args[i] = _fill(args[i], values)
                if filled:
                    kwargs = _fill(kwargs, values)
                if check is not None:
                    check.before(operation, args)
                values.append(function(*args, **kwargs))
                if check is not None:
                    check.after(function, values[-1])
            except Exception as error:  # wrong shapes or types, of many kinds
                raise NetworkError(f"{self._path}: {operation} failed: {error}") from error
        return _fill(self._outputs, values)


@contextlib.contextmanager
def _float32_by_default():
    """Inside, PyTorch's default dtype is float32, as where networks were exported."""
    before = torch.get_default_dtype()
    if before == torch.float32:
        yield
        return
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


# --- Graph -> data


@contextlib.contextmanager
def _without_graph():
    """PyTorch prints the graph of a module that it cannot export: pages, without a reason."""
    logger = logging.getLogger("torch.fx.experimental.symbolic_shapes")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        logger.setLevel(level)


def _reason(error):
    """Why a network cannot be saved, in one line. PyTorch's messages have many, and graphs."""
    text = str(error).strip() or type(error).__name__
    place = re.search(r'File "[^"]*?([^"/]+)", line (\d+), in (\w+)', text)
    where = f" ({place[1]}, line {place[2]}, in {place[3]})" if place else ""
    if type(error).__name__ == "GuardOnDataDependentSymNode":  # to import it takes a second
        return f"its forward branches on a value{where}, which a list of operations cannot do"
    line = text.splitlines()[0]
    return (line if len(line) <= MAX_REASON else f"{line[:MAX_REASON]} ...") + where


class _ByName(torch.nn.Module):
    """Passes its positional inputs on by name: torch.export keeps the order of those."""

    def __init__(self, module, names):
        super().__init__()
        self.module = module
        self.names = names

    def forward(self, *inputs):
        return self.module(**dict(zip(self.names, inputs, strict=True)))


def _export(module, inputs):
    """The parts of a network's content that say what it computes."""
    exported = torch.export.export(
        _ByName(module, tuple(inputs)),
        tuple(inputs.values()),
        dynamic_shapes=(tuple({0: torch.export.Dim.DYNAMIC} for _ in inputs),),
    )
    decompositions = torch.export.default_decompositions()
    for operation in _EXTRA:
        decompositions.pop(operation, None)
    exported = exported.run_decompositions(decompositions)
    signature = exported.graph_signature
    if any(spec.kind.name != "USER_OUTPUT" for spec in signature.output_specs):
        raise NetworkError("its forward changes an input or a buffer")

    needed = set()  # assertions about shapes have no users, and go
    for node in reversed(exported.graph.nodes):
        if node.op == "output" or not needed.isdisjoint(node.users):
            needed.add(node)
    stored = {**exported.state_dict, **exported.constants}
    targets = {spec.arg.name: spec.target for spec in signature.input_specs}
    names = dict(zip(signature.user_inputs, inputs, strict=True))
    python_names = {getattr(operator, n.partition(".")[2]): n for n in network_operations.PYTHON}
    references = {}
    tensors = {}
    nodes = []
    outputs = None
    for node in exported.graph.nodes:
        if node.op == "output":
            structure = exported.call_spec.out_spec
            assert structure is not None
            outputs = pytree.tree_unflatten(node.args[0], structure)
        elif node.name in names:
            references[node] = {"input": names[node.name]}
        elif node in needed and node.op == "placeholder":
            # A copy, because a view would be saved with all of the storage it is a view of.
            tensors[node.name] = stored[str(targets[node.name])].detach().clone().contiguous()
            references[node] = {"tensor": node.name}
        elif node in needed:
            name = python_names.get(node.target, str(node.target))
            args = _encode(node.args, references)
            kwargs = {key: _encode(value, references) for key, value in node.kwargs.items()}
            nodes.append([node.name, name, args, kwargs])
            references[node] = {"node": node.name}
    outputs = _encode(outputs, references)
    return {"inputs": list(inputs), "outputs": outputs, "nodes": nodes, "tensors": tensors}


def _compare(network, module, inputs):
    """Raise NetworkError unless both compute the same for all `_BATCH_SIZES`."""
    for size in _BATCH_SIZES:
        batch = {name: tensor[:size] for name, tensor in inputs.items()}
        saved = pytree.tree_leaves(network(**batch))
        expected = pytree.tree_leaves(module(**batch))
        try:
            for ours, theirs in zip(saved, expected, strict=True):
                torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5, equal_nan=True)
        except (AssertionError, ValueError) as error:
            raise NetworkError(
                "saved, it would behave differently; does its forward depend on values or on the "
                f"batch size? {error}"
            ) from error


def _encode(value, references):
    """An argument or output as data. What is not a plain value is a dict with one entry."""
    if isinstance(value, torch.fx.Node):
        return references[value]
    if isinstance(value, (list, tuple)):
        return [_encode(item, references) for item in value]
    if isinstance(value, dict):
        return {"dict": {key: _encode(item, references) for key, item in value.items()}}
    if isinstance(value, torch.device):
        return {"device": "of the program"}
    if isinstance(value, (torch.dtype, torch.layout, torch.memory_format)):
        return {"torch": str(value).removeprefix("torch.")}
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise NetworkError(f"its graph has a {type(value).__name__} among the arguments")


# --- Data -> something to run


class _Slot(int):
    """Stands for the value at this place in the list of values."""


def _decode(value, slots, device):
    if isinstance(value, list):
        return [_decode(item, slots, device) for item in value]
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "dict":
        return {key: _decode(item, slots, device) for key, item in content.items()}
    if kind == "device":
        return device
    if kind == "torch":
        return network_operations.constant(content)
    return slots[kind, content]


def _has_slots(value):
    """Whether there are any in a decoded argument."""
    if isinstance(value, dict):
        value = list(value.values())
    return any(map(_has_slots, value)) if isinstance(value, list) else isinstance(value, _Slot)


def _fill(value: Any, values: list) -> Any:
    """A decoded argument or output, with the values its slots stand for."""
    kind = type(value)
    if kind is _Slot:
        return values[value]
    if kind is list:
        return [_fill(item, values) for item in value]
    if kind is dict:
        return {key: _fill(item, values) for key, item in value.items()}
    return value
