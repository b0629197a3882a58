"""Payloads in colours, which survive rounding formats and changes of order and frame.

A payload is encrypted and authenticated (ChaCha20-Poly1305), encoded (`fountain`) and written into the
colours (`qim`) of Gaussians identified by their other numbers (`carriers`). A *header* under a few *salts*
holds the parameters for reading. Nothing in the model reveals how many secrets there are, or that there is
one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from keyss.channels import container
from keyss.channels.base import Capacity, Channel
from keyss.channels.colours.carriers import SALTS, Carriers, find_salts
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
from keyss.channels.colours.qim import COLUMNS, ONE, bit_counts, read, seeds, write
from keyss.channels.container import Payload
from keyss.channels.reed_solomon import LOST
from keyss.core.arrays import Doubles, Flags
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import MASTER_BYTES, expand, stream
from keyss.keys.encryption import OVERHEAD

_TOO_FEW = "this cover has too few Gaussians to hide anything in colours that would survive other formats"
_LOWER = 3  # maximum number of levels, each a quarter of a bit, below the planned one
_BITS_PER_GAUSSIAN = 1  # approximate capacity
_HEADERS = 100  # approximate bytes
_FURTHER = 0.8  # approximate share of the capacity that another secret leaves
_OVERHEAD = container.METHOD_BYTES + 1  # maximum bytes of a payload beside its data
_CHANGED = 0.03  # share of carriers overwritten since
_MAX_RATE = 4.0  # data bits per code bit; a writer stays below 0.5
_ALIGNMENTS = 4  # offsets of log scales; the best one is wrong by at most 1/8 step in a scaled model
_FOREIGN, _DEVIATIONS = 0.25, 4.0  # least share of foreign carriers to warn of; rounding reaches 0.17
_NOTHING = Header(bytes(5), ONE, 0, 63, 64, 0, 0)  # read for wrong keys, so that all keys take equally long


@dataclass(frozen=True)
class ColoursCover:
    """A cover with known capacity; see `keyss.channels.base.PreparedCover`.

    Writing changes some greens and blues and nothing else. A payload changes as little as it needs.
    """

    planner: Planner

    @staticmethod
    def of(cover: Gaussians) -> ColoursCover:
        return ColoursCover(Planner(cover, Carriers.of(cover)))

    @property
    def cover(self) -> Gaussians:
        return self.planner.model

    @cached_property
    def capacity(self) -> Capacity:
        return _capacity(self.planner.bytes, self.planner.share_with_another)

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`. Also raises UsageError for a model that can carry nothing."""
        contents = [payload for _, payload in payloads]
        secret = container.randomness(entropy, contents)
        random = np.random.default_rng(np.frombuffer(stream(secret, "colours/random", 32), np.uint32))
        carriers = self.planner.carriers
        salt_rows, salts = find_salts(carriers)
        if len(salts) < SALTS:
            raise UsageError(_TOO_FEW)
        secrets = [Secrets.of(key, salts) for key, _ in payloads]
        container.check_keys([secret.static for secret in secrets])
        sizes = list(map(container.sealed_size, contents))
        plan = self.planner.layouts(sizes)
        if plan is None:
            raise UsageError(
                f"the colours of this cover hold {self.planner.bytes:,} bytes of one secret, and less of "
                f"several; the given secrets take {sum(sizes) - OVERHEAD * len(sizes):,}"
            )
        layouts, reveals_others = plan
        if reveals_others:
            container.warn_of_others()
        # Headers without a secret hide the number of secrets. Above level ONE, others are noticed anyway.
        for index in range(len(secrets), MIN_HEADERS if layouts[0].level == ONE else 0):
            labels = [f"colours/nobody/{index}/{salt}" for salt in range(SALTS + 1)]
            static, *salted = (expand(secret, label, MASTER_BYTES) for label in labels)
            secrets.append(Secrets(static, tuple(salted)))
        free = np.zeros(len(carriers), bool)
        free[self.planner.writable] = True
        free[salt_rows] = False
        file_key = expand(secret, "colours/file-key", FILE_KEY_BYTES)
        headers = self._headers(layouts, sizes, file_key, _without_places(free, secrets, carriers))
        for lower in range(_LOWER + 1):  # the plan does not include the cost of headers and salts
            lowered = [
                replace(header, level=header.level and max(1, header.level - lower)) for header in headers
            ]
            stego = self._write(secrets, lowered, layouts, contents, free, random)
            if layouts[0].level == ONE or not self.planner.is_visible(stego):
                break
        return stego

    def _headers(
        self, layouts: Sequence[Layout], sizes: Sequence[int], file_key: bytes, holds: Flags
    ) -> list[Header]:
        """The header of each payload; `holds` [C]: mask of the carriers that may hold payloads."""
        carriers = self.planner.carriers
        headers, first, middle = [], 0, round(median(carriers)) % 256
        for layout, size in zip(layouts, sizes, strict=True):
            last = min(first + max(1, math.ceil(SHARES * layout.share)), SHARES) - 1
            header = Header(file_key, layout.level, first, last, bucket_of(size), 0, middle)
            mask = header.carrier_mask(carriers)
            share = float(holds[mask].mean()) if mask.any() else 0.0
            idle = 1 - share * (self.planner.acceptance if layout.likely else 1.0)
            headers.append(replace(header, idle=round(idle / IDLE)))
            first = min(last + 1, SHARES - 1)
        return headers

    def _write(
        self,
        secrets: Sequence[Secrets],
        headers: Sequence[Header],
        layouts: Sequence[Layout],
        payloads: Sequence[Payload],
        free: Flags,
        random: np.random.Generator,
    ) -> Gaussians:
        """The model with headers for all `secrets`, and the payloads of the first ones.

        `free` [C]: mask of carriers that may be written. Only likely values are written for payloads whose
        layout says so, and for their headers if these may skip values.
        """
        carriers = self.planner.carriers
        free, values, chosen = free.copy(), carriers.colours[:, 1:].copy(), np.zeros(len(carriers), bool)
        for salt in range(SALTS):  # alternate between secrets, because later headers find fewer free places
            for index, secret in enumerate(secrets):
                like = min(index, len(headers) - 1)  # headers without a secret resemble the last one
                rows, new = headers[like].write(secret, salt, carriers)
                rows, new = rows[free[rows]], new[free[rows]]
                values[rows], free[rows] = new, False
                chosen[rows] = layouts[like].likely and self.planner.headers_may_skip
        for secret, header, layout, payload in zip(secrets, headers, layouts, payloads, strict=False):
            rows, key = np.flatnonzero(free & header.carrier_mask(carriers)), secret.data_key(header)
            sealed = container.seal(key, payload, bucket_bytes(header.bucket))
            ids, bits = carriers.ids[rows], bit_counts(carriers.impact[rows], header.level)
            data = np.unpackbits(np.frombuffer(sealed, np.uint8))
            code = Fountain(len(data)).encode(data, seeds(key, "seeds", ids, bits))
            values[rows], chosen[rows] = write(key, ids, values[rows], bits, code), layout.likely
        new = self.planner.statistics.imitate(values)
        if chosen.any():
            base = np.where(chosen[:, None], carriers.colours, new)
            accepted = self.planner.likelihood.accept(base, new, random)
            new[:, 1:] = np.where(accepted, new[:, 1:], base[:, 1:])
        sh = self.cover.sh.detach().clone()
        sh[torch.from_numpy(carriers.rows).to(sh.device), 0, 1:] = torch.from_numpy(new[:, 1:]).to(sh)
        return replace(self.cover.detach(), sh=sh)


