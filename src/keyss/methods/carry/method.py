"""The method `carry`: encrypts the secrets' Gaussians in the published model.

In low bits a Gaussian is a record (see `quantise`); the header holds the number of records and the codec.
Copies of the most visible Gaussians fill free cells. All other channels carry a model as one payload (see
`whole`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from keyss.channels import Content, LowBitsCover, Payload, PreparedCover, Records, open_content
from keyss.core.errors import KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.plain import fit_scene
from keyss.fitting.schedule import boost_of
from keyss.methods.base import Capabilities, Context, Plan, Source, Stego, role_of
from keyss.methods.carry.capacity import PayloadCapacity, SecretSize, capacity_for, record_request, shares
from keyss.methods.carry.options import REFIT, CarryOptions
from keyss.methods.records.carried_secret import COUNT, unpack
from keyss.methods.records.lines import Table
from keyss.methods.records.precision import encode_to_size, most_visible_rows
from keyss.methods.records.quantise import Codec, out_of_range
from keyss.methods.records.whole import encode
from keyss.rendering import contributions
from keyss.rendering.orbit import Viewpoints, psnr_between

# Refits to renders start near the optimum: maximum steps, and factor on the rates.
_MODEL_ITERATIONS, _MODEL_RATE = 400, 0.1
_SELECTION_VIEWS = 64
_PLANNED = bytes(32)  # dummy entropy for plans
_VISIBLE = (
    "the cover can hold the secret, but whoever inspects the published file sees that it holds something "
    '(`publish="any"`), because it cannot be hidden unnoticed: {}'
)
_MIN_SHARE = 1 / 6  # fraction of a secret's Gaussians; refits of public models with fewer are below 30 dB
_FEWER = (
    "the secrets share the capacity, and each has fewer Gaussians than it could have alone: whoever has one "
    "of the keys can notice that there are other secrets"
)


class CarryMethod:
    """See `keyss.methods.base.Method`."""

    name = CarryOptions.method
    max_secrets = 256
    capabilities = Capabilities()
    options = CarryOptions

    def prepare(self, sources: Sequence[Source], options: CarryOptions) -> CarryOptions:
        """Choose the secrets to refit: once all are fitted, also those that do not fit the cover.

        Raises UsageError for a cover without capacity.
        """
        cover, *secrets = sources
        degree = options.sh_degree
        if degree is None:
            degree = options.fit.sh_degree if cover.given is None else cover.given.sh_degree
        options = options.with_fit(sh_degree=degree)
        try:
            capacity = capacity_for(cover.given, options, _PLANNED)
            options = replace(options, max_secret_degree=capacity.max_secret_degree)
            secret_sizes = _secret_sizes(secrets, options)
            sizes = capacity.sizes(secret_sizes)
            if options.may_show and cover.given is not None:
                _check_share(secret_sizes, sizes)
        except UsageError as refused:
            if not options.may_show:
                raise
            warnings.warn(_VISIBLE.format(refused), KeyssWarning, stacklevel=2)
            return self.prepare(sources, replace(options, publish="any"))
        cut = [size != secret.size for size, secret in zip(sizes, secret_sizes, strict=True)]
        if options.refit == "always":
            cut = [True] * len(cut)
        elif options.refit == "never":
            cut = [False] * len(cut)
        elif any(cut) and all(each.given is not None for each in sources):
            alone = [capacity.sizes([secret])[0] for secret in secret_sizes]
            if sizes != alone:
                warnings.warn(_FEWER, KeyssWarning, stacklevel=2)
        steps = round(REFIT * options.fit.iterations)
        refits = [
            options.iterations or (steps if secret.photos else min(options.fit.iterations, _MODEL_ITERATIONS))
            for secret in secrets
        ]
        planned = options.refits or (0,) * len(cut)  # set by the first call
        return replace(
            options, refits=tuple(p or (n if c else 0) for p, n, c in zip(planned, refits, cut, strict=True))
        )

    def plan(self, sources: Sequence[Source], options: CarryOptions) -> Plan:
        """The capacity of the cover before refits; notes list the losses of the cover and the secrets."""
        cover, *secrets = sources
        capacity, secret_sizes = capacity_for(cover.given, options, _PLANNED), _secret_sizes(secrets, options)
        sizes = capacity.sizes(secret_sizes)
        appended = capacity.appended(secret_sizes) if isinstance(capacity, PayloadCapacity) else 0
        notes = []
        if cover.given is not None and capacity.cover is not None and capacity.cover is not cover.given:
            psnr = psnr_between(cover.given, capacity.cover)
            notes.append(f"other harmonics leave the cover at {psnr:.1f} dB PSNR against itself")
        for index, (secret, (_, degree)) in enumerate(zip(secrets, sizes, strict=True)):
            if secret.given is not None and secret.given.sh_degree > degree:
                psnr = psnr_between(secret.given, secret.given.with_sh_degree(degree))
                notes.append(
                    f"the {role_of(index + 1, len(sources))} of SH degree {secret.given.sh_degree} gets "
                    f"degree {degree}: {psnr:.1f} dB PSNR against itself"
                )
        if appended:
            notes.append(
                f"about {appended:,} invisible Gaussians are appended to the cover's {capacity.gaussians:,}; "
                "fewer Gaussians or a lower SH degree of a secret take less"
            )
        elif isinstance(capacity, PayloadCapacity):
            how = "about" if capacity.prepared is None else "exactly"
            notes.append(
                f"the {capacity.channel.place} have room for {how} {capacity.payloads.bytes:,} bytes"
            )
        counts = [count for count, _ in sizes]
        rendered = (count if steps else 0 for steps, count in zip(options.refits, counts, strict=True))
        return Plan(
            gaussians=capacity.gaussians + appended,
            sh_degree=capacity.sh_degree,
            secret_gaussians=sum(secret.count for secret in secret_sizes),
            capacity=sum(counts),
            steps=max(options.refits),
            rendered=(0, *rendered),
            notes=tuple(notes),
        )

    def hide(
        self, cover: Source, secrets: Sequence[Source], options: CarryOptions, context: Context
    ) -> Stego:
        """Refit the secrets that need it, embed all, and open each again to check.

        Raises UsageError for a cover without capacity, Interrupted on Ctrl-C, and InputError for a
        checkpoint of another run.
        """
        capacity = capacity_for(cover.model, options, context.entropy)
        assert capacity.prepared is not None  # the cover is fitted
        plain = [secret.model for secret in secrets]
        viewpoints = [Viewpoints.of(secret.scene) for secret in secrets]
        models = list(plain)
        if any(options.refits):
            fitting = capacity.prune(plain, viewpoints)
            for index, (secret, steps, fits) in enumerate(zip(secrets, options.refits, fitting, strict=True)):
                if steps:
                    cut = len(fits) < len(secret.model)
                    models[index] = refit(
                        secret.model.with_sh_degree(fits.sh_degree),
                        secret.scene,
                        max(1, int(capacity.refit_share * len(fits))) if cut else len(fits),
                        replace(options.fit, iterations=steps),
                        context,
                        photos=secret.photos,
                        name=role_of(index + 1, len(secrets) + 1),
                    )
        details: dict[str, Any] = {"gaussians_before_pruning": [len(model) for model in plain]}
        if any(clamped := [out_of_range(model) for model in models]):
            details["gaussians_with_clamped_numbers"] = clamped
        stego = embed_models(
            capacity.prepared,
            [secret.key for secret in secrets],
            capacity.prune(models, viewpoints),
            viewpoints=viewpoints,
            entropy=context.entropy,
            overwrite=context.overwrites_cover,
        )
        return replace(stego, iterations=max(options.refits), details={**details, **stego.details})


def _secret_sizes(secrets: Sequence[Source], options: CarryOptions) -> list[SecretSize]:
    fits = options.fits(1 + len(secrets))[1:]
    return [
        SecretSize(fit.max_gaussians, fit.sh_degree) if secret.given is None else SecretSize.of(secret.given)
        for secret, fit in zip(secrets, fits, strict=True)
    ]


def _check_share(secrets: Sequence[SecretSize], sizes: Sequence[tuple[int, int]]) -> None:
    """Raise UsageError for given secrets that would lose most of their Gaussians."""
    for secret, (count, _) in zip(secrets, sizes, strict=True):
        if secret.model is not None and count < _MIN_SHARE * secret.count:
            raise UsageError(f"a secret of {secret.count:,} Gaussians would be cut down to {count:,}")


METHOD = CarryMethod()


def refit(
    secret: Gaussians,
    scene: Scene,
    count: int,
    fit: FitConfig,
    context: Context,
    *,
    photos: bool,
    name: str,
) -> Gaussians:
    """Fine-tune the `count` Gaussians of `secret` with the largest contributions.

    Raises Interrupted on Ctrl-C, InputError for a checkpoint of another run.
    """
    return fit_scene(
        scene,
        # A refit must not depend on the other secrets.
        replace(fit, seed=fit.seed_of(name)),
        model=most_contributing(secret, scene, count),
        rate=boost_of(fit) if photos else _MODEL_RATE,
        device=context.device,
        title=f"refit of the {name}",
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
    overwrite: bool = False,
) -> Stego:
    """Embed all Gaussians of each model under its key, and verify that they open.

    `viewpoints`: views of each model that determine the precision of a payload; by default, four around it.
    `overwrite`: write low bits into the cover's own tensors, which saves a copy. Raises UsageError if the
    models do not fit.
    """
    contents: Sequence[Content]
    if isinstance(cover, LowBitsCover):
        cover = replace(cover, overwrites=overwrite)
        contents = encode_all(cover, models)
        requests = [record_request(len(model), model.sh_degree) for model in models]
        details: dict[str, Any] = {
            "carriers": cover.cells.carriers,
            "capacity": cover.cells.record_capacity(requests),
        }
    else:
        contents = payloads = _payloads(cover, models, viewpoints or [*map(Viewpoints.around, models)])
        details = {
            "secret_bytes": [len(each.data) for each in payloads],
            "sh_degrees": [each.sh_degree for each in models],
        }
        if not cover.capacity.grows:
            details["capacity_bytes"] = cover.capacity.bytes
            details["capacity_bits_per_gaussian"] = round(8 * cover.capacity.bytes / len(cover.cover), 2)
    stego = cover.embed(list(zip(keys, contents, strict=True)), entropy=entropy)
    del contents  # as large as the secrets
    opened = [unpack(open_content(stego, key)) for key in keys]
    if [each.left for each in opened] != list(map(len, models)):
        raise RuntimeError("the embedded secrets do not open again as they should")
    details["bits_per_gaussian"] = [each.bits for each in opened]
    return Stego(stego, tuple(opened), details=details, verified=True)


def encode_all(cover: LowBitsCover, models: Sequence[Gaussians]) -> list[Records]:
    """The records of all models, at the best precision that fits. Raises UsageError if none does."""
    plans = cover.cells.plan_records([record_request(len(model), model.sh_degree) for model in models])
    found = []
    for model, plan in zip(models, plans, strict=True):
        table = Table.of_size(8 * plan.record_bytes, model.sh_degree)
        assert table is not None  # the plan has room for `Table.floor`
        codec, outlier = Codec.fit(model, table)
        header = COUNT.pack(len(model)) + codec.pack()
        copied = most_visible_rows(model, plan.copies)
        found.append(Records(CarryOptions.method, header, codec.encode(model, outlier), plan, copied))
    return found


def _payloads(
    cover: PreparedCover, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]
) -> list[Payload]:
    grows = cover.capacity.grows
    limits = shares(cover.capacity, [len(encode(model)) for model in models])
    return [
        Payload(CarryOptions.method, encode_to_size(model, limit, short=grows, viewpoints=views))
        for model, limit, views in zip(models, limits, viewpoints, strict=True)
    ]
