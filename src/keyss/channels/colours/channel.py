"""Payloads in colours, which survive rounding formats and changes of order and frame.

A payload is encrypted and authenticated (ChaCha20-Poly1305), encoded (`fountain`) and written into the
colours (`qim`) of Gaussians identified by their other numbers (`carriers`). A *header* under a few *salts*
holds the parameters for reading. Nothing in the model reveals how many secrets there are, or that there is
one.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from keyss.channels.base import (
    METHOD_BYTES,
    NOT_INDEPENDENT,
    Capacity,
    Channel,
    Content,
    check_keys,
    pack_payload,
    randomness,
)
from keyss.channels.colours.carriers import Carriers
from keyss.channels.colours.colours_reader import ASSOCIATED
from keyss.channels.colours.fountain import Fountain
from keyss.channels.colours.header import (
    FILE_KEY_BYTES,
    IDLE,
    SHARES,
    Header,
    Secrets,
    bucket_bytes,
    median,
    places,
)
from keyss.channels.colours.planner import MIN_HEADERS, Layout, Planner, bucket_of
from keyss.channels.colours.qim import ONE, bit_counts, seeds, write
from keyss.channels.colours.salt_gaussians import SALTS, Salts, renew_salts
from keyss.core.arrays import Doubles, Flags
from keyss.core.errors import KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import MASTER_BYTES, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, encrypt
from keyss.rendering.orbit import psnr_between

_TOO_FEW = "this cover has too few Gaussians to hide anything in colours that would survive other formats"
_LOWER = 3  # maximum number of levels, each a quarter of a bit, below the planned one
_BITS_PER_GAUSSIAN = 1  # approximate capacity
_HEADERS = 100  # approximate bytes
_OVERHEAD = METHOD_BYTES + 1  # maximum bytes of a payload beside its data


@dataclass(frozen=True)
class Colours(Channel):
    """The channel; see `keyss.channels.base.Channel`. Raises UsageError for a `strength` of 0 dB or less."""

    strength: float = 45.0  # minimum PSNR in dB between views of the stego model and of the cover

    name = "colours"
    place = "colours"
    survives = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.strength) and self.strength > 0):
            raise UsageError(f"expected a `strength` above 0 dB, got {self.strength}")

    def prepare(self, cover: Gaussians) -> ColoursCover:
        return ColoursCover(Planner(cover, Carriers.of(cover), self.strength))

    def estimate_capacity(self, gaussians: int, sh_degree: int) -> Capacity:
        capacity = gaussians * _BITS_PER_GAUSSIAN // 8 - _HEADERS
        return Capacity(gaussians, max(0, capacity), _OVERHEAD)


COLOURS = Colours()


@dataclass(frozen=True)
class ColoursCover:
    """A cover with known capacity; see `keyss.channels.base.PreparedCover`.

    Writing changes some greens and blues and nothing else. A payload changes as little as it needs;
    `strength` is the limit.
    """

    planner: Planner

    @property
    def cover(self) -> Gaussians:
        return self.planner.model

    @cached_property
    def capacity(self) -> Capacity:
        return Capacity(len(self.planner.carriers.representatives), self.planner.bytes, _OVERHEAD)

    def embed(self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`. Also raises UsageError for a model that can carry nothing."""
        payloads = [pack_payload(content) for _, content in contents]
        secret = randomness(entropy, *payloads)
        random = np.random.default_rng(np.frombuffer(stream(secret, "colours/random", 32), np.uint32))
        carriers = renew_salts(self.planner.carriers, random)
        salts = Salts.of(carriers)
        if len(salts.salts) < SALTS:
            raise UsageError(_TOO_FEW)
        secrets = [Secrets.of(key, salts.salts) for key, _ in contents]
        check_keys([each.static for each in secrets])
        sizes = [compressed_size(payload) + OVERHEAD for payload in payloads]
        layouts = self._layouts(sizes)
        # Headers without a secret hide the number of secrets. Above level ONE, others are noticed anyway.
        for index in range(len(secrets), MIN_HEADERS if layouts[0].level == ONE else 0):
            labels = [f"colours/nobody/{index}/{each}" for each in range(SALTS + 1)]
            static, *salted = (expand(secret, label, MASTER_BYTES) for label in labels)
            secrets.append(Secrets(static, tuple(salted)))
        free = np.zeros(len(carriers), bool)
        free[carriers.representatives] = True
        free[salts.rows] = False
        draft = _Draft(self.planner, carriers, free & ~self.planner.excluded)
        file_key = expand(secret, "colours/file-key", FILE_KEY_BYTES)
        for lower in range(_LOWER + 1):  # the plan does not include the cost of headers and salts
            headers = _headers(layouts, sizes, file_key, carriers, lower)
            stego = draft.write(secrets, headers, [each.likely for each in layouts], payloads, random)
            if layouts[0].level == ONE or psnr_between(self.cover, stego) >= self.planner.strength:
                break
        return stego

    def _layouts(self, sizes: Sequence[int]) -> list[Layout]:
        """The layout of each payload."""
        found = self.planner.layouts(sizes)
        if found is None:
            raise UsageError(
                f"the colours of this cover hold {self.planner.bytes:,} bytes in all, and the secrets "
                f"take {sum(sizes) - OVERHEAD * len(sizes):,}"
            )
        if found[1]:
            warnings.warn(NOT_INDEPENDENT, KeyssWarning, stacklevel=4)
        return found[0]


