"""What the holder of one key sees of a file: which rows open, and where they lie.

Not only what a reader returns: the holder of a key and of the source can look at every row.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from keyss.channels import Chunks, Message, Payload, QuietReader
from keyss.core import Gaussians
from keyss.keys import DerivedKey


def seen_by_holder(stego: Gaussians, key: DerivedKey) -> dict[str, float]:
    """Numbers of rows of messages and chunks, and how they lie in the file."""
    payload, messages, chunks = _opened(stego, key)
    where = np.flatnonzero(chunks)
    found = {f"rows of message {index}": float(each) for index, each in enumerate(messages)}
    found["rows with chunks"] = float(chunks.mean())
    found["middle of the rows with chunks"] = float(where.mean() / len(stego))
    found["spread of the rows with chunks"] = float(where.std() / len(stego))
    if payload.chunks is not None:
        found["chunks"], found["chunks that there were"] = map(float, payload.chunks)
    return found


def _opened(stego: Gaussians, key: DerivedKey) -> tuple[Payload, list[int], npt.NDArray[np.bool_]]:
    """The payload, places of each message that hold it, and which Gaussians seem to hold chunks."""
    messages: list[int] = []
    chunks: list[npt.NDArray[np.bool_]] = []
    read, decrypt = Message.read, Chunks.decrypt

    def read_message(self: Message, ids: Any, low: Any) -> bytes:
        data = read(self, ids, low)
        rows, contents = self.write(ids, data)
        messages.append(int((low[rows, : self.width] == contents).all(axis=1).sum()))
        return data

    def decrypt_chunks(self: Chunks, ids: Any, low: Any) -> Any:
        found = decrypt(self, ids, low)
        chunks.append(found[0])
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Message, "read", read_message)
        patch.setattr(Chunks, "decrypt", decrypt_chunks)
        payload = QuietReader.of(stego).extract(key)
    return payload, messages, chunks[0]
