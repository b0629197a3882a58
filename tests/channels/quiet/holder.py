"""What the holder of one key sees of a file: which cells open, and where they lie.

Not only what a reader returns: the holder of a key and of the source can try every cell.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from keyss.channels import CellCipher, QuietReader, Records
from keyss.core import Gaussians
from keyss.keys import DerivedKey


def seen_by_holder(stego: Gaussians, key: DerivedKey) -> dict[str, float]:
    """Numbers of cells by cipher and slot, and how they lie in the file, relative to what comes out."""
    content, cells = _opened(stego, key)
    found: dict[str, float] = {}
    size = max(len(content.records) if isinstance(content, Records) else 1, 1)
    used = np.zeros(len(next(iter(cells.values()))), np.int64)  # readers leave out copies
    for (cipher, slot), fits in cells.items():
        found[f"cells of cipher {cipher}, slot {slot}, of all Gaussians"] = float(fits.mean())
        found[f"cells of cipher {cipher}, slot {slot}, of records"] = float(fits.sum() / size)
        used += fits
    found["cells of records"] = float(used.sum() / size)
    found["Gaussians with several cells, of those with one"] = float(
        (used > 1).sum() / max((used > 0).sum(), 1)
    )
    found["Gaussians with cells"] = float((used > 0).mean())
    where = np.flatnonzero(used)
    found["middle of the rows with cells"] = float(where.mean() / len(stego))
    found["spread of the rows with cells"] = float(where.std() / len(stego))
    if isinstance(content, Records):
        found["bytes of a record"] = float(content.records.shape[1])
        found["cells of a carrier"] = float(content.plan.cells_per_carrier)
        found["records"] = float(len(content.records) / len(stego))
    elif content.chunks is not None:
        found["chunks"], found["chunks that there were"] = map(float, content.chunks)
    return found


def _opened(stego: Gaussians, key: DerivedKey) -> tuple[Any, dict[tuple[int, int], npt.NDArray[np.bool_]]]:
    """The content, and by cipher (in order of use) and slot which Gaussians' cells fit."""
    ciphers: list[CellCipher] = []
    cells: dict[tuple[int, int], list[npt.NDArray[np.bool_]]] = {}
    original = CellCipher.decrypt

    def decrypt(self: CellCipher, ids: Any, data: Any, slot: Any = 0) -> Any:
        fits, plain = original(self, ids, data, slot)
        if not any(each is self for each in ciphers):
            ciphers.append(self)
        index = next(at for at, each in enumerate(ciphers) if each is self)
        cells.setdefault((index, int(slot)), []).append(fits)
        return fits, plain

    every = QuietReader._decrypt  # readers look for copies in cells without a record only

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CellCipher, "decrypt", decrypt)
        patch.setattr(
            QuietReader,
            "_decrypt",
            lambda self, cipher, width, cells=1, _=None: every(self, cipher, width, cells),
        )
        content = QuietReader.of(stego).extract(key)
    return content, {name: np.concatenate(parts) for name, parts in cells.items()}
