"""A check that no kernel receives floating-point tensors of two dtypes, which CUDA's reject."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class OneType(TorchDispatchMode):
    """Rejects floating-point tensors of two dtypes in one kernel, as many of CUDA's do.

    It checks the executed kernels: after autocast's casts, gradients included.
    """

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        leaves = torch.utils._pytree.tree_leaves((args, kwargs or {}))
        kinds = {
            one.dtype
            for one in leaves
            if isinstance(one, torch.Tensor) and one.is_floating_point() and one.dim() > 0
        }
        name = function.overloadpacket.__name__
        assert len(kinds) < 2 or name == "copy_", f"{name} of {kinds}"
        return function(*args, **(kwargs or {}))
