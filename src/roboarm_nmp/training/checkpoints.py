"""The file `checkpoint.pt` of a run: everything that changes, also PyTorch's random numbers."""

import errno
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from roboarm_nmp.training.arguments import fail
from roboarm_nmp.training.errors import check_finite
from roboarm_nmp.utils.files import check_archive, new_contents


def save_checkpoint(path: Path, parts: dict[str, Any], device: str) -> None:
    """Write a checkpoint.

    Args:
        path: the file.
        parts: dict from names to the parts of a checkpoint: anything with `state_dict` and
            `load_state_dict` (modules, optimisers), a tensor, a dict of plain values, or a NumPy
            generator.
        device: of the training.

    Raises:
        FloatingPointError: a module's parameters are not finite. The old checkpoint remains.
    """
    for name, part in parts.items():
        if isinstance(part, torch.nn.Module):
            for parameter in part.parameters():
                check_finite(f"the parameters of `{name}`", parameter)
    state = {name: _state_of(part) for name, part in parts.items()}
    state["torch_rng"] = torch.get_rng_state()
    if torch.device(device).type == "cuda":
        state["cuda_rng"] = torch.cuda.get_rng_state(device)
    try:
        with new_contents(path) as temporary:
            torch.save(state, temporary)
    except RuntimeError as error:  # PyTorch's, for a full disk
        raise OSError(errno.ENOSPC, str(error).splitlines()[0], path.name) from error


def load_checkpoint(path: Path, parts: dict[str, Any], device: str) -> None:
    """Restore the parts that `save_checkpoint` has written, each on its device.

    Raises:
        SystemExit: the checkpoint is damaged, or has other parts.
    """
    try:  # on the CPU first, where replay buffers belong
        check_archive(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file leads to any of many
        fail(f"--resume: {path} is damaged: {error}")
    for name, part in parts.items():
        try:
            _restore(part, state[name])
        except (KeyError, RuntimeError):  # PyTorch's, which lists all weights
            fail(f"--resume: {path} is of another version of the trainer: its {name} differs")
    torch.set_rng_state(state["torch_rng"])
    if "cuda_rng" in state:
        torch.cuda.set_rng_state(state["cuda_rng"], device)


def _state_of(part):
    if isinstance(part, np.random.Generator):
        return json.dumps(part.bit_generator.state)  # its integers are too large for torch.save
    if isinstance(part, torch.Tensor):
        return part.detach()
    return part if isinstance(part, dict) else part.state_dict()


def _restore(part, state) -> None:
    if isinstance(part, np.random.Generator):
        part.bit_generator.state = json.loads(state)
    elif isinstance(part, torch.Tensor):
        part.data.copy_(state)
    elif isinstance(part, dict):
        if missing := part.keys() - state.keys():
            raise KeyError(min(missing))
        part.update(state)
    else:
        part.load_state_dict(state)
        for group in getattr(part, "param_groups", ()):
            if isinstance(group["lr"], torch.Tensor):  # of `training.devices.adam`
                group["lr"] = group["lr"].to(group["params"][0].device)
