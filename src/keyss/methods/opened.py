"""The results of opening with a key: the protocol of hidden scenes, and hidden files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import torch
from torch import Tensor

from keyss.channels import Content, Payload
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import DerivedKey

Frame = Literal["secret", "cover"]

FILE = "file"  # in the place of a method's name
MAX_NAME_BYTES = 255
_STRENGTH = 0.02  # standard deviation of changes of opacity logits
_MOVE = 1e-4  # standard deviation of rotations (radians), shifts (of the model's size) and changes of scale
_FAINT = 1.6 * DRAWN_OPACITY  # opacity that appended Gaussians do not reach
_KNOTS, _LOGITS = 16, 10.0  # the changes are a piecewise linear function of logits from -10 to 10


@dataclass(frozen=True)
class Remains:
    """The part of a secret that is left in a model."""

    found: int  # Gaussians that are left
    hidden: int  # Gaussians that were hidden; 0: unknown
    chunks: tuple[int, int] | None = None  # of the payload: those left and those written; None: no chunks
    slack: float = 0.0  # share by which the numbers may differ although nothing was lost

    @property
    def share(self) -> float:
        """The share of the hidden Gaussians that is left: 0 to 1, more if Gaussians were added."""
        return self.found / self.hidden if self.hidden else float(self.found > 0)

    @property
    def whole(self) -> bool:
        """True if nothing was lost or added."""
        return abs(self.share - 1) <= self.slack and (self.chunks is None or self.chunks[0] == self.chunks[1])


class Opened(Protocol):
    """A secret as its key opens it, before it is revealed."""

    @property
    def frame(self) -> Similarity | None:
        """From the secret's own frame into the cover's; None if it was never in the cover's."""

    @property
    def decode(self) -> Callable[[Gaussians, Tensor], Gaussians] | None:
        """The decoder, from a stego model and a key's vector [`key_size`] to Gaussians in the cover's frame.

        The white-box attack follows its gradient in the vector. None if keys condition no decoder: then a
        wrong key shows nothing at all.
        """

    @property
    def key_size(self) -> int:
        """Numbers of a key's vector; 0 without a decoder."""

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The secret as a model of its own, on the CPU; `force`: even from a changed model.

        Raises InputError for a model that it does not belong to, UsageError for a frame that it never was in.
        """

    def remains(self, revealed: Gaussians) -> Remains:
        """The part of the secret that `reveal` gave."""

    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the secret in a run, and tell nothing about it."""


@dataclass(frozen=True)
class HiddenFile:
    """A hidden file with its former name, which is shown and never used as a path."""

    name: str
    data: bytes = field(repr=False)

    def payload(self) -> Payload:
        """The payload for a channel. Raises UsageError for a name of more than MAX_NAME_BYTES."""
        name = self.name.encode()
        if len(name) > MAX_NAME_BYTES:
            raise UsageError(f"expected a name of at most {MAX_NAME_BYTES} bytes, got {len(name)}")
        return Payload(FILE, bytes([len(name)]) + name + self.data)

    @staticmethod
    def of(content: Content) -> HiddenFile:
        """The file of a payload. Raises InputError for other content, and for damage."""
        if content.method != FILE or not isinstance(content, Payload):
            raise InputError("this key opens a scene, not a file: give it a model's name, such as secret.ply")
        size = content.data[0] if content.data else 0
        name, data = content.data[1 : 1 + size], content.data[1 + size :]
        if not content.data or len(name) < size:
            raise InputError("the hidden file is damaged: its name is cut off")
        return HiddenFile(name.decode(errors="replace"), data)


class OpensAFileError(InputError):
    """The key opens a hidden file where a scene was expected."""

    def __init__(self, file: HiddenFile) -> None:
        super().__init__(
            f"this key opens a file of {len(file.data):,} bytes, not a scene: give it a name that is not a "
            "model's"
        )
        self.file = file


@dataclass(frozen=True)
class Decoy:
    """An `Opened` that shows the cover, changed too little to be seen.

    Opacities change by a smooth function of opacity, and everything by a similarity, both sampled from the
    derived key: without the key nobody can compute the bytes, and they differ from those of the cover.
    """

    frame: Similarity
    changes: torch.Tensor  # [_KNOTS] of opacity logits
    appended: bool = False  # True if the model has appended Gaussians, which are left out
    decode: None = None
    key_size: int = 0

    @staticmethod
    def of(stego: Gaussians, key: DerivedKey, *, appended: bool = False) -> Decoy:
        """The decoy of a wrong key, the same whenever model and key are the same."""
        generator = torch.Generator().manual_seed(int.from_bytes(key.expand("decoy", 8), "little") >> 1)
        changes = _STRENGTH * torch.randn(_KNOTS, generator=generator)
        rotation, shift = _MOVE * torch.randn(2, 3, generator=generator, dtype=torch.float64)
        skew = torch.zeros(3, 3, dtype=torch.float64)
        skew[[2, 0, 1], [1, 2, 0]] = rotation
        size = (stego.means - stego.means.mean(0)).norm(dim=1).median().double().clamp_min(1e-9).cpu()
        scale = 1 + _MOVE + abs(float(shift.mean()))  # far enough from 1 to change all log scales
        return Decoy(Similarity(scale, torch.matrix_exp(skew - skew.T), shift * size), changes, appended)

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The rendered Gaussians of the cover, all changed; see `Opened.reveal`."""
        stego = stego.to("cpu")
        position = (stego.opacity_logits / _LOGITS).clamp(-1, 1).add(1).mul((_KNOTS - 1) / 2)
        left = position.long().clamp_max(_KNOTS - 2)
        change = torch.lerp(self.changes[left], self.changes[left + 1], position - left)
        changed = replace(stego, opacity_logits=stego.opacity_logits + change)
        visible = stego.opacities > _FAINT if self.appended else changed.opacities >= DRAWN_OPACITY
        if visible.any():
            changed = changed[visible]
        return changed if frame == "cover" else self.frame.inverse().apply_gaussians(changed)

    def remains(self, revealed: Gaussians) -> Remains:
        """All of the decoy, which is never damaged."""
        return Remains(len(revealed), len(revealed))

    def fingerprint(self) -> str:
        """A constant, which no secret of a run has."""
        return "decoy"