def _headers(
    layouts: Sequence[Layout], sizes: Sequence[int], file_key: bytes, carriers: Carriers, lower: int
) -> list[Header]:
    """The header of each payload, with `idle` still to be set."""
    headers, first = [], 0
    for layout, size in zip(layouts, sizes, strict=True):
        last = min(first + max(1, math.ceil(SHARES * layout.share)), SHARES) - 1
        level = layout.level and max(1, layout.level - lower)
        middle = round(median(carriers)) % 256
        headers.append(Header(file_key, level, first, last, bucket_of(size), 0, middle))
        first = min(last + 1, SHARES - 1)
    return headers


@dataclass(frozen=True, eq=False)
class _Draft:
    """A cover to be written."""

    planner: Planner
    carriers: Carriers  # with new salts
    free: Flags  # [C] mask of carriers that may be written

    def write(
        self,
        secrets: Sequence[Secrets],
        headers: Sequence[Header],
        likely: Sequence[bool],
        payloads: Sequence[bytes],
        random: np.random.Generator,
    ) -> Gaussians:
        """The model with headers for all `secrets`, and the payloads of the first ones.

        Only likely values are written for `likely` payloads, and for their headers if these may skip values.
        """
        carriers, free = self.carriers, self.free.copy()
        values, chosen = carriers.colours[:, 1:].copy(), np.zeros(len(carriers), bool)
        holds = free.copy()
        for each in secrets:
            for secret in each.salted:
                holds[places(secret, carriers)[0]] = False
        final = []
        for header, some in zip(headers, likely, strict=True):
            mask = header.carrier_mask(carriers)
            share = float(holds[mask].mean()) if mask.any() else 0.0
            idle = 1 - share * (self.planner.acceptance if some else 1.0)
            final.append(replace(header, idle=round(idle / IDLE)))
        for salt in range(SALTS):  # alternate between secrets, because later headers find fewer free places
            for index, each in enumerate(secrets):
                like = min(index, len(final) - 1)  # headers without a secret resemble the last one
                rows, new = final[like].write(each, salt, carriers)
                rows, new = rows[free[rows]], new[free[rows]]
                values[rows], free[rows] = new, False
                chosen[rows] = likely[like] and self.planner.headers_may_skip
        for each, header, some, payload in zip(secrets, final, likely, payloads, strict=False):
            rows, key = np.flatnonzero(free & header.carrier_mask(carriers)), each.data_key(header)
            encrypted = encrypt(key, payload, ASSOCIATED, size=bucket_bytes(header.bucket))
            ids, bits = carriers.ids[rows], bit_counts(carriers.impact[rows], header.level)
            data = np.unpackbits(np.frombuffer(encrypted, np.uint8))
            code = Fountain(len(data)).encode(data, seeds(key, "seeds", ids, bits))
            values[rows], chosen[rows] = write(key, ids, values[rows], bits, code), some
        return self._replace_colours(values, chosen, random)

    def _replace_colours(self, values: Doubles, chosen: Flags, random: np.random.Generator) -> Gaussians:
        """The model with greens and blues `values` [C, 2].

        `chosen` [C]: mask of the carriers that change only if the new colour is likely enough.
        """
        capacity, old = self.planner, self.planner.carriers.colours
        new = np.hstack([old[:, :1], capacity.statistics.imitate(values)])
        if chosen.any():
            base = np.where(chosen[:, None], old, new)
            new[:, 1:] = np.where(capacity.likelihood.accept(base, new, random), new[:, 1:], base[:, 1:])
        sh = capacity.model.sh.detach().clone()
        rows = torch.from_numpy(self.carriers.rows).to(sh.device)
        sh[rows, 0, 1:] = torch.from_numpy(new[:, 1:]).to(sh)
        return replace(capacity.model.detach(), sh=sh)
