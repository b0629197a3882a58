"""What a peer hands over, as bytes, and the secret that it stands for."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

import msgspec
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from keyss.channels.base import Content, Payload
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.methods.base import Frame, Remains

_DTYPES = (torch.float32, torch.uint8)
_DAMAGE = (safetensors.SafetensorError, msgspec.MsgspecError, ValueError, KeyError, RuntimeError)


class _Header(msgspec.Struct, forbid_unknown_fields=True):
    """In safetensors' metadata."""

    rows: int | None  # Gaussians of the model that it belongs to, where they must be as they were
    scale: float
    rotation: list[list[float]]
    translation: list[float]


@dataclass(frozen=True)
class HandedTensors:
    """Tensors, and how the secret lies in the cover's frame."""

    tensors: Mapping[str, Tensor]  # float32 or uint8
    frame: Similarity = field(default_factory=Similarity.identity)  # from the secret's into the cover's
    rows: int | None = None  # Gaussians of the published model, where they must be there in their order

    def payload(self, method: str) -> Payload:
        """As it is handed over by the method of that name."""
        rotation, translation = self.frame.rotation.tolist(), self.frame.translation.tolist()
        header = _Header(self.rows, self.frame.scale, rotation, translation)
        text = msgspec.json.encode(header).decode()
        kept = {name: value.detach().cpu().contiguous() for name, value in self.tensors.items()}
        return Payload(method, safetensors.torch.save(kept, {"peer": text}))

    @staticmethod
    def of(content: Content) -> HandedTensors:
        """What `payload` gave. Raises InputError for anything else."""
        try:
            if not isinstance(content, Payload):
                raise ValueError("records")
            data = content.data
            tensors = safetensors.torch.load(data)
            size = int.from_bytes(data[:8], "little")
            outer = msgspec.json.decode(data[8 : 8 + size], type=dict[str, msgspec.Raw])
            text = msgspec.json.decode(outer["__metadata__"], type=dict[str, str])["peer"]
            header = msgspec.json.decode(text, type=_Header)
            turn = torch.tensor(header.rotation, dtype=torch.float64)
            shift = torch.tensor(header.translation, dtype=torch.float64)
            frame = Similarity(header.scale, turn, shift)
        except _DAMAGE as error:
            reason = (str(error) or type(error).__name__).splitlines()[0][:200]
            raise InputError(f"what was handed over is damaged: {reason}") from error
        for name, value in tensors.items():
            if value.dtype not in _DTYPES or not bool(value.isfinite().all()):
                raise InputError(f"what was handed over is damaged: {name[:80]} is not finite numbers")
        return HandedTensors(tensors, frame, header.rows)

    def taken(self, names: Iterable[str], *, of_bytes: Collection[str] = ()) -> list[Tensor]:
        """Tensors by name, and no others: uint8 those `of_bytes`, else float32. Raises InputError."""
        names = list(names)
        if set(names) != set(self.tensors):
            found = ", ".join(sorted(self.tensors))[:200]
            raise InputError(f"what was handed over is damaged: expected {', '.join(names)}, found {found}")
        wanted = {name: torch.uint8 if name in of_bytes else torch.float32 for name in names}
        if wrong := [name for name in names if self.tensors[name].dtype != wanted[name]]:
            raise InputError(f"what was handed over is damaged: numbers of another kind in {wrong[0]}")
        return [self.tensors[name] for name in names]

    def digest(self) -> str:
        return hashlib.sha256(self.payload("peer").data).hexdigest()[:16]


@dataclass(frozen=True)
class HandedSecret:
    """An `Opened`: what a handed-over file makes of the published model."""

    handed: HandedTensors
    show: Callable[[Gaussians], Gaussians]  # of a model on the CPU, in the cover's frame; raises InputError
    aligned: bool = True  # whether the secret was in the cover's frame
    decode: None = None

    @property
    def frame(self) -> Similarity | None:
        return self.handed.frame if self.aligned else None

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """See `Opened.reveal`; a model that has not the same Gaussians any more has no secret at all."""
        rows = self.handed.rows
        if rows is not None and len(stego) != rows:
            raise InputError(
                f"expected the {rows:,} Gaussians that were published, in their order, got {len(stego):,}: "
                "what was handed over belongs to them one by one"
            )
        if frame == "cover" and not self.aligned:
            raise UsageError('this secret never was in the cover\'s frame: leave out `frame="cover"`')
        shown = self.show(stego.detach().to("cpu"))
        if not self.aligned or frame == "cover":
            return shown
        return self.handed.frame.inverse().apply_gaussians(shown)

    def remains(self, revealed: Gaussians) -> Remains:
        """All of it, or there was nothing."""
        return Remains(len(revealed), len(revealed))

    def fingerprint(self) -> str:
        return self.handed.digest()
