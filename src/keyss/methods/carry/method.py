"""The method `carry`: the secrets' Gaussians, encrypted in the published model."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from keyss.core.errors import KeyssWarning
from keyss.core.gaussians import Gaussians
from keyss.methods.base import Capabilities, Context, Source, Stego, role_of
from keyss.methods.carry.options import CarryOptions
from keyss.methods.carry.refit import MODEL_ITERATIONS, refitted
from keyss.methods.carry.room import RecordRoom, SecretRoom, Wanted, room_for
from keyss.methods.plan import Plan
from keyss.methods.records.embedding import Embedded
from keyss.methods.records.quantise import out_of_range
from keyss.rendering.difference import Viewpoints, psnr_between

_SMALLER = (
    "beside the others, secrets are left fewer Gaussians than each could have alone: who holds one of the "
    "keys can notice that there are other secrets"
)


class CarryMethod:
    """See `keyss.methods.base.Method`."""

    name = CarryOptions.method
    summary = "the secrets' Gaussians, encrypted in the cover's"
    most_secrets = 256
    capabilities = Capabilities()
    options = CarryOptions

    def prepare(self, sources: Sequence[Source], options: CarryOptions) -> CarryOptions:
        """Decides which secrets are refitted.

        Refuses a given cover without room, and given secrets that neither fit nor may be changed. Secrets
        that are fitted first are made to fit.
        """
        cover, *secrets = sources
        degree = options.sh_degree
        if degree is None:
            degree = options.fit.sh_degree if cover.given is None else cover.given.sh_degree
        options = options.with_fit(sh_degree=degree)
        if cover.given is None and options.place.records:  # whose low bits may not be random
            options = replace(options, dither=True)
        room, wanted = room_for(cover.given, options), _wanted(secrets, options)
        sizes = room.sizes(wanted)
        fits = [size == each.size for size, each in zip(sizes, wanted, strict=True)]
        if options.refit == "never" and not options.prune_to_fit:
            room.check(wanted)
        if options.refit == "always":
            fits = [False] * len(fits)
        elif options.refit == "never" or options.prune_to_fit:
            fits = [True] * len(fits)
        elif not all(fits) and sizes != [room.sizes([each])[0] for each in wanted]:
            warnings.warn(_SMALLER, KeyssWarning, stacklevel=2)
        steps = [
            options.iterations
            or (options.fit.iterations if each.photos else min(options.fit.iterations, MODEL_ITERATIONS))
            for each in secrets
        ]
        return replace(
            options, refits=tuple(0 if fit else each for fit, each in zip(fits, steps, strict=True))
        )

    def plan(self, sources: Sequence[Source], options: CarryOptions) -> Plan:
        """The room in the cover; notes tell what is lost of the cover and of harmonics."""
        cover, *secrets = sources
        room, wanted = room_for(cover.given, options), _wanted(secrets, options)
        sizes = room.sizes(wanted)
        found, notes = room.plan(wanted), []
        for index, (each, degree) in enumerate(
            zip(sources, [room.sh_degree, *(degree for _, degree in sizes)], strict=True)
        ):
            if each.given is not None and each.given.sh_degree > degree:
                psnr = psnr_between(each.given, each.given.with_sh_degree(degree))
                notes.append(
                    f"the {role_of(index, len(sources))} of SH degree {each.given.sh_degree} gets degree "
                    f"{degree}: {psnr:.1f} dB PSNR against itself"
                )
        if (changed := _dithered(room, cover.given)) is not None:
            notes.append(f"dithering leaves the cover at {changed:.1f} dB PSNR against itself")
        drawn = [count if steps else 0 for steps, (count, _) in zip(options.refits, sizes, strict=True)]
        return replace(
            found,
            steps=max(options.refits),
            drawn=(0, *drawn),
            notes=(*notes, *found.notes),
        )

    def hide(
        self, cover: Source, secrets: Sequence[Source], options: CarryOptions, context: Context
    ) -> Stego:
        """Refit the secrets that need it, embed all, and open each again as its reader will.

        Raises UsageError and InputError for a cover without room, Interrupted on Ctrl-C, and InputError for a
        checkpoint of another run.
        """
        room = room_for(cover.model, options, context.entropy)
        plain = [each.model for each in secrets]
        viewpoints = [Viewpoints.of(each.scene) for each in secrets]
        models = list(plain)
        if any(options.refits):
            sizes = room.refit_sizes(plain, viewpoints)
            for index, (secret, steps, (count, degree)) in enumerate(
                zip(secrets, options.refits, sizes, strict=True)
            ):
                if steps:
                    models[index] = refitted(
                        secret.model.with_sh_degree(degree),
                        secret.scene,
                        count,
                        replace(options.fit, iterations=steps),
                        context,
                        photos=secret.photos,
                        name=role_of(index + 1, len(secrets) + 1),
                    )
        embedded = room.embed([each.key for each in secrets], models, viewpoints, context.entropy)
        details = embedded.details | _losses(room, cover.model, plain, models, embedded)
        return Stego(
            embedded.stego,
            embedded.opened,
            max(options.refits),
            details,
            verified=True,
        )


def _wanted(secrets: Sequence[Source], options: CarryOptions) -> list[Wanted]:
    fits = options.fits(1 + len(secrets))[1:]
    return [
        Wanted(fit.max_gaussians, fit.sh_degree) if each.given is None else Wanted.of(each.given)
        for each, fit in zip(secrets, fits, strict=True)
    ]


def _dithered(room: SecretRoom, cover: Gaussians | None) -> float | None:
    """PSNR in dB of a cover that was changed before anything lies in it against the one that was given."""
    prepared = room.prepared if isinstance(room, RecordRoom) else None
    return (
        None
        if cover is None or prepared is None or prepared.cover is cover
        else psnr_between(cover, prepared.cover)
    )


def _losses(
    room: SecretRoom,
    cover: Gaussians,
    plain: Sequence[Gaussians],
    models: Sequence[Gaussians],
    found: Embedded,
) -> dict[str, Any]:
    """Numbers for metrics.json of what cover and secrets lost; `models`: after refits."""
    kept = [each.gaussians for each in found.opened]
    details: dict[str, Any] = {"gaussians_before_pruning": list(map(len, plain))}
    pairs = list(zip(models, kept, strict=True))
    if any(len(after) < len(before) for before, after in pairs):
        details["share_kept_by_pruning"] = [round(len(after) / len(before), 4) for before, after in pairs]
        details["pruned_secret_psnr_against_the_whole"] = [
            round(psnr_between(before, after), 1) if len(after) < len(before) else None
            for before, after in pairs
        ]
    fewer = [
        round(psnr_between(before, before.with_sh_degree(after.sh_degree)), 1)
        for before, after in zip((cover, *plain), (found.stego, *kept), strict=True)
        if before.sh_degree > after.sh_degree
    ]
    if fewer:
        details["psnr_of_fewer_harmonics"] = fewer
    if any(clamped := list(map(out_of_range, models))):
        details["gaussians_with_clamped_numbers"] = clamped
    if (changed := _dithered(room, cover)) is not None:
        details["dithered_cover_psnr_against_the_one_before"] = round(changed, 1)
    return details


METHOD = CarryMethod()
