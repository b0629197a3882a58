"""The decoder on disk: safetensors with a JSON header, nothing executable.

The header names the format and its version, the decoder's shape, the costs of key derivation, and for
each secret a verifier of its key and the similarity that leads back to its own frame. It is bound to its
stego model by *anchors*: positions of some of its Gaussians, which are there in any order and, mostly,
after pruning.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.files.atomic import write_bytes
from keyss.hiding.decoder import Decoder, DecoderShape
from keyss.hiding.mask import parse_mask
from keyss.seal.keys import DerivedKey, KeyDerivation

FORMAT = "keyss-decoder"
VERSION = 1
MAX_BYTES = 1 << 30
MAX_SECRETS = 256
ANCHORS = 64
ANCHORS_NEEDED = 0.25  # share that must be found again
ANCHOR_TOLERANCE = 1e-6  # of the model's size
# What reading a damaged header or damaged weights can raise.
_DAMAGE = (
    safetensors.SafetensorError,
    KeyError,
    TypeError,
    ValueError,
    RuntimeError,
    AttributeError,
    UsageError,
)


@dataclass(frozen=True)
class HiddenSecret:
    """What is kept of a secret: how to recognise its key, and where its own frame is."""

    verifier: bytes
    frame: Similarity  # from the secret's own frame into the cover's


@dataclass(frozen=True)
class SavedDecoder:
    """A trained decoder with all that revealing needs besides the key and the stego model."""

    decoder: Decoder
    derivation: KeyDerivation
    secrets: tuple[HiddenSecret, ...]
    anchors: Tensor  # [A, 3] positions of Gaussians of the stego model

    def find(self, key: DerivedKey) -> HiddenSecret:
        """The secret that `key` opens. Raises WrongKeyError if there is none."""
        found = [secret for secret in self.secrets if key.matches(secret.verifier)]
        if not found:
            raise WrongKeyError("this key opens nothing in this model")
        return found[0]

    def check_belongs_to(self, stego: Gaussians) -> None:
        """Raise InputError unless enough anchors are Gaussians of `stego`."""
        means = stego.means.detach().double().cpu().numpy()
        size = float(np.ptp(means, axis=0).max())
        distances, _ = cKDTree(means).query(self.anchors.double().numpy())
        found = float((distances <= ANCHOR_TOLERANCE * size).mean())
        if found < ANCHORS_NEEDED:
            raise InputError(
                f"this decoder was made for another model: {found:.0%} of its anchors are in this PLY, "
                f"at least {ANCHORS_NEEDED:.0%} expected "
                "(quantising the positions does that too: --force tries all the same)"
            )


def choose_anchors(stego: Gaussians, generator: torch.Generator) -> Tensor:
    """[A, 3] positions of randomly chosen Gaussians."""
    return stego.means[torch.randperm(len(stego), generator=generator)[:ANCHORS]].detach().cpu()


def save_decoder(path: Path | str, saved: SavedDecoder) -> None:
    """Write a decoder atomically. The same decoder gives the same bytes. Raises OutputError."""
    header = {
        "format": FORMAT,
        "version": VERSION,
        "shape": {**asdict(saved.decoder.shape), "mask": ",".join(saved.decoder.shape.mask)},
        "derivation": {**asdict(saved.derivation), "salt": saved.derivation.salt.hex()},
        "secrets": [{"verifier": s.verifier.hex(), "frame": s.frame.to_json()} for s in saved.secrets],
    }
    tensors = {name: value.detach().cpu().contiguous() for name, value in saved.decoder.state_dict().items()}
    tensors["anchors"] = saved.anchors.contiguous()
    write_bytes(path, safetensors.torch.save(tensors, {"keyss": json.dumps(header)}))


def load_decoder(path: Path | str) -> SavedDecoder:
    """Read a decoder. Raises InputError for anything else, for damage, and for another version."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"too large for a decoder ({path.stat().st_size} bytes)")
        with safetensors.safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("keyss", "null"))
            _check_version(header)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return _from_parts(header, tensors)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot read the decoder: {error.strerror or error}") from error
    except _DAMAGE as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: not a decoder, or damaged: {reason}") from error


def _check_version(header: Any) -> None:
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError("not a keyss decoder")
    if header.get("version") != VERSION:
        raise InputError(
            f"decoder of version {header.get('version')!r}; this program reads version {VERSION}"
        )


def _from_parts(header: dict[str, Any], tensors: dict[str, Tensor]) -> SavedDecoder:
    shape = dict(header["shape"])
    sizes = {name: int(shape[name]) for name in ("hidden", "branch", "frequencies", "sh_degree")}
    if not (0 <= sizes["sh_degree"] <= 3 and 0 <= sizes["frequencies"] <= 16):
        raise InputError(f"decoder shape out of range: {sizes}")
    if not all(1 <= sizes[name] <= 4096 for name in ("hidden", "branch")):
        raise InputError(f"decoder shape out of range: {sizes}")
    derivation = header["derivation"]
    if not 1 <= len(header["secrets"]) <= MAX_SECRETS:
        raise InputError(f"expected 1 to {MAX_SECRETS} secrets, got {len(header['secrets'])}")
    anchors = tensors.pop("anchors")
    if anchors.dim() != 2 or anchors.shape[1] != 3 or not 1 <= len(anchors) <= ANCHORS:
        raise InputError(f"anchors: expected up to {ANCHORS} positions, got shape {list(anchors.shape)}")
    if not all(
        value.dtype == torch.float32 and value.isfinite().all() for value in (anchors, *tensors.values())
    ):
        raise InputError("weights: expected finite float32 numbers")
    decoder = Decoder(DecoderShape(mask=parse_mask(str(shape["mask"])), **sizes))
    decoder.load_state_dict(tensors)
    return SavedDecoder(
        decoder=decoder.requires_grad_(False),
        derivation=KeyDerivation(
            salt=bytes.fromhex(derivation["salt"]),
            time_cost=derivation["time_cost"],
            memory_kib=derivation["memory_kib"],
            parallelism=derivation["parallelism"],
        ),
        secrets=tuple(
            HiddenSecret(bytes.fromhex(entry["verifier"]), Similarity.from_json(entry["frame"]))
            for entry in header["secrets"]
        ),
        anchors=anchors,
    )
