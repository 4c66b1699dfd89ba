"""A check that no kernel gets floating-point tensors of two types, as it would on a GPU."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class OneType(TorchDispatchMode):
    """Refuses floating-point tensors of two types in one kernel, as many of CUDA's do.

    It is asked about what really runs, autocast's casts done and gradients included.
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
