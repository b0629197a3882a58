"""The numbers of a run, under the names by which the paper's figures stand beside them.

The paper hands its decoder over apart from the model. Here it lies in the model's low bits or, where it finds
no room there, in appended Gaussians, which are left out of what is measured and never pruned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from statistics import fmean

from keyss.channels.appended import is_appended
from keyss.core.decoded import DecodedGaussians
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.measure.robustness.changes import Change, opacity_pruning, random_pruning
from keyss.measure.robustness.survival import robustness
from keyss.measure.sinkhorn import composite_score, sinkhorn_3d
from keyss.measure.speed import render_time
from keyss.methods import registry
from keyss.rendering import Backend, resolve_device
from keyss.reproduction.tables import PRUNED, Measure, pruned
from keyss.runs.opening import HidingRun

Numbers = dict[str, float]

_ATTRIBUTES = {"opacity": "op", "scale": "sc", "rotation": "ro", "position": "xyz", "colour": "sh"}
_EVERY_VIEW = 10**6
_ROUNDS = 5  # of timing pictures


def quality(run: HidingRun, device: Backend) -> Numbers:
    """PSNR in dB of the cover and of all secrets, and what wrong keys show: means over 32 of them."""
    metrics = run.metrics
    secrets = [each.psnr for each in metrics.secrets]
    found = {f"secret {number}": psnr for number, psnr in enumerate(secrets, 1)}
    found |= {"cover": metrics.cover.psnr, "secret": fmean(secrets)}
    found["mean of both"] = (found["cover"] + found["secret"]) / 2
    if (wrong := metrics.wrong_key) is not None:
        # The decoder of the first secret, as in the paper's tables.
        found |= {"wrong key, cover": wrong.vs_cover.mean, "wrong key, secret": wrong.vs_secrets[0].mean}
    return found


def sinkhorn(run: HidingRun, device: Backend) -> Numbers:
    """3D-Sinkhorn from the cover's plain model to the published one: sum, attributes, composite score.

    Raises InputError for a run without that plain model.
    """
    plain = run.plain_models()[0]
    if plain is None:
        raise InputError(f"{run.folder}: expected the plain model of the cover, found none")
    distances = sinkhorn_3d(plain, _own(run.stego))
    found = {f"sinkhorn {short}": getattr(distances, name) for name, short in _ATTRIBUTES.items()}
    psnr = fmean(each.psnr for each in run.metrics.secrets)
    score = composite_score(run.metrics.cover.psnr, psnr, distances.sum)
    return found | {"sinkhorn": distances.sum, "score": score}


def pruning(run: HidingRun, device: Backend) -> Numbers:
    """PSNR in dB of the cover and the first secret after pruning; what does not open any more is left out."""
    kinds = {"by opacity": opacity_pruning, "random": random_pruning}
    named = [(how, share) for how in kinds for share in PRUNED]
    scenes = run.scenes(train_pictures=False)
    whole, *results = robustness(
        run.stego.to(resolve_device(device)),
        run.reopeners,
        scenes[0],
        scenes[1:],
        changes=[_sparing(kinds[how](share)) for how, share in named],
        views=_EVERY_VIEW,
    )
    found: Numbers = {}
    for name, result in zip([None, *named], [whole, *results], strict=True):
        for scene, each in (("cover", result.cover), ("secret", next(iter(result.secrets), None))):
            if each is not None and each.opens:
                found[f"whole, {scene}" if name is None else pruned(*name, scene)] = each.psnr
    return found


def speed(run: HidingRun, device: Backend) -> Numbers:
    """Pictures a second, time of a picture over that of plain 3DGS, and whether a 3DGS model is published."""
    target = resolve_device(device)
    stego = run.stego.to(target)
    models = [_own(stego), run.opened[0].reveal(stego).to(target)]
    found = {"standard": float(registry.get(run.config.method).capabilities.standard)}
    scenes = run.scenes(train_pictures=False)[:2]
    for role, model, plain, scene in zip(
        ("cover", "secret"), models, run.plain_models(), scenes, strict=False
    ):
        times = render_time(role, model, model if plain is None else plain.to(target), scene, rounds=_ROUNDS)
        found |= {f"pictures/s, {role}": 1 / times.seconds, f"time over 3DGS, {role}": times.ratio}
    return found


def _own(stego: Gaussians) -> Gaussians:
    """Without what is appended."""
    return stego if isinstance(stego, DecodedGaussians) else stego[~is_appended(stego)]


def _sparing(change: Change) -> Change:
    """The same change of all but what is appended."""

    def apply(model: Gaussians) -> Gaussians:
        if isinstance(model, DecodedGaussians) or not bool(is_appended(model).any()):
            return change(model)
        return Gaussians.cat([change(_own(model)), model[is_appended(model)]])

    return replace(change, apply=apply)


MEASURES: Mapping[Measure, Callable[[HidingRun, Backend], Numbers]] = {
    "quality": quality,
    "sinkhorn": sinkhorn,
    "pruning": pruning,
    "speed": speed,
}
