"""Measures of a finished hiding for `compare` and `reproduce`, beside those of `hide` and `audit`.

Each is a function from a run to numbers by name. A string instead of a number is the reason why it is
missing, or a note on a replacement of a missing tool.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from statistics import fmean

from keyss.channels import is_appended
from keyss.core.arrays import Bytes
from keyss.core.errors import InputError, UsageError, import_extra
from keyss.core.gaussians import Gaussians
from keyss.core.picture_network import DecodedGaussians
from keyss.core.scene import Scene, ViewOptions
from keyss.files.models import read_model
from keyss.lab.audits import PARTS
from keyss.lab.audits.audit_run import EXTRA
from keyss.lab.robustness.changes import Change, opacity_pruning, purification, random_pruning
from keyss.lab.robustness.survival import converters, measure_robustness, own_converter, why_missing
from keyss.lab.sinkhorn import composite_score, sinkhorn_3d
from keyss.lab.speed import RenderTime, readers, render_time
from keyss.lab.stealth.judging import judge
from keyss.lab.stegexpose import stegexpose_auc
from keyss.lab.two_sample import two_sample_auc
from keyss.measure.image_scores import renders_of, select_views
from keyss.methods import registry
from keyss.rendering import Backend, resolve_device
from keyss.runs.files import HANDED, as_scene, stego_in
from keyss.runs.open_run import HidingRun

Numbers = dict[str, float | str]

PRUNED_SHARES = (0.05, 0.10, 0.15, 0.25)  # fractions of the Gaussians
_LOST = 0.25  # fraction of the Gaussians
_GIVEN_UP = 0.01  # fraction of the blending weight in the cover's views that purification removes
CONVERSIONS = {".spz": "gsply", "compressed .ply": "splat-transform"}  # format and the program that writes it
OWN = "our own"  # begins notes on replacements
_EVERY_VIEW = 10**6
_ROUNDS = 5  # repetitions when timing renders
_ROLES = ("cover", "secret")
_ATTRIBUTES = {"opacity": "op", "scale": "sc", "rotation": "ro", "position": "xyz", "colour": "sh"}


@dataclass(frozen=True)
class Subject:
    """A run, and data that its measures share."""

    run: HidingRun
    backend: Backend
    controls: tuple[Path, ...] = ()  # plain models of the cover: the run's seed, then other seeds

    @cached_property
    def scenes(self) -> list[Scene]:
        """The cover and the secrets, with their test views."""
        return self.run.scenes(train_pictures=False)

    @cached_property
    def stego(self) -> Gaussians:
        """The published model, on the device."""
        return self.run.stego.to(resolve_device(self.backend))

    @cached_property
    def models(self) -> list[Gaussians]:
        """The published model and the first secret, on the device."""
        return [self.stego, self.run.opened[0].reveal(self.stego).to(self.stego.device)]

    @property
    def standard(self) -> bool:
        """True if the published file is a 3DGS model."""
        return registry.get(self.run.config.method).capabilities.standard

    def times(self, models: Sequence[Gaussians]) -> dict[str, RenderTime]:
        """Render times of the cover and the first secret, also relative to plain 3DGS."""
        found = {}
        plains = self.run.plain_models()
        for role, model, plain, scene in zip(_ROLES, models, plains, self.scenes, strict=False):
            beside = model if plain is None else plain.to(model.device)
            found[role] = render_time(model, beside, scene, rounds=_ROUNDS)
        return found


def files(subject: Subject) -> Numbers:
    """Megabytes of the published and the handed-over files; number of programs that read the former."""
    published = stego_in(subject.run.folder)
    handed = (subject.run.folder / HANDED).glob("*")
    found: Numbers = {"published_mb": published.stat().st_size / 1e6}
    found["handed_mb"] = sum(path.stat().st_size for path in handed) / 1e6
    programs = readers(published)
    tried = [each for each in programs if each.loads is not None]
    if tried:
        found |= {"readers": len(tried), "readers that load": sum(each.loads is True for each in tried)}
    else:
        found["standard .ply"] = f"{OWN} reader only: {'; '.join(f'{each.note}' for each in programs)}"
    return found


def pictures(subject: Subject) -> Numbers:
    """Render times of the cover and the first secret, also relative to plain 3DGS."""
    found: Numbers = {}
    for role, each in subject.times(subject.models).items():
        found |= {f"{role}.ms": 1e3 * each.seconds, f"{role}.ratio": each.ratio}
    return found


def rendering(subject: Subject) -> Numbers:
    """Render times without appended Gaussians; 1 for a published 3DGS model, else 0."""
    stego, secret = subject.models
    found: Numbers = {"standard": float(subject.standard)}
    for role, each in subject.times([own_gaussians(stego), secret]).items():
        found |= {f"pictures/s, {role}": 1 / each.seconds, f"time over 3DGS, {role}": each.ratio}
    return found


def secrecy(subject: Subject) -> Numbers:
    """Detection of the published model, and of a plain one of its seed, among models of other seeds.

    Only renders are judged if no 3DGS model is published.
    """
    config = subject.run.config
    covers = _covers(subject.controls, config.cover or "", config.views, subject.backend)
    plain = {f"{name}_plain": value for name, value in covers.own.items()}
    return {**covers.judge(subject.stego, subject.standard), **plain}


def survival(subject: Subject) -> Numbers:
    """Changes in dB of cover and secret by pruning, conversion and purification; none for lost secrets."""
    changes, found = trials(subject.scenes[0]), own_converters()
    if not subject.standard:
        reason = "needs a 3DGS model, and this method publishes none"
        found = {name: reason for name in changes if name != "pruned"}
        changes = {"pruned": changes["pruned"]}
    cover, *others = subject.scenes
    whole = measure_robustness(
        subject.stego, subject.run.openers, cover, others, changes=list(changes.values())
    )
    for name, result in zip(changes, whole[1:], strict=True):
        if result.skipped is not None or result.cover is None:
            found[name] = result.skipped or "not measured"
            continue
        found[f"{name}.cover"] = -result.cover.loss
        if result.secrets[0].opens:
            found[f"{name}.secret"] = -result.secrets[0].loss
    return found


def trials(cover: Scene) -> dict[str, Change]:
    """Changes of `survival` by name; purification uses the cover's photos."""
    known = {(each.format, each.tool): each for each in converters()}
    conversions = {
        name: (own_converter(name) if why_missing(tool) else known[name, tool]).change()
        for name, tool in CONVERSIONS.items()
    }
    return {"pruned": random_pruning(_LOST), **conversions, "purified": purification(cover, _GIVEN_UP)}


