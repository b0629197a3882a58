"""The method `carry`: hides the secrets' models as bytes (see `model_bytes`) in a channel of the cover."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from keyss.channels import Payload, PreparedCover, open_payload
from keyss.core.errors import KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.plain import fit_scene
from keyss.fitting.schedule import boost_of
from keyss.methods.carry.capacity import CarryCapacity, SecretSize, shares, warn_of_sharing
from keyss.methods.carry.carried_secret import CarriedSecret
from keyss.methods.carry.carry_options import FINE_TUNING, CarryOptions
from keyss.methods.codec.precision import encode_to_size, finest_size
from keyss.methods.method import Capabilities, Context, Plan, Source, Stego, role_of, seconds_to_hide
from keyss.rendering import contributions
from keyss.rendering.orbit import Viewpoints

# Fine-tuning to renders starts near the optimum: maximum steps, and factor on the rates.
_MODEL_ITERATIONS, _MODEL_RATE = 400, 0.1
_SELECTION_VIEWS = 64
_VISIBLE = (
    "the cover can hold the secret, but whoever inspects the published file sees that it holds something "
    '(`publish="converted"`), because it cannot be hidden unnoticed: {}'
)
_FINE_TUNED_SHARE = 0.97  # Gaussians after fine-tuning / that fit: they compress a little worse then
_MIN_SHARE = 1 / 6  # of a secret's Gaussians; public models fine-tuned with fewer are below 30 dB


class CarryMethod:
    """See `keyss.methods.method.Method`."""

    name = CarryOptions.method
    max_secrets = 256
    capabilities = Capabilities()
    options = CarryOptions

    def prepare(self, sources: Sequence[Source], options: CarryOptions) -> CarryOptions:
        """Set the steps of fine-tuning; a second call, with fitted models, only adds some.

        If secrets cannot be hidden unnoticed, `publish` becomes "converted", with a warning, where
        `may_show`. Otherwise raises UsageError.
        """
        cover, *secrets = sources
        secret_sizes = _secret_sizes(secrets, options)
        if options.channel_in(cover.given).grows:
            for each in secret_sizes:
                each.check_appended()
        try:
            capacity = CarryCapacity.of(cover.given, options)
            sizes = capacity.sizes(secret_sizes)
            if options.may_show and cover.given is not None:
                _check_share(secret_sizes, sizes)
        except UsageError as refused:
            if not options.may_show:
                raise
            warnings.warn(_VISIBLE.format(refused.__cause__ or refused), KeyssWarning, stacklevel=2)
            return self.prepare(sources, replace(options, publish="converted"))
        cut = [size < secret.count for size, secret in zip(sizes, secret_sizes, strict=True)]
        if options.fine_tune == "always":
            cut = [True] * len(cut)
        elif options.fine_tune == "never":
            cut = [False] * len(cut)
        steps = round(FINE_TUNING * options.fit.iterations)
        fine_tuning_steps = [
            options.iterations or (steps if secret.photos else min(options.fit.iterations, _MODEL_ITERATIONS))
            for secret in secrets
        ]
        planned = options.fine_tuning_steps or (0,) * len(cut)  # by the first call
        return replace(
            options,
            fine_tuning_steps=tuple(
                p or (n if c else 0) for p, n, c in zip(planned, fine_tuning_steps, cut, strict=True)
            ),
        )

    def plan(self, sources: Sequence[Source], options: CarryOptions) -> Plan:
        """See `Method`; notes tell what is appended, or the capacity."""
        cover, *secrets = sources
        capacity = CarryCapacity.of(cover.given, options)
        secret_sizes = _secret_sizes(secrets, options)
        sizes, appended, notes = capacity.sizes(secret_sizes), capacity.appended(secret_sizes), []
        if appended:
            notes.append(
                f"up to {appended:,} invisible Gaussians are appended to the cover's {capacity.gaussians:,}; "
                "fewer Gaussians or a lower SH degree of a secret take less"
            )
        else:
            how = "about" if capacity.prepared is None else "exactly"
            notes.append(
                f"the {capacity.channel.place} have room for {how} {capacity.payloads.bytes:,} bytes"
            )
        return Plan(
            gaussians=capacity.gaussians + appended,
            sh_degree=capacity.sh_degree,
            secret_gaussians=sum(secret.count for secret in secret_sizes),
            capacity=sum(sizes),
            notes=tuple(notes),
        )

    def hide(
        self, cover: Source, secrets: Sequence[Source], options: CarryOptions, context: Context
    ) -> Stego:
        """Fine-tune the secrets that need it, embed all, and open each again to check.

        Raises UsageError for a cover without capacity, Interrupted on Ctrl-C, and InputError for a
        checkpoint of another run.
        """
        capacity = CarryCapacity.of(cover.model, options)
        assert capacity.prepared is not None  # the cover is fitted
        plain = [secret.model for secret in secrets]
        viewpoints = [Viewpoints.of(secret.scene) for secret in secrets]
        models = list(plain)
        if any(options.fine_tuning_steps):
            fitting = capacity.prune(plain, viewpoints)
            for index, (secret, steps, fits) in enumerate(
                zip(secrets, options.fine_tuning_steps, fitting, strict=True)
            ):
                if steps:
                    cut = len(fits) < len(secret.model)
                    models[index] = fine_tune(
                        secret.model.with_sh_degree(fits.sh_degree),
                        secret.scene,
                        max(1, int(_FINE_TUNED_SHARE * len(fits))) if cut else len(fits),
                        replace(options.fit, iterations=steps),
                        context,
                        photos=secret.photos,
                        name=role_of(index + 1, len(secrets) + 1),
                    )
        details = {"gaussians_before_pruning": [len(model) for model in plain]}
        with context.waiting("hiding", seconds_to_hide(len(cover.model), [*map(len, models)])):
            stego = embed_models(
                capacity.prepared,
                [secret.key for secret in secrets],
                capacity.prune(models, viewpoints),
                viewpoints=viewpoints,
                entropy=context.entropy,
            )
        return replace(stego, iterations=max(options.fine_tuning_steps), details={**details, **stego.details})


def _secret_sizes(secrets: Sequence[Source], options: CarryOptions) -> list[SecretSize]:
    return [
        SecretSize(options.fit.max_gaussians) if secret.given is None else SecretSize.of(secret.given)
        for secret in secrets
    ]


def _check_share(secrets: Sequence[SecretSize], sizes: Sequence[int]) -> None:
    """Raise UsageError for given secrets that would keep less than _MIN_SHARE of their Gaussians."""
    for secret, count in zip(secrets, sizes, strict=True):
        if secret.model is not None and count < _MIN_SHARE * secret.count:
            raise UsageError(f"a secret of {secret.count:,} Gaussians would be cut down to {count:,}")


METHOD = CarryMethod()


def fine_tune(
    secret: Gaussians,
    scene: Scene,
    count: int,
    fit: FitConfig,
    context: Context,
    *,
    photos: bool,
    name: str,
) -> Gaussians:
    """Train the `most_contributing` Gaussians of `secret` further.

    Raises Interrupted on Ctrl-C, InputError for a checkpoint of another run.
    """
    return fit_scene(
        scene,
        # Fine-tuning must not depend on the other secrets.
        replace(fit, seed=fit.seed_of(name)),
        model=most_contributing(secret, scene, count),
        rate=boost_of(fit) if photos else _MODEL_RATE,
        device=context.device,
        title=f"fine-tuning of the {name}",
        **context.loop_arguments(name.replace(" ", "-")),
    ).gaussians


def most_contributing(plain: Gaussians, scene: Scene, count: int) -> Gaussians:
    """The `count` Gaussians with the largest blending weights in the training views, in their order."""
    if count >= len(plain):
        return plain
    cameras = [view.camera for view in subsample_views(scene.train, _SELECTION_VIEWS)]
    return plain[contributions(plain, cameras).topk(count).indices.sort().values]


def embed_models(
    cover: PreparedCover,
    keys: Sequence[str],
    models: Sequence[Gaussians],
    *,
    viewpoints: Sequence[Viewpoints] | None = None,
    entropy: bytes | None = None,
) -> Stego:
    """Embed each model under its key, and verify that it opens.

    `viewpoints`: views of each model that determine its precision; by default, four around it. Raises
    UsageError if the models do not fit. Warns (KeyssWarning) if a secret gets fewer bytes than alone.
    """
    viewpoints, capacity = viewpoints or [*map(Viewpoints.around, models)], cover.capacity
    needed = list(map(finest_size, models))
    warn_of_sharing(capacity, needed)
    limits = shares(capacity, needed)
    payloads = [
        Payload(CarryOptions.method, encode_to_size(model, limit, short=capacity.grows, viewpoints=views))
        for model, limit, views in zip(models, limits, viewpoints, strict=True)
    ]
    stego = cover.embed(list(zip(keys, payloads, strict=True)), entropy=entropy)
    opened = [CarriedSecret(open_payload(stego, key)) for key in keys]
    if [each.payload.data for each in opened] != [each.data for each in payloads]:
        raise RuntimeError("the embedded secrets do not open again as they should")
    sizes = [len(each.data) for each in payloads]
    details: dict[str, Any] = {
        "secret_bytes": sizes,
        "sh_degrees": [each.sh_degree for each in models],
        "bits_per_gaussian": [round(8 * size / len(each)) for size, each in zip(sizes, models, strict=True)],
    }
    if not capacity.grows:
        details["capacity_bytes"] = capacity.bytes
        details["capacity_bits_per_gaussian"] = round(8 * capacity.bytes / len(cover.cover), 2)
    return Stego(stego, tuple(opened), details=details, verified=True)
