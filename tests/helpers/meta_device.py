"""PyTorch's `meta` device in CUDA's place: its tensors do not mix with the CPU's.

They have no contents. Explicit transfers (`item`, `tolist`, `cpu`) return ones; `.numpy()`, and an
operation on tensors of two devices, raise as on a GPU. It has no kernels, so it does not notice
mixed dtypes in one.
"""

import contextlib

import pytest
import torch
from torch.fx.experimental import _config

ANSWERED = ("item", "tolist", "cpu", "__float__", "__int__", "__bool__")


@contextlib.contextmanager
def in_cudas_place():
    """Inside, `--device meta` works."""
    # Of which elements are not zero: all, or no program with `nonzero` could go on.
    with pytest.MonkeyPatch.context() as patch, _config.patch(meta_nonzero_assume_all_nonzero=True):
        for name in ANSWERED:
            patch.setattr(torch.Tensor, name, _answered(getattr(torch.Tensor, name)))
        # There is no fused kernel for it.
        adam = torch.optim.Adam
        patch.setattr(torch.optim, "Adam", lambda *args, fused, **options: adam(*args, **options))
        yield


def _answered(method):
    def answer(self, *args, **kwargs):
        here = torch.ones_like(self, device="cpu") if self.is_meta else self
        return method(here, *args, **kwargs)

    return answer
