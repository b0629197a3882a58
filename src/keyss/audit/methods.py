"""What an audit asks of methods, whichever hid a secret."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.pruning_compensation import filled
from keyss.core.similarity import Similarity
from keyss.measure.hiding import HidingQuality, PsnrRange, WrongKeys
from keyss.methods.base import Frame, Opened
from keyss.methods.carry.carrying import Carried
from keyss.methods.learned import attacks as learned_attacks
from keyss.methods.learned.opening import open_model
from keyss.methods.learned.payload import HiddenSecret, pack_secret
from keyss.methods.learned.revealing import open_secret, reveal_gaussians
from keyss.runs.audit_record import WrongKeyResult


@dataclass(frozen=True)
class OpenedLearned:
    secret: HiddenSecret

    @property
    def frame(self) -> Similarity | None:
        return self.secret.frame

    @property
    def decode(self) -> Callable[[Gaussians, Tensor], Gaussians] | None:
        return self._decode

    def _decode(self, stego: Gaussians, embedding: Tensor) -> Gaussians:
        """Differentiable in the embedding."""
        decoder = self.secret.decoder.to(stego.device)
        if self.secret.scramble is not None:
            stego = self.secret.scramble.open(stego)
        decoded: Gaussians = decoder(
            stego.with_sh_degree(decoder.shape.sh_degree), embedding.to(stego.device)
        )
        return decoded

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        return reveal_gaussians(stego, self.secret, frame=frame, force=force)

    def fingerprint(self) -> str:
        import hashlib

        return hashlib.sha256(pack_secret(self.secret)).hexdigest()[:16]


@dataclass(frozen=True)
class OpenedCarried:
    secret: Carried
    frame: Similarity | None = None
    decode: Callable[[Gaussians, Tensor], Gaussians] | None = None

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        return filled(self.secret.gaussians, self.secret.count)

    def fingerprint(self) -> str:
        return self.secret.fingerprint()


def as_opened(secret: HiddenSecret | Carried) -> Opened:
    return OpenedCarried(secret) if isinstance(secret, Carried) else OpenedLearned(secret)


def opener(sidecar: bytes | None = None) -> Callable[[Gaussians, str], Opened]:
    """From a stego model and a key to what it opens, in the model or in a sidecar."""
    if sidecar is None:
        return lambda stego, key: as_opened(open_model(stego, key))
    return lambda stego, key: as_opened(open_secret(stego, key, sidecar))


def views_by_source(model: Gaussians, secrets: int) -> Mapping[str, Gaussians]:
    """What somebody tries who has read the source of all methods."""
    return learned_attacks.attacks(model, secrets)


def wrong_keys_of(metrics: dict[str, Any]) -> WrongKeyResult | None:
    """What wrong keys show, from a run's metrics."""
    if not (wrong := metrics.get("wrong_key")):
        return None
    cover, secrets = wrong["vs_cover"], wrong["vs_secrets"]
    shown = WrongKeys(
        wrong["keys"],
        PsnrRange(cover["mean"], cover["min"], cover.get("max", cover["mean"])),
        tuple(PsnrRange(each["mean"], each.get("min", each["mean"]), each["max"]) for each in secrets),
    )
    return WrongKeyResult(shown, tuple(wrong["floor"]))


def metrics_of(found: HidingQuality, gaussians: int) -> dict[str, Any]:
    metrics = asdict(found) | {"gaussians": gaussians}
    metrics["bound"] = metrics.pop("baseline")
    metrics["wrong_key"]["floor"] = list(metrics.pop("chance_level"))
    metrics["secrets"] = list(metrics["secrets"])
    return metrics
