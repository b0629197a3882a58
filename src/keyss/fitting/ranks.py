"""One training on several processes, as `torchrun` starts them: each draws its share of a step's views.

Every process, called by its *rank*, holds the whole model, and all hold the same. Rank 0 begins or resumes
and gives its state to the others. All of them shuffle the photos alike and take their own shares of the
views. What they find, gradients and what density control goes by, is summed in one message before anything is
changed by it, so that all take the same step: that of one process which draws all the views (data
parallelism; for 3DGS: Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training", section 3).

Tensors on GPUs are summed by NCCL. Everything else goes over gloo, which also notices a process that has
ended. Without torchrun there is one rank, and nothing here does anything.
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

# How long the others wait for rank 0 where it works alone: while it looks at test views, or measures.
_PATIENCE = timedelta(hours=2)


@dataclass(frozen=True)
class Ranks:
    """All processes of a run, as one of them sees them; without others all methods give what they get.

    Raises OtherProcessError from whatever waits for another process that has ended.
    """

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this process answers for the run: it writes the files and shows the progress."""
        return self.rank == 0

    def views(self, asked: int | None) -> int:
        """Views of a step, on all ranks together; one on each unless others are asked for.

        Raises UsageError where they cannot be shared out evenly.
        """
        views = self.count if asked is None else asked
        if views % self.count:
            raise UsageError(
                f"`views_per_step`: expected a multiple of the {self.count} processes, got {views}"
            )
        return views

    def mine(self, drawn: Sequence[T]) -> Sequence[T]:
        """This rank's share of what all ranks have drawn alike."""
        share = len(drawn) // self.count
        return drawn[self.rank * share : (self.rank + 1) * share]

    def sum(self, trained: Iterable[Tensor], others: Sequence[Tensor]) -> list[Tensor]:
        """Sums over all ranks: gradients of `trained` become theirs, those of `others` are returned.

        All float32 on one device, in one message. A parameter that has a gradient on no rank has none
        afterwards, and an optimiser passes it over as it does in one process.
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
        """The signal that any of the ranks was sent, 0: none. All must have as many `gaussians`.

        Raises BackendError where they have not: then they hold different models, by no fault of anybody's
        but this program's or the hardware's.
        """
        if self.count == 1:
            return signum
        numbers = torch.tensor([signum, gaussians, -gaussians])
        _together(lambda: dist.all_reduce(numbers, dist.ReduceOp.MAX))
        found, most, least = numbers.tolist()
        if most != -least:
            raise BackendError(
                f"the {self.count} processes have come apart: one has {-least:,} Gaussians and one {most:,}; "
                "`resume=True` continues from the last checkpoint"
            )
        return int(found)

    def from_first(self, data: bytes) -> bytes:
        """What rank 0 gives, on all ranks."""
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
        """Rank 0's numbers in the `tensors` of all: after what GPUs may each compute a little differently."""
        for each in tensors if self.count > 1 else ():
            _together(partial(dist.broadcast, each.detach(), 0))


_ALONE = Ranks()
_joined = _ALONE


def here() -> Ranks:
    """The ranks that this process works with: others than itself within `joined` only."""
    return _joined


@contextmanager
def joined(device: str = "auto") -> Iterator[Ranks]:
    """Work with the other processes that torchrun has started, if it has, on `device` (see `resolve_device`).

    A program that has set up `torch.distributed` keeps what it has. Raises BackendError where the processes
    do not find each other, or have no GPU each.
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
    parts = own and not nccl
    try:
        yield _joined
        parts = own
    finally:  # after an error the others may be gone, and NCCL may wait for them
        _joined = _ALONE
        if parts:
            dist.destroy_process_group()


def _choose_gpu(device: str) -> None:
    """A GPU of its own for each process on this machine."""
    if device == "cpu" or not torch.cuda.is_available():
        return
    local, gpus = _torchrun.local_rank(), torch.cuda.device_count()
    if local >= gpus:
        raise BackendError(
            f"process {local + 1} on this machine has no GPU of its own, for there are {gpus}: start as many "
            'processes as there are GPUs, or compute with `device="cpu"`'
        )
    torch.cuda.set_device(local)


def _initialise(count: int) -> bool:
    """Whether NCCL is there for tensors on GPUs."""
    if not (dist.is_available() and dist.is_gloo_available()):
        raise BackendError("this build of torch cannot let several processes train together: it has no gloo")
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
    """What takes all ranks. Raises OtherProcessError where one of them is gone."""
    try:
        communicate()
    except RuntimeError as error:  # torch has no class of its own for what gloo finds
        if type(error).__name__ == "OutOfMemoryError":  # which lies elsewhere in older versions
            raise
        raise OtherProcessError(
            f"another of the {_joined.count} processes that train together has ended"
        ) from error
