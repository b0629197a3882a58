"""What the holder of one key sees of a file: which cells open, and where they lie.

Not only what a reader returns: the holder of a key and of the source can try every cell.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from keyss.channels import CellCipher, Payload, QuietReader
from keyss.core import Gaussians
from keyss.keys import DerivedKey


def seen_by_holder(stego: Gaussians, key: DerivedKey) -> dict[str, float]:
    """Numbers of cells by cipher, and how they lie in the file."""
    payload, cells = _opened(stego, key)
    found = {f"cells of cipher {cipher}": float(fits.mean()) for cipher, fits in enumerate(cells)}
    used = np.sum(cells, axis=0)
    where = np.flatnonzero(used)
    found["Gaussians with several cells"] = float((used > 1).sum())
    found["Gaussians with cells"] = float((used > 0).mean())
    found["middle of the rows with cells"] = float(where.mean() / len(stego))
    found["spread of the rows with cells"] = float(where.std() / len(stego))
    if payload.chunks is not None:
        found["chunks"], found["chunks that there were"] = map(float, payload.chunks)
    return found


def _opened(stego: Gaussians, key: DerivedKey) -> tuple[Payload, list[npt.NDArray[np.bool_]]]:
    """The payload, and which Gaussians' cells fit, by cipher in order of use."""
    cells: list[npt.NDArray[np.bool_]] = []
    original = CellCipher.decrypt

    def decrypt(self: CellCipher, ids: Any, data: Any) -> Any:
        fits, plain = original(self, ids, data)
        cells.append(fits)
        return fits, plain

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CellCipher, "decrypt", decrypt)
        payload = QuietReader.of(stego).extract(key)
    return payload, cells
