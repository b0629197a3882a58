"""A secret of the design `carriers`: row by row in the harmonics of a model, under the key's embedding.

Of a harmonic above the constant one, sign, exponent and the two leading bits of the mantissa are the cover's.
The next 8 bits, a *carrier*, encode 7 bits of the secret. The 13 below belong to the low bits, which hold the
payload. The carriers of a row are a cell (`keyss.channels.low_bits.cells`) under a key that follows from the
embedding alone; its tag tells whether the embedding opens it. So rows may be pruned or reordered, the
embedding of another key opens none and shows the cover, and the payload without the embedding shows nothing.

A carrier b stands for min(b, 255 - b). Which of the two is written preserves the statistics of trained
harmonics: they become rarer with size, also within a quarter of an octave, and those of the three channels
are alike. Mostly the carrier stays in the same half of its quarter; otherwise means of the cover's harmonics
decide (see `_halves`).

Harmonics that are exactly zero, such as those of a saturated colour, stay zero. A row with few of them has
room for a Gaussian with all harmonics, a row with more for one without, and the others are left alone.
docs/format.md lists the bytes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import numpy.typing as npt
import torch
from msgspec import Meta
from torch import Tensor

from keyss.channels import Content, Payload, identities, is_appended
from keyss.channels.low_bits.cells import TAG_BYTES, CellCipher
from keyss.core.arrays import Bytes, Doubles, Integers, Words32
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians, compensate_pruning
from keyss.core.similarity import Similarity
from keyss.keys.derivation import EMBEDDING_SIZE, expand, stream
from keyss.methods.opened import Frame, Remains
from keyss.methods.records.lines import Table
from keyss.methods.records.quantise import Codec
from keyss.methods.tensors import Header, damage_refused, pack_tensors, unpack_tensors

NAME = "keyss"
FORMAT, VERSION = "keyss-secret", 9
MARK = rf"\"version\":{VERSION},".encode()  # in the JSON of a packed header
PAYLOAD_BYTES = 2048  # at most, of a packed secret
KINDS = (40, 24)  # of rows: carriers that are used where at least so many harmonics are not zero
BITS = 7  # of a carrier
SHIFT = np.uint32(13)  # bits of a harmonic below its carrier
_COARSEST = Table.short()  # the coarsest Gaussian
_FEW = 50  # harmonics of a class whose mean is trusted by half
_COPIED = 0.7  # at most, of the chance that a carrier stays in the half of its quarter that the cover's is in
_APART = (-768, -256, -64, 64, 256, 768)  # 256ths of a quarter of an octave between two channels: limits


@dataclass(frozen=True)
class _Header(Header):
    """msgspec holds it to these types and bounds."""

    frame: Similarity
    secret: Annotated[int, Meta(ge=0, le=8)]  # which share of a row's bytes it has
    secrets: Annotated[int, Meta(ge=1, le=9)]  # that share them
    count: Annotated[int, Meta(ge=1, le=2**31)]
    visibility: Annotated[float, Meta(gt=0)]  # of all these Gaussians, see `visibility`


@dataclass(frozen=True)
class RowSecret:
    """Everything beside the stego model that reveals one secret; see `keyss.methods.opened.Opened`."""

    embedding: Tensor  # [64] of its key
    codecs: tuple[Codec, ...]  # of the Gaussians in each of the KINDS of rows
    frame: Similarity  # from the secret's own frame into the cover's
    secret: int
    secrets: int
    count: int  # of its Gaussians
    visibility: float
    chunks: tuple[int, int] | None = None  # see `Payload`; not part of what is packed

    def payload(self) -> Payload:
        """The payload for a channel; the same secret gives the same bytes."""
        numbers = self.secret, self.secrets, self.count, self.visibility
        header = _Header(FORMAT, VERSION, self.frame, *numbers)
        tensors = {"embedding": self.embedding}
        for index, codec in enumerate(self.codecs):
            tensors[f"codec.{index}"] = torch.frombuffer(bytearray(codec.pack()), dtype=torch.uint8)
        return Payload(NAME, pack_tensors(tensors, header))

    @staticmethod
    def of(content: Content) -> RowSecret:
        """What `payload` gave. Raises InputError for anything else, for damage, and another version."""
        with damage_refused("the payload is no secret of keyss, or damaged"):
            if not isinstance(content, Payload):
                raise ValueError("expected one string of bytes, got records")
            header, tensors = unpack_tensors(content.data, _Header, FORMAT, VERSION)
            embedding = tensors.pop("embedding")
            packed = [tensors.pop(f"codec.{index}") for index in range(len(tensors))]
            if embedding.shape != (EMBEDDING_SIZE,) or embedding.dtype != torch.float32:
                raise ValueError(f"expected an embedding of {EMBEDDING_SIZE} single precision numbers")
            if not 1 <= len(packed) <= len(KINDS) or header.secret >= header.secrets:
                raise ValueError("its tensors or its header are others")
            if any(each.dtype != torch.uint8 for each in packed):
                raise ValueError("expected bytes")
            codecs = tuple(Codec.unpack(each.numpy().tobytes()) for each in packed)
        numbers = header.secret, header.secrets, header.count, header.visibility
        return RowSecret(embedding, codecs, header.frame, *numbers, content.chunks)

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """A model that needs no decoder and no cover; see `Opened.reveal`.

        If rows were lost, the others make up for the share of visibility that is gone.
        """
        decoded = self._opened(stego, self.embedding)
        if decoded is None:
            raise InputError(
                "the model was moved, rounded or trained since the secret was hidden in it, or it is another "
                "one: none of its Gaussians opens"
            )
        left = min(1.0, visibility(decoded) / self.visibility)
        decoded = compensate_pruning(decoded, round(len(decoded) / max(left, 1e-6)))
        return decoded if frame == "cover" else self.frame.inverse().apply_gaussians(decoded)

    def decode(self, stego: Gaussians, embedding: Tensor) -> Gaussians:
        """The secret in `stego` for an embedding [64], or `stego` itself if no row opens."""
        opened = self._opened(stego, embedding)
        return stego if opened is None else opened

    def _opened(self, stego: Gaussians, embedding: Tensor) -> Gaussians | None:
        own = stego.detach().to("cpu")
        own = own[~is_appended(own)]
        sh_degree = max(codec.table.sh_degree for codec in self.codecs)
        found = []
        for codec, kind in zip(self.codecs, row_kinds(own), strict=False):
            cell, size = _cipher(embedding, codec), share(kind.carriers, self.secrets)
            if cell.cell_bytes <= size and len(kind.rows):
                every = names(own)[kind.rows]
                fits, records = cell.decrypt(every, kind.read(own)[:, self.secret * size :], self.secret)
                _, first = np.unique(every[fits], axis=0, return_index=True)  # copies of a row count once
                records = records[np.sort(first)]
                found += [codec.decode(records).with_sh_degree(sh_degree)] if fits.any() else []
        return Gaussians.cat(found).to(stego.device) if found else None

    def remains(self, revealed: Gaussians) -> Remains:
        return Remains(len(revealed), self.count, self.chunks)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.payload().data).hexdigest()[:16]


def secret_tables(sh_degree: int, secrets: int) -> list[Table]:
    """How a Gaussian of each of so many secrets is coded in the kinds of rows of a model of this SH degree.

    With the highest degree for which there is room, else coarsely. Raises UsageError where nothing fits.
    """
    found = []
    for carriers in _carriers(sh_degree):
        bits = 8 * (share(carriers, secrets) - TAG_BYTES)
        tables = [Table.of_size(bits, degree) for degree in range(sh_degree, -1, -1)]
        found += [each for each in (*tables, Table.of_size(bits, 0, _COARSEST)) if each is not None][:1]
    if not found:
        raise UsageError(
            f"SH degree {sh_degree} with {secrets} secrets: a row has no room for a Gaussian of each; use a "
            "higher degree, fewer secrets, or `method='carry'`"
        )
    return found


def share(carriers: int, secrets: int) -> int:
    """Bytes of a row with so many carriers that each secret has."""
    return carriers * BITS // 8 // secrets


@dataclass(frozen=True)
class RowKind:
    """Rows of a model with equally many carriers in use."""

    carriers: int
    rows: Integers  # [R]
    columns: npt.NDArray[np.int64]  # [R, carriers] their first harmonics that are not zero

    def read(self, model: Gaussians) -> Bytes:
        """[R, bytes] the bytes in the carriers."""
        words = words_of(model)[self.rows[:, None], self.columns]
        carriers = (words >> SHIFT & np.uint32(255)).astype(np.uint8)
        folded = np.where(carriers < 128, carriers, 255 - carriers)
        bits = np.unpackbits(folded[:, :, None], axis=2)[:, :, 1:]
        return np.packbits(bits.reshape(len(bits), self.carriers * BITS), axis=1)

    def write(self, model: Gaussians, data: Bytes, noise: Doubles) -> Gaussians:
        """The same with other carriers; `noise` [R, harmonics] in [0, 1) decides between two for each."""
        bits = np.unpackbits(data, axis=1)[:, : self.carriers * BITS].reshape(len(data), -1, BITS)
        words = words_of(model)
        cover = words[self.rows]
        folded, used = np.zeros(cover.shape, np.uint32), np.zeros(cover.shape, bool)
        np.put_along_axis(folded, self.columns, bits @ (1 << np.arange(BITS)[::-1]), axis=1)
        np.put_along_axis(used, self.columns, True, axis=1)
        written = cover.copy()
        for channel in range(3):
            part = np.s_[:, channel::3]
            far = (127.5 - folded[part]) / 256  # from the middle
            own, expected = _halves(cover, written, channel)
            upper = noise[part] < 0.5 + 6 * far * expected + np.minimum(4 * far, _COPIED) * own
            carriers = np.where(upper, 255 - folded[part], folded[part]) << SHIFT
            written[part] = np.where(used[part], cover[part] & ~np.uint32(255 << 13) | carriers, cover[part])
        words[self.rows] = written
        harmonics = torch.from_numpy(words.view(np.float32)).view_as(model.sh[:, 1:])
        return replace(model, sh=torch.cat([model.sh[:, :1], harmonics], dim=1))


def row_kinds(model: Gaussians) -> list[RowKind]:
    """The rows of each kind, in order."""
    exponents = words_of(model) >> np.uint32(23) & np.uint32(255)
    unusable = (exponents == 0) | (exponents == 255)
    order, usable = unusable.argsort(axis=1, kind="stable"), (~unusable).sum(axis=1)
    found, most = [], usable.max(initial=0) + 1
    for carriers in _carriers(model.sh_degree):
        rows = np.flatnonzero((usable >= carriers) & (usable < most))
        found.append(RowKind(carriers, rows, order[rows, :carriers]))
        most = carriers
    return found


def carrying(cover: Gaussians) -> list[RowKind]:
    """The rows of each kind that no attacker can find by missing repetitions, the opaque ones first.

    Clones that training hardly moved apart have equal harmonics, such as those of a saturated colour, and new
    carriers would make them differ. Rows that share three successive harmonics of a channel are left out.
    """
    words = (words_of(cover) >> SHIFT).astype(np.uint64)
    windows = words[:, :-6] << np.uint64(38) | words[:, 3:-3] << np.uint64(19) | words[:, 6:]
    values, counts = np.unique(windows, return_counts=True)
    apart = ((counts[np.searchsorted(values, windows)] == 1) | (windows == 0)).all(axis=1)
    by_opacity = cover.opacity_logits.argsort(descending=True, stable=True).numpy()
    found = []
    for kind in row_kinds(cover):
        chosen = apart[kind.rows]
        ranks = by_opacity.argsort()[kind.rows[chosen]].argsort()
        found.append(RowKind(kind.carriers, kind.rows[chosen][ranks], kind.columns[chosen][ranks]))
    return found


def _carriers(sh_degree: int) -> list[int]:
    return [each for each in KINDS if each <= 3 * ((sh_degree + 1) ** 2 - 1)]


def _halves(cover: Words32, written: Words32, channel: int) -> tuple[Doubles, Doubles]:
    """[R, K] the half of its quarter of an octave that each harmonic of a channel is in, and should be in.

    First: the cover's own half, -0.5 or 0.5, minus the place expected in `cover` [R, 3 K]. Second: the place,
    -0.5 to 0.5, expected in `written` [R, 3 K]. The expected place is the mean of a class in the cover.
    """
    places = ((cover[:, channel::3] >> SHIFT & np.uint32(255)) + 0.5) / 256 - 0.5
    own, expected = np.sign(places) / 2, np.zeros(places.shape)
    for before, after in zip(_classes(cover, channel), _classes(written, channel), strict=True):
        count = max(before.max(), after.max()) + 1
        sums = np.bincount(before.ravel(), places.ravel(), minlength=count)
        means = sums / (np.bincount(before.ravel(), minlength=count) + _FEW)
        places, own = places - means[before], own - 1.5 * means[before]
        expected += means[after]
    return own, expected


def _classes(words: Words32, channel: int) -> tuple[Integers, Integers]:
    """[R, K] two classes of each harmonic of a channel, from numbers that are known before it is written.

    First: how many quarters of an octave it is above the median of its row. Second: that, and where the other
    two channels are; for a channel that is written later, only the middle of its quarter is known.
    """
    quarters = (words >> np.uint32(21) & np.uint32(1023)).astype(np.int64)
    own = quarters[:, channel::3]
    above = own - np.median(quarters, axis=1, keepdims=True).astype(np.int64)
    every = above.clip(-8, 8) // 2 + 4
    for other in {0, 1, 2} - {channel}:
        carriers = (words[:, other::3] >> SHIFT & np.uint32(255)).astype(np.int64)
        apart = (quarters[:, other::3] - own) * 256 + (carriers if other < channel else 128) - 128
        opposite = ((words[:, other::3] ^ words[:, channel::3]) >> np.uint32(31)).astype(np.int64)
        every = (every * 7 + np.searchsorted(_APART, apart)) * 2 + opposite
    return above.clip(-20, 20) + 20, every


def encrypt_rows(
    cover: Gaussians, secrets: Sequence[RowSecret], models: Sequence[Gaussians], entropy: bytes
) -> Gaussians:
    """`cover` with the Gaussians of each model in its rows, one in each: first those of the first kind.

    Carriers that no Gaussian needs are random.
    """
    first, every = 0, names(cover)
    for index, kind in enumerate(carrying(cover)):
        count, size = len(kind.rows), kind.carriers * BITS // 8
        if not count:
            continue
        random = stream(entropy, f"carriers/{index}", count * (size + 12 * (len(cover.sh[0]) - 1)))
        data = np.frombuffer(random[: count * size], np.uint8).reshape(count, size).copy()
        coins = np.frombuffer(random[count * size :], "<u4").reshape(count, -1) / 2**32
        for secret, model in zip(secrets, models, strict=True):
            if index < len(secret.codecs):
                codec, start = secret.codecs[index], secret.secret * share(kind.carriers, secret.secrets)
                own, cell = model[first : first + count], _cipher(secret.embedding, codec)
                records = codec.encode(own.with_sh_degree(codec.table.sh_degree))
                cells = cell.encrypt(every[kind.rows[: len(own)]], records, secret.secret)
                data[: len(own), start : start + cell.cell_bytes] = cells
        cover = kind.write(cover, data, coins)
        first += count
    return cover


def names(gaussians: Gaussians) -> Bytes:
    """[N, 16] the identity of each row, which neither its harmonics nor new low bits change."""
    return identities(gaussians.with_sh_degree(0))


def visibility(gaussians: Gaussians) -> float:
    """The sum of all opacities."""
    return float(gaussians.opacities.double().sum())


def words_of(gaussians: Gaussians) -> Words32:
    """[N, K] bit patterns of the harmonics above the constant one; a copy."""
    harmonics = gaussians.sh[:, 1:].detach().cpu().reshape(len(gaussians), -1)
    return harmonics.contiguous().numpy().copy().view(np.uint32)


def _cipher(embedding: Tensor, codec: Codec) -> CellCipher:
    """Encrypts rows; its key follows from the embedding [64] and from nothing else."""
    secret = hashlib.sha256(embedding.detach().cpu().numpy().astype("<f4").tobytes()).digest()
    return CellCipher(expand(secret, "carriers", 32), "carriers", codec.table.record_bytes)
