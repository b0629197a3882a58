"""What `torchrun` says in the environment about this process: which one of how many it is.

Nothing heavy is imported here, for the command line asks before it loads anything.
"""

import os

_NAMES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")  # what `torch.distributed` reads as well


def processes() -> int:
    """How many processes work on this run together; 1 without torchrun."""
    if not all(os.environ.get(name) for name in _NAMES):
        return 1
    return max(1, _number("WORLD_SIZE", 1)) if 0 <= _number("RANK", -1) < _number("WORLD_SIZE", 1) else 1


def rank() -> int:
    """Which of them this one is; the first, 0, answers for the run."""
    return _number("RANK", 0) if processes() > 1 else 0


def local_rank() -> int:
    """Which of those on this machine it is, and so which GPU it takes."""
    return max(0, _number("LOCAL_RANK", rank()))


def _number(name: str, otherwise: int) -> int:
    text = os.environ.get(name, "")
    return int(text) if text.isascii() and text.isdigit() else otherwise
