"""A secret as bytes: what is sealed under its key. safetensors with a JSON header, nothing executable.

It holds the decoder (a network's weights in half precision, all constants whole) with the embedding that
it belongs to, the similarity that leads back to the secret's own frame, and *anchors*: positions of some
Gaussians of the stego model, which are there in any order and, mostly, after pruning, and tell whether a
sidecar belongs to a model. A secret's bytes say nothing of other secrets.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, get_args, get_type_hints

import numpy as np
import safetensors
import safetensors.torch
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.methods.learned.decoder import Decoder, DecoderShape
from keyss.methods.learned.mask import parse_mask
from keyss.methods.learned.scramble import CHANNELS, KEY_BYTES, KNOTS, LEAST_OPACITY, Scramble

FORMAT = "keyss-secret"
VERSION = 3
MOST_GAUSSIANS = 2**31
ANCHORS = 64
ANCHORS_NEEDED = 0.25  # share that must be found again
ANCHOR_TOLERANCE = 1e-6  # of the model's size
_WEIGHTS = "decoder."
# What reading a damaged header or damaged weights can raise.
_DAMAGE = (
    safetensors.SafetensorError,
    KeyError,
    TypeError,
    ValueError,
    RuntimeError,
    AttributeError,
    RecursionError,
    UsageError,
)


@dataclass(frozen=True)
class HiddenSecret:
    """All that revealing one secret needs besides the stego model."""

    decoder: Decoder
    frame: Similarity  # from the secret's own frame into the cover's
    anchors: Tensor  # [A, 3] positions of Gaussians of the stego model
    scramble: Scramble | None = None  # what the secret's Gaussians are published as, if not as they are
    # [M, 7] position, opacity logit and constant colour of all transparent Gaussians: formats round their
    # opacities to nothing, and some drop the colours of what is transparent.
    faint: Tensor | None = None
    count: int = 0  # Gaussians that the secret has when it is revealed from a whole file; 0: not known

    def with_faint(self, stego: Gaussians) -> Gaussians:
        """`stego` with transparent Gaussians as the nearest in `faint` are, or all nearly opaque."""
        transparent = stego.opacities < LEAST_OPACITY
        opacity_logits, sh = stego.opacity_logits.clone(), stego.sh.clone()
        if self.faint is None:
            opacity_logits[transparent] = self.decoder.faint_logit
        else:
            tree = cKDTree(self.faint[:, :3].double().numpy())
            _, nearest = tree.query(stego.means[transparent].cpu().double().numpy())
            known = self.faint[torch.from_numpy(nearest)].to(stego.device)
            opacity_logits[transparent], sh[transparent, 0] = known[:, 3], known[:, 4:]
        return replace(stego, opacity_logits=opacity_logits, sh=sh)

    @property
    def embedding(self) -> Tensor:
        """[64] what its key is to the decoder."""
        return self.decoder.key

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


def pack_secret(secret: HiddenSecret) -> bytes:
    """The bytes of a secret; the same secret gives the same bytes."""
    decoder = secret.decoder
    header = {
        "format": FORMAT,
        "version": VERSION,
        "shape": {**asdict(decoder.shape), "mask": ",".join(decoder.shape.mask)},
        "frame": secret.frame.to_json(),
        "count": secret.count,
    }
    halved = {name for name, _ in decoder.named_parameters()}
    tensors = {
        _WEIGHTS + name: (value.half() if name in halved else value).detach().cpu().contiguous()
        for name, value in decoder.state_dict().items()
    }
    tensors["anchors"] = secret.anchors.contiguous()
    if secret.faint is not None:
        tensors["faint"] = secret.faint.contiguous()
    if secret.scramble is not None:
        tensors |= {
            "scramble.key": torch.frombuffer(bytearray(secret.scramble.key), dtype=torch.uint8),
            "scramble.band": torch.tensor(secret.scramble.band),
            "scramble.own": secret.scramble.own,
            "scramble.shown": secret.scramble.shown,
        }
    return safetensors.torch.save(tensors, {"keyss": json.dumps(header)})


def unpack_secret(data: bytes) -> HiddenSecret:
    """The secret of `pack_secret`. Raises InputError for anything else, for damage, and another version."""
    try:
        tensors = safetensors.torch.load(data)
        header = json.loads(_metadata(data).get("keyss", "null"))
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise InputError("what the key opens is no secret of keyss")
        if header.get("version") != VERSION:
            raise InputError(
                f"secret of version {header.get('version')!r}; this program reads version {VERSION}"
            )
        return _from_parts(header, tensors)
    except _DAMAGE as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"what the key opens is no secret of keyss, or damaged: {reason}") from error


def _metadata(data: bytes) -> dict[str, str]:
    """The text that safetensors carries; `safetensors.torch.load` has checked the sizes."""
    size = int.from_bytes(data[:8], "little")
    metadata = json.loads(data[8 : 8 + size]).get("__metadata__") or {}
    if not isinstance(metadata, dict):
        raise TypeError("metadata: expected an object")
    return metadata


def _from_parts(header: dict[str, Any], tensors: dict[str, Tensor]) -> HiddenSecret:
    shape = _shape(dict(header["shape"]))
    scramble = _scramble({name: tensors.pop(name) for name in list(tensors) if name.startswith("scramble.")})
    if not all(
        value.dtype in (torch.float16, torch.float32) and value.isfinite().all() for value in tensors.values()
    ):
        raise InputError("weights: expected finite numbers of half or single precision")
    anchors = tensors.pop("anchors").float()
    if anchors.dim() != 2 or anchors.shape[1] != 3 or not 1 <= len(anchors) <= ANCHORS:
        raise InputError(f"anchors: expected up to {ANCHORS} positions, got shape {list(anchors.shape)}")
    faint = tensors.pop("faint", None)
    if faint is not None and (faint.dim() != 2 or faint.shape[1] != 7 or len(faint) == 0):
        raise InputError(f"transparent Gaussians: expected rows of 7 numbers, got shape {list(faint.shape)}")
    decoder = Decoder(shape)
    decoder.load_state_dict({name.removeprefix(_WEIGHTS): value for name, value in tensors.items()})
    if not (decoder.knots.diff() > 0).all():
        raise InputError("opacity curve: expected ascending knots")
    frame = Similarity.from_json(header["frame"])
    count = header["count"]
    if type(count) is not int or not 0 <= count <= MOST_GAUSSIANS:
        raise InputError(f"number of Gaussians: expected 0 to {MOST_GAUSSIANS:,}, got {count!r}")
    return HiddenSecret(decoder.requires_grad_(False), frame, anchors, scramble, faint, count)


def _scramble(tensors: dict[str, Tensor]) -> Scramble | None:
    if not tensors:
        return None
    key, band, own, shown = (tensors[f"scramble.{name}"] for name in ("key", "band", "own", "shown"))
    tables = (own, shown)
    if not (
        key.dtype == torch.uint8
        and key.shape == (KEY_BYTES,)
        and band.shape == (2,)
        and all(table.dtype == torch.float32 and table.shape == (CHANNELS, KNOTS) for table in tables)
        and all(table.isfinite().all() and (table.diff(dim=1) >= 0).all() for table in tables)
    ):
        raise InputError("scrambled Gaussians: expected a key, a band and two ascending tables")
    return Scramble(bytes(key.tolist()), (float(band[0]), float(band[1])), own, shown)


def _shape(given: dict[str, Any]) -> DecoderShape:
    """The shape that a header states, held to bounds. Raises InputError, and what `_DAMAGE` lists."""
    expected = {field.name for field in fields(DecoderShape)}
    if set(given) != expected:
        raise InputError(f"decoder shape: expected {sorted(expected)}, got {sorted(given)}")
    first, second = given["hidden"]
    bounds = {"branch": (1, 4096), "frequencies": (0, 16), "sh_degree": (0, 3)}
    sizes = [(first, 1, 4096), (second, 1, 4096), *((given[name], *span) for name, span in bounds.items())]
    names = [
        (given[name], get_args(get_type_hints(DecoderShape)[name]))
        for name in ("kind", "conditioning", "design", "residuals")
    ]
    if not (
        all(type(value) is int and low <= value <= high for value, low, high in sizes)
        and all(value in allowed for value, allowed in names)
    ):
        raise InputError(f"decoder shape out of range: {given}")
    return DecoderShape(**{**given, "mask": parse_mask(str(given["mask"])), "hidden": (first, second)})
