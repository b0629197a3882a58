"""Secrets in appended Gaussians, too faint and too small to see.

They survive every publication format, and moving, rotating and scaling of the whole model. Everybody can see
that they are there; only the key reads them. A slot is a *word* without identity or order, so a shard makes a
*packet* that holds its number. Any 5895 packets of a codeword of at most 8192 suffice. A header holds the
number of data packets. Random words pad the total to one of few numbers, which reveal little of the size and
the number of secrets.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from keyss.channels import container
from keyss.channels.appended import pilots, words
from keyss.channels.base import Capacity, Channel
from keyss.channels.container import Payload, SaltedReader
from keyss.channels.foreign import COARSE_BYTES, coarse_foreign, coarse_record
from keyss.channels.mixing import random_order
from keyss.channels.reed_solomon import Codewords
from keyss.core.arrays import Bits, Doubles, Integers, doubles
from keyss.core.errors import UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity
from keyss.keys.derivation import SALT_BYTES, DerivedKey, expand, stream

# Expected share of intact packets after the loss of a quarter, and the margin in standard deviations. Longer
# codewords need fewer packets and more time; 5895 data packets make a codeword of 8192.
_LEFT, _DEVIATIONS, _MAX_DATA = 0.74, 4.2, 5895
# Data bytes per packet. Narrow packets have longer tags, which fewer words of other secrets match by chance.
_WIDE, _NARROW, _WIDE_PACKETS = 8, 6, 90_000
_MAX_PACKETS = 1_000_000  # data packets; a header holds up to 2^20
_STEP = 256  # smallest difference between numbers of appended Gaussians
_OVERHEAD = container.MAX_OVERHEAD + COARSE_BYTES

# Search for the lattice's offset: Gaussians in which pilots are counted, maximum number of offsets, and
# standard deviations by which pilots must outnumber accidental ones.
_SAMPLE, _MAX_OFFSETS, _SIGNIFICANT = 8000, 8, 3.0
MAX_BYTES = _MAX_PACKETS * _NARROW  # maximum size of a sealed payload
_VISIBLE_SECRETS = (
    "the number of appended Gaussians reveals the total size: the holder of one key can tell that there are "
    "other secrets"
)


@dataclass(frozen=True)
class AppendedCover:
    """Any cover; see `keyss.channels.base.PreparedCover`."""

    cover: Gaussians

    @staticmethod
    def of(cover: Gaussians) -> AppendedCover:
        """Raises UsageError for a cover too far from the origin for float32."""
        words.check_place(words.own_frame(cover))
        return AppendedCover(cover)

    @property
    def capacity(self) -> Capacity:
        return _capacity(len(self.cover), self.cover.sh_degree)

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """The cover followed by the appended Gaussians. Warns if there is more than one secret."""
        model = self.cover.detach().to("cpu")
        to_world = words.own_frame(model)
        secret = container.randomness(entropy, [payload for _, payload in payloads])
        salt = expand(secret, "appended/salt", SALT_BYTES)
        random = np.random.default_rng(np.frombuffer(stream(secret, "appended/random", 32), np.uint32))
        keys = [container.key_secret(DerivedKey.of(key, salt)) for key, _ in payloads]
        container.check_keys(keys)
        if len(keys) > 1:
            container.warn_of_others(_VISIBLE_SECRETS)
        sizes = [container.sealed_size(payload, COARSE_BYTES) for _, payload in payloads]
        every = [_codewords_for(size, len(sizes)) for size in sizes]
        total = _padded_count(every)
        parts = [pilots.write(salt, pilots.count_for(total), random)]
        for data_key, (_, payload), codewords in zip(keys, payloads, every, strict=True):
            record = coarse_record(data_key, model, total, to_world.inverse())
            sealed = container.seal(data_key, payload, codewords.size, record)
            parts.append(_words(data_key, codewords, sealed))
        missing = total - sum(map(len, parts))
        noise = np.frombuffer(stream(secret, "appended/padding", missing * words.WORD_BITS), np.uint8)
        parts.append((noise & np.uint8(1)).reshape(missing, words.WORD_BITS))
        # In random order, because sorting keeps the order of equal rotations.
        ordered = np.concatenate(parts)[random_order(secret, "appended/order", total)]
        added = words.to_gaussians(words.sort_by_rotation(ordered), to_world, model.sh_degree)
        return Gaussians.cat([model, added])


def _capacity(gaussians: int, sh_degree: int) -> Capacity:
    """The same for all covers."""
    return Capacity.of_sealed(_OVERHEAD, [(1.0, MAX_BYTES)], lambda count: MAX_BYTES // count, grows=True)


APPENDED = Channel("appended Gaussians", AppendedCover.of, _capacity, survives=True)


def appended_count(sizes: Sequence[int]) -> int:
    """The number of Gaussians appended for payloads of these bytes of compressed data, at most."""
    return _padded_count([_codewords_for(size + _OVERHEAD, len(sizes)) for size in sizes])


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
        candidates = words.candidate_mask(model)
        if candidates.sum() < pilots.MIN // 4:
            return None
        faint = model.detach().to("cpu")[torch.from_numpy(candidates)]
        colours, steps = words.colours_of(faint), doubles(faint.log_scales) / words.SCALE_STEP
        few = np.random.default_rng(0).permutation(len(faint))[:_SAMPLE]
        for shifts in (words.likely_shifts(steps), _shifts_with_pilots(steps[few], colours[few])):
            best: tuple[pilots.PilotFit, Integers] | None = None
            for shift in shifts:
                scales = words.scales_at(steps, shift)
                pilot_frame = pilots.read(words.invariants_of(colours, scales), faint.means.double().numpy())
                if pilot_frame and (best is None or pilot_frame.inliers > best[0].inliers):
                    best = pilot_frame, scales
            if best is not None:
                pilot_frame, scales = best
                to_own, salts = pilot_frame.to_own, [pilot_frame.salt]
                packed = words.pack_words(colours, scales, *words.points_in_frame(faint, to_own))
                return AppendedReader(salts, packed, model.detach().to("cpu"), to_own)
        return None

    def extract(self, key: DerivedKey) -> Payload:
        """See `SaltedReader`."""
        data_key = container.key_secret(key)
        for width in (_WIDE, _NARROW):
            needed = words.read_header(expand(data_key, f"header/{width}", 32), self.words, width)
            if needed:
                numbers, data = words.read_packets(expand(data_key, "packets", 32), self.words, width)
                codewords = _codewords(needed, width)
                shards = numbers.astype(np.int64), data
                record, payload = container.unseal_shards(data_key, codewords, *shards, COARSE_BYTES)
                foreign = coarse_foreign(record, data_key, self.model, self.to_own)
                return replace(payload, foreign=foreign)
        raise WrongKeyError()


def _bucket(size: int) -> int:
    """`size` rounded up to a multiple of an eighth of the power of two above it, or of _STEP."""
    step = max(_STEP, 1 << max(0, (size - 1).bit_length() - 3))
    return -(-size // step) * step


def _padded_count(every: Sequence[Codewords]) -> int:
    """The number of Gaussians to append for payloads in these codewords: one of few, which reveal little."""
    used = sum(words.HEADERS + layout.shards for layout in every)
    total = _bucket(used)
    while total - pilots.count_for(total) < used:
        total = _bucket(total + 1)
    return total


def _codewords_for(size: int, secrets: int) -> Codewords:
    """The codewords for a sealed payload of `size` bytes. Raises UsageError if it does not fit."""
    for width, most in ((_WIDE, _WIDE_PACKETS if secrets == 1 else 0), (_NARROW, _MAX_PACKETS)):
        needed = -(-size // width)
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
    shifts = words.all_shifts(steps)
    found = (pilots.find(words.invariants_of(colours, words.scales_at(steps, shift))) for shift in shifts)
    counts = np.array([*map(len, found)])
    expected = len(steps) / pilots.ONE_IN
    for index in np.argsort(counts)[::-1][:_MAX_OFFSETS]:
        if counts[index] > expected + _SIGNIFICANT * math.sqrt(expected):
            yield float(shifts[index])


def _words(data_key: bytes, codewords: Codewords, sealed: bytes) -> Bits:
    """Words [N, WORD_BITS] of the headers, with noise as data, and packets of a sealed payload."""
    width, needed = codewords.width, np.full(words.HEADERS, codewords.count * codewords.k, np.uint64)
    noise = np.frombuffer(stream(data_key, "header-noise", words.HEADERS * width), np.uint8)
    header_key, key = expand(data_key, f"header/{width}", 32), expand(data_key, "packets", 32)
    headers = words.write_packets(header_key, needed, noise.reshape(words.HEADERS, width))
    numbers = np.arange(codewords.shards, dtype=np.uint64)
    return np.concatenate([headers, words.write_packets(key, numbers, codewords.encode(sealed))])
