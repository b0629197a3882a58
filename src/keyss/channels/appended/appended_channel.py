"""Secrets in appended Gaussians, too faint and too small to see.

They survive every publication format, and moving, rotating and scaling of the whole model. Everybody can see
that they are there; only the key reads them. A payload is encrypted as a whole (ChaCha20-Poly1305, with a key
from Argon2id and the file's salt) and cut into packets, one per Gaussian. Reed-Solomon adds parity: any 5895
packets of a codeword of at most 8192 suffice. A header holds the number of data packets. Random words pad the
total to one of few numbers, which reveal little of the size and the number of secrets.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from keyss.channels.appended import cover as cover_filters, pilots
from keyss.channels.appended.words import (
    HEADERS,
    WORD_BITS,
    all_shifts,
    candidate_mask,
    check_place,
    colours_of,
    invariants_of,
    likely_shifts,
    own_frame,
    pack_words,
    points_in_frame,
    read_header,
    read_packets,
    scale_steps,
    scales_at,
    sort_by_rotation,
    to_gaussians,
    write_header,
    write_packets,
)
from keyss.channels.base import (
    METHOD_BYTES,
    Capacity,
    Channel,
    Payload,
    SaltedReader,
    check_keys,
    pack_payload,
    randomness,
    unpack_payload,
)
from keyss.channels.mixing import random_order
from keyss.channels.reed_solomon import Codewords
from keyss.core.arrays import Bits, Doubles, Integers
from keyss.core.errors import KeyssWarning, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import SALT_BYTES, DerivedKey, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

# Expected share of intact packets after the loss of a quarter, and the margin in standard deviations. Longer
# codewords need fewer packets and more time; 5895 data packets make a codeword of 8192.
_LEFT, _DEVIATIONS, _MAX_DATA = 0.74, 4.2, 5895
# Data bytes per packet. Narrow packets have longer tags, which fewer words of other secrets match by chance.
_WIDE, _NARROW, _WIDE_PACKETS = 8, 6, 90_000
_MAX_PACKETS = 1_000_000  # data packets; a header holds up to 2^20
_STEP = 256  # smallest difference between numbers of appended Gaussians
_OVERHEAD = OVERHEAD + METHOD_BYTES + 1 + cover_filters.BYTES

# Search for the lattice's offset: Gaussians in which pilots are counted, maximum number of offsets, and
# standard deviations by which pilots must outnumber accidental ones.
_SAMPLE, _MAX_OFFSETS, _SIGNIFICANT = 8000, 8, 3.0
_ASSOCIATED = b"keyss/v1/appended/data"
# Least share of foreign Gaussians that causes a warning. Conversions make none foreign; of another model,
# 0.95 and more are.
_FOREIGN = 0.05
MAX_BYTES = _MAX_PACKETS * _NARROW - OVERHEAD - METHOD_BYTES - cover_filters.BYTES
_VISIBLE_SECRETS = (
    "the number of appended Gaussians reveals the total size: the holder of one key can tell that there are "
    "other secrets"
)


class Appended(Channel):
    """The channel; see `keyss.channels.base.Channel`."""

    place = "appended Gaussians"
    survives = True
    grows = True

    def prepare(self, cover: Gaussians) -> AppendedCover:
        """See `Channel`. Raises UsageError for a cover too far from the origin for float32."""
        check_place(own_frame(cover))
        return AppendedCover(cover)

    def estimate_capacity(self, gaussians: int, sh_degree: int) -> Capacity:
        return Capacity(MAX_BYTES, _OVERHEAD, grows=True)

    def appended_count(self, sizes: Sequence[int]) -> int:
        """The number of Gaussians appended for payloads of these compressed sizes in bytes."""
        single = len(sizes) == 1
        every = [_codewords_for(size + cover_filters.BYTES, single) for size in sizes]
        return _padded_count(sum(HEADERS + each.shards for each in every))


APPENDED = Appended()


@dataclass(frozen=True)
class AppendedCover:
    """Any cover; see `keyss.channels.base.PreparedCover`."""

    cover: Gaussians

    @property
    def capacity(self) -> Capacity:
        return APPENDED.estimate_capacity(len(self.cover), self.cover.sh_degree)

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """The cover followed by the appended Gaussians. Warns if there is more than one secret."""
        model = self.cover.detach().to("cpu")
        to_world = own_frame(model)
        packed = [pack_payload(payload) for _, payload in payloads]
        secret = randomness(entropy, *packed)
        salt = expand(secret, "appended/salt", SALT_BYTES)
        random = np.random.default_rng(np.frombuffer(stream(secret, "appended/random", 32), np.uint32))
        keys = [DerivedKey.of(key, salt) for key, _ in payloads]
        check_keys([key.verifier() for key in keys])
        if len(keys) > 1:
            warnings.warn(_VISIBLE_SECRETS, KeyssWarning, stacklevel=2)
        total = APPENDED.appended_count([compressed_size(each) for each in packed])
        words = [pilots.write(salt, pilots.count_for(total), random)]
        for key, each in zip(keys, packed, strict=True):
            own = cover_filters.pack(model, total, to_world.inverse(), _filter_key(key))
            words.append(_words(key, own, each, len(keys) == 1))
        words.append(_random_words(secret, total - sum(map(len, words))))
        # In random order, because sorting keeps the order of equal rotations.
        every = np.concatenate(words)[random_order(secret, "appended/order", total)]
        return Gaussians.cat([model, to_gaussians(sort_by_rotation(every), to_world, model.sh_degree)])


@dataclass(frozen=True)
class AppendedReader(SaltedReader):
    """Reads the appended Gaussians of a model."""

    salts: Sequence[bytes]
    words: Bits
    model: Gaussians
    to_own: Similarity  # world to own frame

    @staticmethod
    def of(model: Gaussians) -> AppendedReader | None:
        """None if there are none, or if their frame cannot be found."""
        candidates = candidate_mask(model)
        if candidates.sum() < pilots.MIN // 4:
            return None
        faint = model.detach().to("cpu")[torch.from_numpy(candidates)]
        colours, steps = colours_of(faint), scale_steps(faint)
        few = np.random.default_rng(0).permutation(len(faint))[:_SAMPLE]
        for shifts in (likely_shifts(steps), _shifts_with_pilots(steps[few], colours[few])):
            best: tuple[pilots.PilotFit, Integers] | None = None
            for shift in shifts:
                scales = scales_at(steps, shift)
                found = pilots.read(invariants_of(colours, scales), faint.means.double().numpy())
                if found and (best is None or found.inliers > best[0].inliers):
                    best = found, scales
            if best is not None:
                found, scales = best
                words = pack_words(colours, scales, *points_in_frame(faint, found.to_own))
                return AppendedReader([found.salt], words, model.detach().to("cpu"), found.to_own)
        return None

    def extract(self, key: DerivedKey) -> Payload:
        """See `SaltedReader`."""
        for width in (_WIDE, _NARROW):
            header = read_header(key.expand(f"appended/header/{width}", 32), self.words, width)
            if header:
                numbers, data = read_packets(key.expand("appended/packets", 32), self.words, width)
                whole = _codewords(header, width).decode(numbers.astype(np.int64), data, errors=True)
                own = _masked(key, whole[: cover_filters.BYTES])
                encrypted = whole[cover_filters.BYTES :]
                packed = decrypt(key.expand("appended/data", 32), encrypted, _ASSOCIATED + own)
                foreign = cover_filters.foreign_count(
                    own, self.model, self.to_own, _filter_key(key), _FOREIGN
                )
                return replace(unpack_payload(packed), foreign=foreign)
        raise WrongKeyError()


def _filter_key(key: DerivedKey) -> bytes:
    return key.expand("appended/host", 32)


def _bucket(size: int) -> int:
    """`size` rounded up to a multiple of an eighth of the power of two above it, or of _STEP."""
    step = max(_STEP, 1 << max(0, (size - 1).bit_length() - 3))
    return -(-size // step) * step


def _padded_count(used: int) -> int:
    """The number of Gaussians to append if `used` carry data: one of few numbers, which reveal little."""
    total = _bucket(used)
    while total - pilots.count_for(total) < used:
        total = _bucket(total + 1)
    return total


def _codewords_for(size: int, single: bool) -> Codewords:
    """The codewords for a compressed payload of `size` bytes. Raises UsageError if it does not fit."""
    for width, most in ((_WIDE, _WIDE_PACKETS * single), (_NARROW, _MAX_PACKETS)):
        needed = -(-(size + OVERHEAD) // width)
        if needed <= most:
            return _codewords(needed, width)
    raise UsageError(f"the secret takes {size:,} bytes, and {MAX_BYTES:,} can be appended")


def _codewords(needed: int, width: int) -> Codewords:
    """The shortest codewords for `needed` data packets that survive the loss of a quarter."""
    count = -(-needed // _MAX_DATA)
    length = data = -(-needed // count)
    while length * _LEFT - _DEVIATIONS * math.sqrt(length * _LEFT * (1 - _LEFT)) < data:
        length += 1
    return Codewords(count, length, data, width)


def _shifts_with_pilots(steps: Doubles, colours: Integers) -> Iterator[float]:
    """Offsets of the lattice of log scales with significantly many pilots, most first."""
    shifts = all_shifts(steps)
    counts = np.array([pilots.count(invariants_of(colours, scales_at(steps, each))) for each in shifts])
    expected = len(steps) / pilots.ONE_IN
    for index in np.argsort(counts)[::-1][:_MAX_OFFSETS]:
        if counts[index] > expected + _SIGNIFICANT * math.sqrt(expected):
            yield float(shifts[index])


def _words(key: DerivedKey, own: bytes, packed: bytes, single: bool) -> Bits:
    """Words [N, WORD_BITS] of the headers and packets of a payload; `single`: there is only one secret.

    `own`: the cover's Bloom filter, which is masked and authenticated with the payload.
    """
    codewords = _codewords_for(compressed_size(packed) + len(own), single)
    width, needed = codewords.width, codewords.count * codewords.k
    size = codewords.size - len(own)
    encrypted = encrypt(key.expand("appended/data", 32), packed, _ASSOCIATED + own, size=size)
    data = _masked(key, own) + encrypted
    numbers = np.arange(codewords.shards, dtype=np.uint64)
    noise = np.frombuffer(key.expand("appended/header-noise", HEADERS * width), np.uint8).reshape(
        HEADERS, width
    )
    return np.concatenate(
        [
            write_header(key.expand(f"appended/header/{width}", 32), needed, noise),
            write_packets(key.expand("appended/packets", 32), numbers, codewords.encode(data)),
        ]
    )


def _masked(key: DerivedKey, own: bytes) -> bytes:
    """The cover's Bloom filter, encrypted or decrypted."""
    mask = np.frombuffer(stream(key.master, "appended/cover", len(own)), np.uint8)
    return (np.frombuffer(own, np.uint8) ^ mask).tobytes()


def _random_words(secret: bytes, count: int) -> Bits:
    """Words [count, WORD_BITS] as random as encrypted ones."""
    noise = np.frombuffer(stream(secret, "appended/padding", count * WORD_BITS), np.uint8)
    bits: Bits = (noise & np.uint8(1)).reshape(count, WORD_BITS)
    return bits