def _estimated_capacity(gaussians: int, sh_degree: int) -> Capacity:
    return _capacity(gaussians * _BITS_PER_GAUSSIAN // 8 - _HEADERS, _FURTHER)


COLOURS = Channel("colours", ColoursCover.of, _estimated_capacity, survives=True)


@dataclass(frozen=True)
class ColoursReader:
    """Reads the colours of a model."""

    alignments: tuple[Carriers, ...]

    @staticmethod
    def of(model: Gaussians) -> ColoursReader:
        return ColoursReader(
            tuple(Carriers.of(model, alignment / _ALIGNMENTS) for alignment in range(_ALIGNMENTS))
        )

    def open(self, key: str) -> Payload:
        """See `SaltedReader`.

        Takes about 0.1 s for each of 17 salts, for right and wrong keys alike.
        """
        secrets = Secrets.of(key, find_salts(self.alignments[0])[1])
        headers = [Header.read(secrets, carriers) for carriers in self.alignments]
        for carriers, header in zip(self.alignments, headers, strict=True):
            if header is None:
                continue
            for shift in (0.0,) if header.level == ONE else (0.0, header.shift(carriers)):
                payload = _payload(header, secrets, carriers, shift)
                if payload is not None:
                    return container.warned(payload)
        if any(headers):
            raise InputError(LOST)
        _payload(_NOTHING, secrets, self.alignments[0], 0.0)
        raise WrongKeyError()


def _capacity(size: int, further: float) -> Capacity:
    """`size`: of a packed payload; `further`: factor on the total for each further payload."""
    shares = [(1.0, size)]
    return Capacity.of_sealed(_OVERHEAD, shares, lambda count: int(size * further ** (count - 1)) // count)


def _payload(header: Header, secrets: Secrets, carriers: Carriers, shift: float) -> Payload | None:
    """The payload decrypted by the header's data key, or None."""
    rows = np.flatnonzero(_without_places(header.carrier_mask(carriers), [secrets], carriers))
    size, key, ids = bucket_bytes(header.bucket), secrets.data_key(header), carriers.ids[rows]
    bits = bit_counts(carriers.impact[rows] - shift, header.level)
    if not len(rows) or 8 * size > _MAX_RATE * COLUMNS * bits.sum():
        return None
    sure = (1 - header.idle * IDLE) * (1 - _CHANGED) * carriers.certainty[rows]
    values, words = read(key, ids, carriers.colours[rows, 1:], bits), seeds(key, "seeds", ids, bits)
    decoded = Fountain(8 * size).decode(words, np.repeat(sure, COLUMNS * bits) * values)
    try:
        payload = container.unseal(key, np.packbits(decoded).tobytes())[1]
    except InputError:
        return None
    agreement = values * (1 - 2.0 * Fountain(8 * size).encode(decoded, words))
    held = np.repeat((1 - header.idle * IDLE) * carriers.stability[rows], COLUMNS * bits)
    weights = np.repeat(carriers.weights[rows], COLUMNS * bits)
    share = _foreign_share(agreement, held, weights)
    return replace(payload, foreign=round(share * len(carriers)) if share > _FOREIGN else 0)


def _foreign_share(agreement: Doubles, held: Doubles, weights: Doubles) -> float:
    """The share, by `weights` [B], of foreign carriers that is certain: less by _DEVIATIONS standard errors.

    `agreement` [B], -1 to 1, of values with the bits that were written. Its mean is 0 for foreign carriers;
    for others, it is the share `held` [B] of the maximum.
    """
    sizes = np.abs(agreement)
    expected = float((weights * held * sizes).sum())
    error = math.sqrt(float((np.square(weights * sizes) * (1 - held**2)).sum()))
    return max(0.0, 1 - float((weights * agreement).sum() + _DEVIATIONS * error) / max(1e-9, expected))


def _without_places(mask: Flags, secrets: Sequence[Secrets], carriers: Carriers) -> Flags:
    """`mask` [C] without the places of these secrets' headers."""
    left = mask.copy()
    for keyed in secrets:
        for secret in keyed.salted:
            left[places(secret, carriers)[0]] = False
    return left
