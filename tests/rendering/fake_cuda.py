"""Simulates a GPU on the CPU: tensors that report the device "cuda:0".

Tensors created on "cuda", and results computed from them, are `GpuTensor`s. Mixing devices in one operation
and `numpy()` of GPU tensors raise as on a GPU, and copies between devices are copies. Backward passes hand
plain tensors to `Function.backward`, unchecked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("cuda", 0)

# Functions that accept both devices.
_CROSSING = (Tensor.__getitem__, Tensor.__setitem__, Tensor.copy_, Tensor.index_put_, Tensor.grad.__set__)
_BACKWARD = (Tensor.backward, torch.autograd.backward, torch.autograd.grad)
_TO_HOST = (Tensor.numpy, Tensor.__array__)


class GpuTensor(Tensor):
    __torch_function__ = torch._C._disabled_torch_function_impl  # `GpuMode` handles all functions

    device = DEVICE  # type: ignore[assignment]
    is_cuda = True


def as_cpu(tensor: Tensor) -> Tensor:
    """The same memory as a CPU tensor."""
    return tensor.as_subclass(Tensor)


class GpuMode(TorchFunctionMode):
    """Tracks the device of every tensor."""

    def __init__(self, *, checks: bool = True) -> None:
        self.checks = checks

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch._C._nn._parse_to:  # of `Module.to`
            return func(*args, **kwargs)
        if func is torch._has_compatible_shallow_copy_type:
            return isinstance(args[0], GpuTensor) == isinstance(args[1], GpuTensor)
        if func in _BACKWARD and self.checks:
            with GpuMode(checks=False):
                return func(*args, **kwargs)
        tensors = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        there = any(isinstance(tensor, GpuTensor) for tensor in tensors)
        if there and func in _TO_HOST:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        wanted = [name for each in tree_leaves((args, kwargs)) if (name := _device(each)) is not None]
        if func is Tensor.to and len(tensors) == 2:
            wanted.append("cuda" if isinstance(tensors[1], GpuTensor) else "cpu")
        moves = bool(wanted) or func in (Tensor.cpu, Tensor.cuda)
        if self.checks and there and not moves and func not in _CROSSING:
            foreign = [
                tensor.shape for tensor in tensors if not isinstance(tensor, GpuTensor) and tensor.dim() > 0
            ]
            if foreign:
                raise RuntimeError(
                    f"{func}: expected all tensors to be on one device, got {foreign} on the CPU"
                )
        if self.checks and func is Tensor.__getitem__ and not isinstance(args[0], GpuTensor) and there:
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor")
        goes = there if not wanted else wanted[-1] == "cuda"
        goes = (goes and func is not Tensor.cpu) or func is Tensor.cuda
        here = tree_map(lambda each: torch.device("cpu") if _device(each) == "cuda" else each, (args, kwargs))
        result = func(*here[0], **here[1])
        if moves and tensors and isinstance(result, Tensor) and goes != isinstance(args[0], GpuTensor):
            result = result.clone() if result.data_ptr() == args[0].data_ptr() else result
        if any(result is tensor for tensor in tensors):
            return result
        return tree_map(lambda each: _placed(each, goes), result)


def _device(value: object) -> str | None:
    if isinstance(value, torch.device):
        return value.type
    if isinstance(value, str) and value in ("cpu", "cuda", "cuda:0"):
        return value.split(":")[0]
    return None


def _placed(value: Any, there: bool) -> Any:
    if not isinstance(value, Tensor) or isinstance(value, GpuTensor) == there:
        return value
    return value.as_subclass(GpuTensor if there else Tensor)


@contextmanager
def fake_cuda() -> Iterator[torch.device]:
    """Simulate a GPU; yields its device."""
    with GpuMode():
        yield DEVICE
