"""The method `carry`: hides the secrets' models as bytes (see `model_bytes`) in a channel of the cover."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

from keyss.channels import Capacity, Channel, Payload, PreparedCover, appended_count, open_payload
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.plain import fit_scene
from keyss.fitting.schedule import boost_of
from keyss.kernels.memory import release
from keyss.methods.carry.carry_options import FINE_TUNING, CarryOptions
from keyss.methods.codec.model_bytes import decode
from keyss.methods.codec.precision import encode_to_size, finest_size, prune_to_size, usual_size
from keyss.methods.hidden import Frame, HiddenScene, Recovered
from keyss.methods.method import (
    Capabilities,
    Context,
    Plan,
    Prepared,
    Source,
    Stego,
    Training,
    role_of,
    role_phrase,
    seconds_to_hide,
)
from keyss.rendering import contributions
from keyss.rendering.orbit import Viewpoints

# Fine-tuning to renders starts near the optimum: maximum steps, and factor on the rates.
_MODEL_ITERATIONS, _MODEL_RATE = 400, 0.1
_SELECTION_VIEWS = 64
_FINE_TUNED_SHARE = 0.97  # Gaussians fine-tuned / Gaussians that fit: fine-tuning costs compression
_PLANNED_SHARE = 0.95  # Gaussians planned / estimate: those that are kept take more bytes than others
# Least shares of a secret's Gaussians. Public models fine-tuned with fewer are below 30 dB; with fewer than
# the second, and than so many Gaussians, below 20 dB or as far from the plain model as empty renders.
_MIN_SHARE, _HOPELESS_SHARE, _HOPELESS = 1 / 6, 1 / 100, 500
_BITS_PER_GAUSSIAN = 150, 210  # of a secret that is not fitted yet, with the usual and the finest precision
_FAR_TOO_LARGE = 1.5  # size of a secret / what can be appended
_TINY = 16  # Gaussians; secrets are not pruned to fewer


@dataclass(frozen=True)
class CarriedSecret(HiddenScene):
    """A carried secret."""

    payload: Payload
    frame = None

    @staticmethod
    def of(payload: Payload) -> CarriedSecret:
        """Read a payload. Raises InputError for damage."""
        secret = CarriedSecret(payload)
        _ = secret.gaussians
        return secret

    @cached_property
    def gaussians(self) -> Gaussians:
        """Decoded when it is first needed: until then, a secret takes a fifth of the memory."""
        return decode(self.payload.data, self.payload.model_size)

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret") -> Gaussians:
        """All Gaussians of the secret."""
        if frame == "cover":
            raise UsageError(
                'a carried secret has no position in the cover\'s coordinates: leave out `frame="cover"`'
            )
        return self.gaussians

    def recovered(self, revealed: Gaussians) -> Recovered:
        return Recovered(len(revealed), len(revealed), self.payload.shards)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.gaussians.means.numpy().tobytes()).hexdigest()[:16]


@dataclass(frozen=True)
class SecretSize:
    """The size of a secret, at most if it is not fitted yet."""

    count: int  # Gaussians
    usual: int  # bytes of its payload with the usual precision
    finest: int
    fitted: bool

    @staticmethod
    def of(model: Gaussians | None, fit: FitConfig) -> SecretSize:
        """The size of `model`, or of what `fit` will give."""
        if model is not None:
            return SecretSize(len(model), usual_size(model), finest_size(model), True)
        usual, finest = (fit.max_gaussians * bits // 8 for bits in _BITS_PER_GAUSSIAN)
        return SecretSize(fit.max_gaussians, usual, finest, False)


@dataclass(frozen=True)
class CarryCapacity:
    """The capacity of a cover: exact for a prepared cover, estimated for one not fitted yet."""

    gaussians: int  # Gaussians of the cover
    sh_degree: int  # SH degree of the published model
    channel: Channel
    payloads: Capacity
    prepared: PreparedCover | None = None  # None: not fitted yet

    @staticmethod
    def of(channel: Channel, cover: Gaussians | None, fit: FitConfig) -> CarryCapacity:
        """The capacity of `cover`, or of what `fit` will give. Raises UsageError if there is none."""
        if cover is None:
            size = fit.max_gaussians, fit.sh_degree
            return CarryCapacity(*size, channel, channel.estimate_capacity(*size))
        prepared = channel.prepare(cover)
        return CarryCapacity(len(cover), cover.sh_degree, channel, prepared.capacity, prepared)

    def sizes(self, secrets: Sequence[SecretSize]) -> list[int]:
        """The number of Gaussians of each secret that fit at their SH degree; an estimate where not all do.

        Raises UsageError if the cover is too small, or a secret far too large for appended Gaussians.
        """
        most = self.payloads.bytes
        for secret in secrets:
            if self.payloads.grows and secret.fitted and secret.usual > _FAR_TOO_LARGE * most:
                raise UsageError(
                    f"the secret takes about {secret.usual:,} bytes, and {most:,} can be appended; fewer "
                    "Gaussians or a lower SH degree take less"
                )
        limits = self.payloads.limits([secret.finest for secret in secrets])
        counts = [
            min(secret.count, secret.count * limit // secret.usual)
            for secret, limit in zip(secrets, limits, strict=True)
        ]
        if any(count < min(_TINY, secret.count) for count, secret in zip(counts, secrets, strict=True)):
            raise UsageError(
                f"a cover of {self.gaussians:,} Gaussians is too small to hide {len(secrets)} "
                f"{'secrets' if len(secrets) > 1 else 'secret'} in its {self.channel.place}"
            )
        return counts

    def prune(self, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]) -> list[Gaussians]:
        """The most visible Gaussians of each model that fit, or all; see `prune_to_size`.

        Warns (KeyssWarning) if the models have less room than they would alone.
        """
        needed = list(map(finest_size, models))
        limits = self.payloads.limits(needed, warn=True)
        return [prune_to_size(*model) for model in zip(models, limits, viewpoints, strict=True)]


class CarryMethod:
    """See `keyss.methods.method.Method`."""

    name = CarryOptions.method
    max_secrets = 256
    capabilities = Capabilities()
    options = CarryOptions

    def prepare(
        self, sources: Sequence[Source], options: CarryOptions, earlier: Prepared | None = None
    ) -> Prepared:
        """Select the channel, and the secrets that are pruned and fine-tuned; see `Method`."""
        cover, *secrets = sources
        chosen = replace(options, publish="converted") if earlier and earlier.grows else options
        secret_sizes = [SecretSize.of(secret.given, options.fit) for secret in secrets]

        def fit_in(channel: Channel) -> tuple[CarryCapacity, list[int]]:
            capacity = CarryCapacity.of(channel, cover.given, options.fit)
            counts = capacity.sizes(secret_sizes)
            chosen_by_user = options.publish or options.format
            for size, count in zip(secret_sizes, counts, strict=True):
                hopeless = count < min(_HOPELESS, _HOPELESS_SHARE * size.count)
                known = cover.given is not None and size.fitted
                if hopeless or (known and not chosen_by_user and count < _MIN_SHARE * size.count):
                    most = "" if size.fitted else "up to "
                    raise UsageError(
                        f"a secret of {most}{size.count:,} Gaussians would be cut down to about {count:,}"
                    )
            return capacity, counts

        capacity, counts = chosen.in_channel(cover.given, fit_in)
        steps = _fine_tuning_steps(secrets, secret_sizes, counts, options)
        training = (Training(), *map(Training, steps))
        if earlier:
            pairs = zip(earlier.training, training, strict=True)
            training = tuple(old if old.steps else new for old, new in pairs)
        fits = [
            options.fit if index == 0 or trained.steps else unpruned
            for index, (trained, unpruned) in enumerate(
                zip(training, options.fits(len(sources)), strict=True)
            )
        ]
        usual = [size.usual for size in secret_sizes]
        appended = appended_count(usual) if capacity.payloads.grows else 0  # about
        kept = [
            count if count == size.count else int(_PLANNED_SHARE * count)
            for size, count in zip(secret_sizes, counts, strict=True)
        ]
        plan = Plan(
            gaussians=capacity.gaussians + appended,
            sh_degree=capacity.sh_degree,
            secret_gaussians=sum(secret.count for secret in secret_sizes),
            capacity=sum(kept),
            notes=(_note(capacity, appended),),
        )
        return Prepared(
            options=options,
            fits=tuple(fits),
            training=training,
            plan=plan,
            grows=capacity.payloads.grows,
            survives=capacity.channel.survives,
            capacity=capacity,
        )

    def hide(self, sources: list[Source], prepared: Prepared, context: Context) -> Stego:
        """Fine-tune the secrets that need it, embed all, and open each again to check.

        Empties `sources`. Raises UsageError for a cover without capacity, Interrupted on Ctrl-C, and
        InputError for a checkpoint of another run.
        """
        cover, *secrets = sources
        sources.clear()
        capacity: CarryCapacity = prepared.capacity
        assert capacity.prepared is not None  # the cover is fitted
        keys = [secret.key for secret in secrets]
        viewpoints = [Viewpoints.of(secret.scene) for secret in secrets]
        models = [secret.model for secret in secrets]
        before = [*map(len, models)]
        if prepared.trains:
            fitting = capacity.prune(models, viewpoints)
            for index, secret in enumerate(secrets):
                if not (steps := prepared.training[index + 1].steps):
                    continue
                size, role = len(fitting[index]), role_of(index + 1, len(before) + 1)
                size = max(1, int(_FINE_TUNED_SHARE * size)) if size < before[index] else size
                model = secret.model.with_sh_degree(fitting[index].sh_degree)
                fit = prepared.options.fit
                models[index] = fit_scene(
                    secret.scene,
                    # Fine-tuning must not depend on the other secrets.
                    replace(fit, iterations=steps, seed=fit.seed_of(role)),
                    model=most_contributing(model, secret.scene, size),
                    rate=boost_of(replace(fit, iterations=steps)) if secret.photos else _MODEL_RATE,
                    device=context.device,
                    title=f"fine-tuning of {role_phrase(role)}",
                    **context.loop_arguments(role.replace(" ", "-")),
                ).gaussians
            del fitting
        del secrets
        seconds = seconds_to_hide(len(cover.model), [*map(len, models)], prepared.grows)
        with context.waiting("hiding", seconds):
            models = capacity.prune(models, viewpoints)
            stego = embed_models(
                capacity.prepared, keys, models, viewpoints=viewpoints, entropy=context.entropy
            )
        details = {"gaussians_before_pruning": before, **stego.details}
        return replace(stego, iterations=max(trained.steps for trained in prepared.training), details=details)


def _fine_tuning_steps(
    secrets: Sequence[Source], sizes: Sequence[SecretSize], counts: Sequence[int], options: CarryOptions
) -> list[int]:
    """Fine-tuning steps of each secret; 0: none. `counts`: Gaussians of each secret that fit."""
    fit = options.fit.iterations
    steps = []
    for secret, size, count in zip(secrets, sizes, counts, strict=True):
        pruned = count < size.count if options.fine_tune == "auto" else options.fine_tune == "always"
        usual = round(FINE_TUNING * fit) if secret.photos else min(fit, _MODEL_ITERATIONS)
        steps.append((options.iterations or usual) if pruned else 0)
    return steps


def _note(capacity: CarryCapacity, appended: int) -> str:
    """What is appended, or the capacity."""
    if appended:
        return (
            f"up to {appended:,} invisible Gaussians are appended to the cover's {capacity.gaussians:,}; "
            "fewer Gaussians or a lower SH degree of a secret take less"
        )
    held = f"the {capacity.channel.place} have room for"
    if capacity.prepared is None:
        return f"{held} about {capacity.payloads.bytes:,} bytes; fitted, it may be 0.6 to 1.6 times as many"
    return f"{held} exactly {capacity.payloads.bytes:,} bytes"


METHOD = CarryMethod()


def most_contributing(plain: Gaussians, scene: Scene, count: int) -> Gaussians:
    """The `count` Gaussians with the largest blending weights in the training views, in their order."""
    if count >= len(plain):
        return plain
    cameras = [view.camera for view in subsample_views(scene.train, _SELECTION_VIEWS)]
    return plain[contributions(plain, cameras).topk(count).indices.sort().values]


def embed_models(
    cover: PreparedCover,
    keys: Sequence[str],
    models: list[Gaussians],
    *,
    viewpoints: Sequence[Viewpoints] | None = None,
    entropy: bytes | None = None,
) -> Stego:
    """Embed each model under its key, and verify that it opens. Empties `models`, which may free memory.

    `viewpoints`: views of each model that determine its precision; by default, four around it. Raises
    UsageError if the models do not fit. Warns (KeyssWarning) if a secret gets fewer bytes than alone.
    """
    viewpoints, capacity = viewpoints or [*map(Viewpoints.around, models)], cover.capacity
    needed = list(map(finest_size, models))
    limits = capacity.limits(needed, warn=True)
    counts, degrees = [*map(len, models)], [model.sh_degree for model in models]
    payloads = [
        Payload(
            CarryOptions.method, encode_to_size(models.pop(0), limit, short=capacity.grows, viewpoints=views)
        )
        for limit, views in zip(limits, viewpoints, strict=True)
    ]
    release()
    stego = cover.embed(list(zip(keys, payloads, strict=True)), entropy=entropy)
    release()
    read = list(map(partial(open_payload, stego), keys))
    if [payload.data for payload in read] != [payload.data for payload in payloads]:
        raise RuntimeError("the embedded secrets do not open again as they should")
    sizes = [len(payload.data) for payload in payloads]
    details: dict[str, Any] = {
        "secret_bytes": sizes,
        "sh_degrees": degrees,
        "bits_per_gaussian": [round(8 * size / count) for size, count in zip(sizes, counts, strict=True)],
    }
    if not capacity.grows:
        details["capacity_bytes"] = capacity.bytes
        details["capacity_bits_per_gaussian"] = round(8 * capacity.bytes / len(cover.cover), 2)
    return Stego(stego, tuple(map(CarriedSecret, read)), details=details, verified=True)
