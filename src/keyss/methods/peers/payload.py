"""The file that a peer hands over, and the secret that it reveals."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from keyss.channels import Content, Payload
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.methods.opened import Frame, Remains
from keyss.methods.tensors import FrameRecord, Header, damage_refused, pack_tensors, unpack_tensors

FORMAT, VERSION = "keyss-peer", 1
DAMAGED = "what was handed over is damaged"


@dataclass(frozen=True)
class _Header(Header):
    rows: int | None
    frame: FrameRecord | None


@dataclass(frozen=True)
class HandedTensors:
    """Tensors to hand over, and where the secret is in the cover's frame."""

    tensors: Mapping[str, Tensor]  # float32 or uint8
    frame: Similarity | None = None  # from the secret's into the cover's; None: never placed there
    rows: int | None = None  # Gaussians of the published model, if they are needed in their order

    def payload(self, method: str) -> Payload:
        """The file of the method of that name."""
        frame = None if self.frame is None else FrameRecord.of(self.frame)
        return Payload(method, pack_tensors(self.tensors, _Header(FORMAT, VERSION, self.rows, frame)))

    @staticmethod
    def of(content: Content) -> HandedTensors:
        """The tensors of `payload`. Raises InputError for anything else."""
        with damage_refused(DAMAGED):
            if not isinstance(content, Payload):
                raise ValueError("expected one string of bytes, got records")
            header, tensors = unpack_tensors(content.data, _Header, FORMAT, VERSION)
            frame = None if header.frame is None else header.frame.similarity
        return HandedTensors(tensors, frame, header.rows)

    def taken(self, names: Iterable[str], *, of_bytes: Collection[str] = ()) -> list[Tensor]:
        """The tensors of these names: uint8 those `of_bytes`, else float32.

        Raises InputError for other types, and if there are more or fewer.
        """
        expected = {name: torch.uint8 if name in of_bytes else torch.float32 for name in names}
        if expected != {name: value.dtype for name, value in self.tensors.items()}:
            found = ", ".join(sorted(self.tensors))[:200]
            raise InputError(f"{DAMAGED}: expected {', '.join(expected)}, found {found}")
        return [self.tensors[name] for name in expected]


Show = Callable[[Gaussians], Gaussians]  # from a model on the CPU, in the cover's frame; raises ValueError


@dataclass(frozen=True)
class HandedSecret:
    """An `Opened`: a handed-over file applied to the published model."""

    handed: HandedTensors
    show: Show
    decode: None = None

    @property
    def frame(self) -> Similarity | None:
        return self.handed.frame

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """See `Opened.reveal`; raises InputError for a model with other Gaussians."""
        rows = self.handed.rows
        if rows is not None and len(stego) != rows:
            raise InputError(
                f"expected the {rows:,} Gaussians that were published, in their order, got {len(stego):,}: "
                "what was handed over belongs to them one by one"
            )
        if frame == "cover" and self.frame is None:
            raise UsageError('this secret never was in the cover\'s frame: leave out `frame="cover"`')
        with damage_refused("what was handed over does not fit"):
            shown = self.show(stego.detach().to("cpu"))
        if self.frame is None or frame == "cover":
            return shown
        return self.frame.inverse().apply_gaussians(shown)

    def remains(self, revealed: Gaussians) -> Remains:
        """All of the secret: damage reveals nothing."""
        return Remains(len(revealed), len(revealed))

    def fingerprint(self) -> str:
        return hashlib.sha256(self.handed.payload("peer").data).hexdigest()[:16]