def own_converters() -> Numbers:
    """Notes on conversions by keyss, because tools are missing."""
    missing = {name: why_missing(tool) for name, tool in CONVERSIONS.items()}
    return {name: f"{OWN} converter: {why}" for name, why in missing.items() if why}


def pruning(subject: Subject) -> Numbers:
    """PSNR in dB of the cover and the first secret after pruning; none for lost secrets."""
    kinds = {"by opacity": opacity_pruning, "random": random_pruning}
    named = {f"{share:.0%} {how}": kinds[how](share) for how in kinds for share in PRUNED_SHARES}
    cover, *others = subject.scenes
    changes = [spare_appended(each) for each in named.values()]
    results = measure_robustness(
        subject.stego, subject.run.openers, cover, others, changes=changes, max_views=_EVERY_VIEW
    )
    found: Numbers = {}
    for name, result in zip(["whole", *named], results, strict=True):
        for role, each in zip(_ROLES, (result.cover, *result.secrets), strict=False):
            if each is not None and each.opens:
                found[f"{name}, {role}"] = each.psnr
    return found


def sinkhorn(subject: Subject) -> Numbers:
    """3D-Sinkhorn from the cover's plain model to the published one: sum, attributes, composite score.

    Raises InputError without a plain model.
    """
    run = subject.run
    plain = run.plain_models()[0]
    if plain is None:
        raise InputError(f"{run.folder}: expected the plain model of the cover, found none")
    distances = sinkhorn_3d(plain, own_gaussians(run.stego))
    psnr = fmean(each.psnr for each in run.metrics.secrets)
    score = composite_score(run.metrics.cover.psnr, psnr, distances.sum)
    found: Numbers = {f"sinkhorn {short}": getattr(distances, name) for name, short in _ATTRIBUTES.items()}
    return found | {"sinkhorn": distances.sum, "score": score}


# Modules of optional packages that measures import.
_MODULES = {"secrecy": ("sklearn",), "sinkhorn": ("ot",), **dict.fromkeys(PARTS, EXTRA)}
MEASURES: Mapping[str, Callable[[Subject], Numbers]] = {
    each.__name__: each for each in (files, pictures, secrecy, survival, rendering, pruning, sinkhorn)
}


def check_extras(measures: Iterable[str]) -> None:
    """Raise BackendError if a package of one of the measures is not installed."""
    for name in measures:
        for module in _MODULES.get(name, ()):
            import_extra(module, "audit", f"measure {name}")


@dataclass(frozen=True)
class PlainCovers:
    """Plain models of the cover, to compare published ones with."""

    scene: Scene
    models: Sequence[Gaussians]  # at least three, on the device: the one to compare with, then controls

    def judge(self, model: Gaussians, standard: bool) -> dict[str, float]:
        """Compare a model with the controls; only its renders unless it is `standard`.

        Gives the mean AUC of trees that separate its Gaussians from the controls', the minimum p-value of its
        statistics (corrected for their number), and StegExpose's AUC on its renders.
        """
        controls, found = self.models[1:], {}
        if standard:
            found["stealth"] = judge(model, controls).least
            with suppress(UsageError):  # too few Gaussians, or all in a corner
                found["classifier"] = fmean(two_sample_auc(each, model, seed=0).auc for each in controls)
        pictures = stegexpose_auc(self.plain_pictures, self.pictures(model))
        return found | {"stegexpose": pictures.fused.auc}

    @cached_property
    def own(self) -> dict[str, float]:
        """The plain model against the controls."""
        return self.judge(self.models[0], True)

    @cached_property
    def plain_pictures(self) -> list[Bytes]:
        """Renders of the first control."""
        return self.pictures(self.models[1])

    def pictures(self, model: Gaussians) -> list[Bytes]:
        """Renders of a model for StegExpose."""
        views = select_views(self.scene.views)
        return [image.numpy() for _, image in renders_of(model, self.scene, views)]


@lru_cache(maxsize=1)  # cells of one process share them
def _covers(paths: tuple[Path, ...], cover: str, views: ViewOptions, backend: Backend) -> PlainCovers:
    scene = as_scene(cover, views)
    return PlainCovers(scene, [read_model(path).to(resolve_device(backend)) for path in paths])


def own_gaussians(stego: Gaussians) -> Gaussians:
    """A published model without appended Gaussians."""
    return stego if isinstance(stego, DecodedGaussians) else stego[~is_appended(stego)]


def spare_appended(change: Change) -> Change:
    """The change without appended Gaussians."""

    def apply(model: Gaussians) -> Gaussians:
        if isinstance(model, DecodedGaussians) or not bool(is_appended(model).any()):
            return change(model)
        return Gaussians.cat([change(own_gaussians(model)), model[is_appended(model)]])

    return replace(change, apply=apply)
