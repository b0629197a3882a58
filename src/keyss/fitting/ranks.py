"""One training in several processes of `torchrun`: each renders its share of a step's views.

Every process, identified by its *rank*, holds the same whole model. Rank 0 starts or resumes the training and
sends its state to the others. All shuffle the photos alike and take their own shares of the views. Gradients
and statistics of density control are summed in one message before they change anything, and all ranks take
the step of one process that renders all views (data parallelism; for 3DGS: Zhao et al. 2024, "On Scaling Up
3D Gaussian Splatting Training", section 3).

NCCL sums tensors on GPUs. Everything else goes over gloo, which also notices when a process ends. Without
torchrun there is one rank, and all of this does nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from keyss import _torchrun
from keyss.core.errors import BackendError, OtherProcessError, UsageError

T = TypeVar("T")

# How long the others wait for rank 0 while it evaluates or measures.
_PATIENCE = timedelta(hours=2)


@dataclass(frozen=True)
class Ranks:
    """The rank of this process among all; in a single process, all methods return their argument.

    Methods that wait for a process that has ended raise OtherProcessError.
    """

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """True for the process that writes files and displays progress."""
        return self.rank == 0

    def views(self, views_per_step: int | None) -> int:
        """Views of a step on all ranks together; None: one on each.

        Raises UsageError if they cannot be divided evenly.
        """
        views = self.count if views_per_step is None else views_per_step
        if views % self.count:
            raise UsageError(
                f"`views_per_step`: expected a multiple of the {self.count} processes, got {views}"
            )
        return views

    def mine(self, views: Sequence[T]) -> Sequence[T]:
        """This rank's share of the views of a step."""
        share = len(views) // self.count
        return views[self.rank * share : (self.rank + 1) * share]

    def sum(self, trained: Iterable[Tensor], others: Sequence[Tensor]) -> list[Tensor]:
        """Sum the gradients of `trained` in place, and return the sums of `others`, in one message.

        All are float32 on one device. A parameter without a gradient on any rank has none afterwards, and
        optimisers skip it as in one process.
        """
        if self.count == 1:
            return list(others)
        parameters = list(trained)
        given = [float(each.grad is not None) for each in parameters]
        gradients = [torch.zeros_like(each) if each.grad is None else each.grad for each in parameters]
        parts = [torch.tensor(given, device=parameters[0].device), *gradients, *others]
        flat = torch.cat([part.detach().reshape(-1) for part in parts])
        _together(lambda: dist.all_reduce(flat))
        counts, *sums = flat.split([part.numel() for part in parts])
        for parameter, count, total in zip(parameters, counts.tolist(), sums, strict=False):
            parameter.grad = total.view_as(parameter) if count else None
        return [total.view_as(each) for each, total in zip(others, sums[len(parameters) :], strict=True)]

    def agree(self, signum: int, gaussians: int) -> int:
        """The signal that any rank has received, or 0.

        Raises BackendError if numbers of `gaussians` differ: a fault of keyss or of the hardware.
        """
        if self.count == 1:
            return signum
        numbers = torch.tensor([signum, gaussians, -gaussians])
        _together(lambda: dist.all_reduce(numbers, dist.ReduceOp.MAX))
        signum, highest, lowest = numbers.tolist()
        if highest != -lowest:
            raise BackendError(
                f"the {self.count} processes differ: one has {-lowest:,} Gaussians and one {highest:,}; "
                "`resume=True` continues from the last checkpoint"
            )
        return int(signum)

    def from_first(self, data: bytes) -> bytes:
        """The `data` of rank 0, on all ranks."""
        if self.count == 1:
            return data
        size = torch.tensor([len(data)])
        _together(lambda: dist.broadcast(size, 0))
        content = torch.empty(int(size), dtype=torch.uint8)
        if self.first:
            content = torch.frombuffer(bytearray(data), dtype=torch.uint8)
        _together(lambda: dist.broadcast(content, 0))
        return content.numpy().tobytes()

    def share(self, tensors: Iterable[Tensor]) -> None:
        """Copy the `tensors` of rank 0 to all ranks, after work whose rounding differs between GPUs."""
        for tensor in tensors if self.count > 1 else ():
            _together(partial(dist.broadcast, tensor.detach(), 0))


_ALONE = Ranks()
_joined = _ALONE


def here() -> Ranks:
    """The ranks of the present `joined` block; outside of one, this process alone."""
    return _joined


@contextmanager
def joined(device: str = "auto") -> Iterator[Ranks]:
    """Join the other processes of torchrun, if there are any, on `device` (see `resolve_device`).

    An initialised `torch.distributed` is used as it is. Raises BackendError if the processes do not find each
    other, or do not have one GPU each.
    """
    global _joined
    count = _torchrun.processes()
    if count == 1 or _joined.count > 1:
        yield _joined
        return
    _choose_gpu(device)
    own = not (dist.is_available() and dist.is_initialized())
    nccl = own and _initialise(count)
    _joined = Ranks(dist.get_rank(), dist.get_world_size())
    destroys = own and not nccl
    try:
        yield _joined
        destroys = own
    finally:  # after an error, NCCL could wait for processes that have ended
        _joined = _ALONE
        if destroys:
            dist.destroy_process_group()


def _choose_gpu(device: str) -> None:
    """Choose a GPU of its own for each process on this machine."""
    if device == "cpu" or not torch.cuda.is_available():
        return
    local, gpus = _torchrun.local_rank(), torch.cuda.device_count()
    if local >= gpus:
        raise BackendError(
            f"process {local + 1} on this machine has no GPU, since there are {gpus}: start at most one "
            'process for each GPU, or use `device="cpu"`'
        )
    torch.cuda.set_device(local)


def _initialise(count: int) -> bool:
    """Set up torch.distributed; returns True if it uses NCCL."""
    if not (dist.is_available() and dist.is_gloo_available()):
        raise BackendError("several processes cannot train together: this build of torch has no gloo")
    nccl = torch.cuda.is_available() and dist.is_nccl_available()
    try:
        dist.init_process_group("cpu:gloo,cuda:nccl" if nccl else "gloo", timeout=_PATIENCE)
    except (RuntimeError, ValueError, OSError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise BackendError(
            f"the {count} processes that torchrun has started do not find each other: {reason}"
        ) from error
    return nccl


def _together(communicate: Callable[[], object]) -> None:
    """Run a collective operation. Raises OtherProcessError if a process has ended."""
    try:
        communicate()
    except RuntimeError as error:  # torch has no class for errors of gloo
        if type(error).__name__ == "OutOfMemoryError":  # whose module depends on the version
            raise
        raise OtherProcessError(
            f"another of the {_joined.count} processes that train together has ended"
        ) from error
