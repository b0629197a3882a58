"""KeySS, *Key-Secured 3D Secrets within 3D Gaussian Splatting*: hides and reveals.

Read `keyss_options` (the paper's symbols and values), `decoder` (equations 6 and 8, appendix B), `training`
(section 3.4, losses 4, 5 and 7, their sum 11), then this file.

A payload, encrypted with the key by its channel, holds the decoder (weights in half precision), the vector of
the key, the similarity from the secret's frame to the cover's, and *anchors*:
positions of some Gaussians of the stego model, to detect a moved or rounded model. docs/byte-layout.md lists
the bytes.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta
from scipy.spatial import cKDTree
from torch import Tensor

from keyss.channels import APPENDED, LOW_BITS, Payload, appended_count, check_payload_fits, is_appended
from keyss.core.errors import InputError, KeyssError, KeyssWarning, UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.keys import DerivedKey
from keyss.keys.clip import MODEL, ClipKeys, clip_keys
from keyss.keys.derivation import SALT_BYTES, expand, stream
from keyss.methods.hidden import Frame, HiddenScene, Recovered
from keyss.methods.keyss.decoder import Decoder
from keyss.methods.keyss.keyss_options import DecoderShape, KeyssOptions, parse_mask
from keyss.methods.keyss.training import KeyssTraining
from keyss.methods.method import Capabilities, Context, Prepared, Source, Stego
from keyss.methods.placed_scene import PlacedScene
from keyss.methods.tensors import Header, pack_tensors, refuse_damage, unpack_tensors

NAME = "keyss"
FORMAT, VERSION = "keyss-secret", 1
ANCHORS = 64
ANCHORS_NEEDED = 0.25  # minimum share of the anchors that are Gaussians of the model
ANCHOR_TOLERANCE = 1e-6  # fraction of the model's size
_SLACK = 0.01  # share of the Gaussians that rounding may make visible or invisible
_WEIGHTS = "decoder."
_COST = (
    "KeySS costs every scene quality and takes a long training: `--method carry` hides trained models better"
)
_IDLE = "density control added no Gaussian to the {:,} of the start: train longer, or allow more Gaussians"
_APPENDED = "the secrets lie in appended Gaussians instead, which everybody can see in the file"
_SMALL = "a model of {:,} Gaussians is probably too small for low bits; then {}"


class KeyssMethod:
    """See `keyss.methods.method.Method`."""

    name = KeyssOptions.method
    max_secrets = 9
    capabilities = Capabilities()
    options = KeyssOptions

    def prepare(
        self, sources: Sequence[Source], options: KeyssOptions, earlier: Prepared | None = None
    ) -> Prepared:
        """All scenes share the Gaussians of one model, with the loss of the design.

        Raises BackendError if CLIP is missing.
        """
        design, secrets = options.configuration, len(sources) - 1
        if design.ssim_weight is not None:
            options = options.with_fit(ssim_weight=design.ssim_weight)
        _encoder(options)
        shape = replace(design.decoder, sh_degree=options.fit.sh_degree)
        probe = KeyssSecret(Decoder(shape), torch.zeros(shape.key_size), Similarity(), torch.rand(ANCHORS, 3))
        size = len(probe.payload().data)
        plan = replace(options.joint_plan(secrets), notes=(_COST,))
        try:
            check_payload_fits(size, options.fit.max_gaussians, secrets, shape.sh_degree)
        except UsageError:
            appended = appended_count([size] * secrets)
            note = _SMALL.format(plan.gaussians, _APPENDED)
            plan = replace(plan, gaussians=plan.gaussians + appended, notes=(_COST, note))
        return Prepared.of(options, len(sources), plan)

    def hide(self, sources: Sequence[Source], prepared: Prepared, context: Context) -> Stego:
        """Train the cover and the secrets jointly, and hide a payload for each secret.

        Warns (KeyssWarning) if density control added nothing, and if the payloads exceed the low bits. Raises
        Interrupted on Ctrl-C, and InputError for a checkpoint of another run.
        """
        options, keys = prepared.options, [source.key for source in sources[1:]]
        entropy = context.entropy or os.urandom(32)
        if encoder := _encoder(options):
            vectors = [encoder(key) for key in keys]
        else:
            salt = expand(entropy, "keyss/embedding-salt", SALT_BYTES)
            vectors = [DerivedKey.of(key, salt).embedding() for key in keys]
        run = KeyssTraining(
            PlacedScene.all_of(sources), vectors, options, context.device, encoder.random if encoder else None
        )
        run.train(sources, context)
        if len(run) <= run.started:
            warnings.warn(_IDLE.format(run.started), KeyssWarning, stacklevel=2)
        stego, hidden = publish(run, entropy)
        payloads = [secret.payload() for secret in hidden]
        keyed = list(zip(keys, payloads, strict=True))
        details: dict[str, Any] = {}
        try:
            embedded = LOW_BITS.prepare(stego).embed(keyed, entropy=entropy)
        except KeyssError as error:
            embedded = APPENDED.prepare(stego).embed(keyed, entropy=entropy)
            warnings.warn(f"method keyss: {error}; {_APPENDED}", KeyssWarning, stacklevel=2)
            details["appended_because"] = str(error)
        return Stego(embedded, tuple(map(KeyssSecret.of, payloads)), run.iterations, details)


def _encoder(options: KeyssOptions) -> ClipKeys | None:
    """CLIP, if it is the key encoder. Raises BackendError if it is missing."""
    return clip_keys(options.clip_model or MODEL) if options.key_encoder == "clip" else None


def publish(run: KeyssTraining, entropy: bytes) -> tuple[Gaussians, list[KeyssSecret]]:
    """G_cover on the CPU, before its low bits are written, and the secrets; `entropy`: 32 secret bytes."""
    # Shuffle: in training, the points of each scene are contiguous.
    stego = run.cover().detach().to("cpu")
    numbers = np.frombuffer(stream(entropy, "order", 8 * len(stego)), "<u8")
    stego = stego[torch.from_numpy(numbers.argsort(kind="stable"))]
    anchors = choose_anchors(stego, run.fit.known_seed)
    decoder, secrets = run.decoder.to("cpu").requires_grad_(False), []
    for placed, key in zip(run.scenes[1:], run.keys, strict=True):
        shown = count_visible(decoder(stego, key.cpu()))
        secrets.append(KeyssSecret(decoder, key.cpu(), placed.frame, anchors, shown))
    return stego, secrets


@dataclass(frozen=True)
class _Header(Header):
    """Types and bounds that msgspec checks."""

    shape: DecoderShape
    frame: Similarity
    count: Annotated[int, Meta(ge=0, le=2**31)]


@dataclass(frozen=True)
class KeyssSecret(HiddenScene):
    """Everything beside the stego model that reveals one secret."""

    decoder: Decoder
    key: Tensor = field(repr=False)  # [K] the vector of its key
    frame: Similarity  # secret frame to cover frame
    anchors: Tensor  # [A, 3] positions of Gaussians of the stego model
    count: int = 0  # Gaussians revealed from a complete file; 0: unknown
    shards: tuple[int, int] | None = None  # see `Payload`; not packed

    def payload(self) -> Payload:
        """The payload for a channel; the same secret gives the same bytes."""
        header = _Header(FORMAT, VERSION, self.decoder.shape, self.frame, self.count)
        tensors = {_WEIGHTS + name: value.half() for name, value in self.decoder.state_dict().items()}
        return Payload(NAME, pack_tensors({**tensors, "key": self.key, "anchors": self.anchors}, header))

    @staticmethod
    def of(payload: Payload) -> KeyssSecret:
        """Read a payload. Raises InputError for other data, damage and another version."""
        with refuse_damage("the payload is no secret of keyss, or damaged"):
            header, tensors = unpack_tensors(payload.data, _Header, FORMAT, VERSION)
            shape = header.shape
            if parse_mask(",".join(shape.mask)) != shape.mask:
                raise ValueError("its mask is in another order")
            if sum(value.numel() for value in tensors.values()) < shape.weights:
                raise ValueError("its decoder has more weights than the payload")
            anchors, key = tensors.pop("anchors").float(), tensors.pop("key").float()
            if anchors.dim() != 2 or anchors.shape[1] != 3 or not 1 <= len(anchors) <= ANCHORS:
                raise ValueError(f"expected up to {ANCHORS} anchors, got shape {list(anchors.shape)}")
            if key.shape != (shape.key_size,):
                raise ValueError(f"expected a key of {shape.key_size} numbers, got {list(key.shape)}")
            decoder = Decoder(shape)
            decoder.load_state_dict({name.removeprefix(_WEIGHTS): value for name, value in tensors.items()})
        decoder.requires_grad_(False)
        return KeyssSecret(decoder, key, header.frame, anchors, header.count, payload.shards)

    @torch.no_grad()
    def reveal(self, stego: Gaussians, *, frame: Frame = "secret") -> Gaussians:
        """The secret as a standalone model, without invisible Gaussians; see `HiddenScene.reveal`."""
        self.check_unchanged(stego)
        decoded = self.decode(stego, self.key).to("cpu")
        if (visible := decoded.opacities >= DRAWN_OPACITY).any():
            decoded = decoded[visible]
        return decoded if frame == "cover" else self.frame.inverse().apply_gaussians(decoded)

    def decode(self, stego: Gaussians, key: Tensor) -> Gaussians:
        """D(stego, k) for the vector [K] of a key.

        Appended Gaussians are left out: they were added after the training.
        """
        decoder: Decoder = self.decoder.to(stego.device)
        decodable = stego[~is_appended(stego)].with_sh_degree(decoder.shape.sh_degree)
        return decoder(decodable, key.to(stego.device))  # type: ignore[no-any-return]

    def recovered(self, revealed: Gaussians) -> Recovered:
        """See `HiddenScene.recovered`; Gaussians that are never rendered do not count."""
        return Recovered(count_visible(revealed), self.count, self.shards, _SLACK)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.payload().data).hexdigest()[:16]

    @property
    def key_size(self) -> int:
        """Numbers of a key's vector."""
        return len(self.key)

    def check_unchanged(self, stego: Gaussians) -> None:
        """Raise InputError unless enough anchors are Gaussians of `stego`."""
        means = stego.means.detach().double().cpu().numpy()
        size = float(np.ptp(means, axis=0).max())
        distances, _ = cKDTree(means).query(self.anchors.double().numpy())
        share = float((distances <= ANCHOR_TOLERANCE * size).mean())
        if share < ANCHORS_NEEDED:
            raise InputError(
                "the model was moved or rounded since its decoder was trained, or it is another one: "
                f"{share:.0%} of the decoder's anchors are there, at least {ANCHORS_NEEDED:.0%} expected; "
                "use the file as it was published"
            )


def choose_anchors(stego: Gaussians, seed: int) -> Tensor:
    """[A, 3] positions of randomly chosen Gaussians."""
    generator = torch.Generator().manual_seed(seed)
    return stego.means[torch.randperm(len(stego), generator=generator)[:ANCHORS]].detach().cpu()


def count_visible(model: Gaussians) -> int:
    """The number of Gaussians that are rendered."""
    return int((model.opacities >= DRAWN_OPACITY).sum())


METHOD = KeyssMethod()
