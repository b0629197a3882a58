"""The rank of this process among those of `torchrun`, from the environment.

Imports nothing slow, since the command line needs it before it loads anything.
"""

import os

_NAMES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")  # also read by `torch.distributed`


def processes() -> int:
    """The number of processes of this run; 1 without torchrun."""
    if not all(os.environ.get(name) for name in _NAMES):
        return 1
    return max(1, _number("WORLD_SIZE", 1)) if 0 <= _number("RANK", -1) < _number("WORLD_SIZE", 1) else 1


def rank() -> int:
    """The rank of this process; 0 is the first."""
    return _number("RANK", 0) if processes() > 1 else 0


def local_rank() -> int:
    """The rank of this process on this machine, and the index of its GPU."""
    return max(0, _number("LOCAL_RANK", rank()))


def _number(name: str, default: int) -> int:
    text = os.environ.get(name, "")
    return int(text) if text.isascii() and text.isdigit() else default
