"""The parts of an audit. Each compares a run with baselines and controls, judges it and describes the result.

Entry in `PARTS` is all that a new part needs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import combinations
from statistics import fmean
from typing import Any

import msgspec
import torch

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.image_metrics import mean_quality, view_quality
from keyss.lab.auc import Auc
from keyss.lab.audits.record import Section, Table, Verdict, Word, auc_text, text_of
from keyss.lab.audits.subject import Subject
from keyss.lab.distances import AttributeDistance, Sinkhorn3D, against_controls, composite_score, sinkhorn_3d
from keyss.lab.leaks.attacks import decoder_attack, file_attacks
from keyss.lab.leaks.leak_scores import GRADIENT_LIMIT, PSNR_LIMIT, SSIM_LIMIT, AttackResult, look_for_secret
from keyss.lab.render_time import RenderTime, measure_render_time
from keyss.lab.robustness.survival import ChangeResult, measure_robustness
from keyss.lab.stealth.judging import StealthResult, judge
from keyss.lab.stegexpose import stegexpose_auc
from keyss.lab.two_sample import two_sample_auc
from keyss.measure.hide_quality import WrongKeys
from keyss.measure.renders import contact_sheet, renders_of, select_views
from keyss.methods.method import role_of
from keyss.progress import Share

QUALITY_LOSS = 1.0  # dB of cover or secret below the plain model of the same scene
INVISIBLE = 45.0  # dB: a higher PSNR makes no visible difference
WRONG_KEY = 1.0  # dB above chance level
UNUSUAL = 0.01  # p, corrected for the number of statistics
DISTANCE_RATIO = 1.5  # distance from controls / distance between controls
TWO_SAMPLE_AUC = 0.6  # classifier between the Gaussians of two models
TOLERANCE = 0.01  # of a measure above that of the cover's own plain model
IMAGE_AUC = 0.1  # distance of StegExpose's AUC from 0.5
PRUNING, PRUNED = "random pruning", 0.25  # the attack, and its share of the Gaussians
PRUNING_LOSS = 1.5  # dB that the secret may lose more than the cover
_PICTURED_VIEWS, _LISTED = 3, 15

Pictures = dict[str, bytes]  # PNG files by caption


def images(subject: Subject, seed: int, share: Share) -> tuple[Section, Pictures]:
    """Compare cover and secrets with the test views, beside plain models."""
    verdicts, rows, pictures = [], [], {}
    numbers: dict[str, Any] = {}
    for index, (scene, model, plain) in enumerate(subject.shown):
        share(index / len(subject.scenes))
        name, photos = role_of(index, len(subject.scenes)), subject.run.metrics.photos[index]
        columns = {"photo" if photos else "given model": [view.image.numpy() for view in scene.test]}
        models = {"revealed" if index else "published model": model, "plain model": plain}
        psnrs = []
        for column, shown in models.items():
            if shown is not None:
                columns[column] = _renders(shown, scene)
                pairs = zip(columns[column], scene.test, strict=True)
                views = {
                    view.camera.name: view_quality(torch.from_numpy(image) / 255, view)
                    for image, view in pairs
                }
                mean = mean_quality(list(views.values()))
                psnrs.append(mean.psnr)
                numbers[f"{name}, {column}"] = asdict(mean) | {"views": _builtins(views)}
                texts = f"{mean.psnr:.2f}", f"{mean.ssim:.4f}", text_of(mean.lpips, ".4f"), f"{len(shown):,}"
                rows.append((f"{name}, {column}", *texts))
        if index:
            columns["without the key"] = _renders(subject.stego, subject.in_cover[index - 1])
        pictured = range(len(scene.test))[:: -(-len(scene.test) // _PICTURED_VIEWS)]
        by_view = {
            scene.test[view].camera.name: [images[view] for images in columns.values()] for view in pictured
        }
        pictures[name] = contact_sheet(list(columns), by_view, cell=300)
        if len(psnrs) == 2:
            where = f"{name} on {'test photos' if photos else 'renders of its model'}"
            baseline = subject.run.metrics.baseline
            word: Word = "missed" if index else "visible"
            steps = None if baseline.equal[index] else baseline.steps[index]
            verdicts.append(quality_verdict(where, psnrs[0], psnrs[1], word, steps))
    metrics = subject.run.metrics
    if metrics.wrong_key is not None:
        verdicts += wrong_key_verdicts(metrics.wrong_key, metrics.chance_level)
    table = Table(("", "PSNR, dB", "SSIM", "LPIPS, AlexNet", "Gaussians"), tuple(rows))
    return Section(verdicts=verdicts, tables=[table], numbers=numbers), pictures


def _renders(model: Gaussians, scene: Scene) -> list[Any]:
    """[H, W, 3] uint8 renders from the test cameras of a scene."""
    renders = renders_of(model, [view.camera for view in scene.test], scene.background)
    return [image.numpy() for _, image in renders]


def quality_verdict(
    measure: str, psnr: float, plain: float, otherwise: Word, steps: int | None = None
) -> Verdict:
    """PSNRs of a scene and its plain model, in dB. `steps`: of a plain model with fewer than the scene."""
    limit = min(plain - QUALITY_LOSS, INVISIBLE)
    model = "plain model" if steps is None else f"plain model of only {steps:,} steps"
    value, beside, least = f"{psnr:.2f} dB", f"{plain:.2f} dB, {model}", f"at least {limit:.2f} dB"
    return Verdict(measure, value, beside, least, "fine" if psnr >= limit else otherwise)


def wrong_key_verdicts(wrong: WrongKeys, chance_level: Sequence[float]) -> list[Verdict]:
    """What wrong keys show of each secret, beside the stego model itself (chance level); in dB."""
    verdicts = []
    for index, (psnr, chance) in enumerate(zip(wrong.vs_secrets, chance_level, strict=False), start=1):
        measure, value = f"wrong keys, {role_of(index, len(chance_level) + 1)}", f"{psnr.max:.2f} dB"
        beside, limit = f"{chance:.2f} dB, chance level", f"at most {chance + WRONG_KEY:.2f} dB"
        word: Word = "fine" if psnr.max <= chance + WRONG_KEY else "visible"
        verdicts.append(Verdict(measure, f"{value}, best of {wrong.keys:,}", beside, limit, word))
    return verdicts


def parameters(subject: Subject, seed: int, share: Share) -> tuple[Section, Pictures]:
    """Distances of the parameters from plain models: published 3D-Sinkhorn, Wasserstein, a classifier."""
    original, stego, controls = subject.original, subject.stego, subject.controls
    sinkhorn, score = published_distance(subject, stego)
    between = [sinkhorn_3d(original, control) for control in controls]
    share(1 / 3)
    distances = against_controls(stego, controls, original=original, seed=seed)
    share(2 / 3)
    auc = partial(two_sample_auc, seed=seed)
    aucs = {
        "published model": [auc(control, stego) for control in controls],
        "between controls": [auc(*pair) for pair in combinations(controls, 2)],
        "plain model": [auc(control, original) for control in controls],
    }
    heads = ("Wasserstein distance", "published", "between controls", "ratio", "ratio of the plain model")
    distance_rows = [
        (name, *(text_of(value, ".3g") for value in (one.distance, one.control, one.ratio, one.original)))
        for name, one in distances.items()
    ]
    means = {name: fmean(control[name] for control in map(asdict, between)) for name in asdict(sinkhorn)}
    sinkhorn_rows = [(name, f"{one:.4f}", f"{means[name]:.4f}") for name, one in asdict(sinkhorn).items()]
    sinkhorn_rows.append(("composite score (eq. 10)", f"{score:.2f}", "–"))
    auc_rows = [(name, ", ".join(map(auc_text, values))) for name, values in aucs.items()]
    tables = [
        Table(heads, tuple(distance_rows)),
        Table(("classifier", "AUC, with 95 % interval"), tuple(auc_rows)),
        Table(("3D-Sinkhorn", "published model", "controls, mean"), tuple(sinkhorn_rows)),
    ]
    numbers = {"sinkhorn": sinkhorn, "sinkhorn_controls": between, "score": score}
    numbers |= {"distances": distances, "two_sample": aucs}
    verdicts = [*distance_verdicts(distances), two_sample_verdict(*aucs.values())]
    return Section(verdicts=verdicts, tables=tables, numbers=_builtins(numbers)), {}


def published_distance(subject: Subject, stego: Gaussians) -> tuple[Sinkhorn3D, float]:
    """3D-Sinkhorn from the cover's plain model to `stego`, and the composite score."""
    distance, metrics = sinkhorn_3d(subject.original, stego), subject.run.metrics
    secret = fmean(secret.psnr for secret in metrics.secrets)
    return distance, composite_score(metrics.cover.psnr, secret, distance.sum)


def distance_verdicts(distances: Mapping[str, AttributeDistance]) -> list[Verdict]:
    """The attribute that is furthest from its limit; none if no distance has a ratio."""
    limits = {
        name: max(DISTANCE_RATIO, (1 + TOLERANCE) * (distance.original or 0.0))
        for name, distance in distances.items()
    }
    ratios = {name: distance.ratio for name, distance in distances.items() if distance.ratio is not None}
    if not ratios:
        return []
    name = max(ratios, key=lambda name: ratios[name] / limits[name])
    value, limit = f"{name} {ratios[name]:.2f}×", f"at most {limits[name]:.2f}×"
    beside = f"{text_of(distances[name].original, '.2f')}×, plain model; 1×, between controls"
    word: Word = "fine" if ratios[name] <= limits[name] else "visible"
    return [Verdict("attributes of the Gaussians", value, beside, limit, word)]


def two_sample_verdict(stego: Sequence[Auc], control: Sequence[Auc], original: Sequence[Auc]) -> Verdict:
    """The best of the classifiers."""
    best, between, plain = (
        max((auc.auc for auc in aucs), default=0.0) for aucs in (stego, control, original)
    )
    limit = max(TWO_SAMPLE_AUC, plain + TOLERANCE)
    beside = f"{plain:.2f}, plain model; {between:.2f}, between controls"
    word: Word = "fine" if best <= limit else "visible"
    return Verdict("classifier between models", f"AUC {best:.2f}", beside, f"at most {limit:.2f}", word)


def stealth(subject: Subject, seed: int, share: Share) -> tuple[Section, Pictures]:
    """Compare statistics of the file with plain models."""
    result = judge(subject.stego, subject.controls, original=subject.original)
    heads = ("least likely statistics", "file", "controls, minimum", "maximum", "p", "p without controls")
    rows = [
        (one.name, *(text_of(value, ".3g") for value in (one.value, one.low, one.high, one.p, one.exact)))
        for one in result.statistics[:_LISTED]
    ]
    rows.append(("groups of invisible Gaussians, one per secret", str(result.invisible_groups)))
    rows.append(("share of Gaussians with changed low bits", f"{result.changed_low_bits:.2f}"))
    verdicts = stealth_verdicts(result)
    return Section(verdicts=verdicts, tables=[Table(heads, tuple(rows))], numbers=_builtins(result)), {}


def stealth_verdicts(result: StealthResult) -> list[Verdict]:
    """The least likely statistic, if there are any; inconclusive if plain models fail as well."""
    if not result.statistics:
        return []
    word: Word = "fine" if result.least >= UNUSUAL else "visible"
    if min(result.least_of_controls, result.least_of_original) < UNUSUAL:
        word = "inconclusive"
    value = f"p = {result.least:.3g} ({result.statistics[0].name})"
    beside = f"{result.least_of_original:.3g}, plain model; {result.least_of_controls:.3g}, between controls"
    return [Verdict("the file by itself", value, beside, f"at least {UNUSUAL}", word)]


def stegexpose(subject: Subject, seed: int, share: Share) -> tuple[Section, Pictures]:
    """StegExpose on renders of the stego model and of plain models."""
    stego, control = stegexpose_aucs(subject, [subject.stego, subject.controls[1]])
    verdicts = [stegexpose_verdict(stego, control)]
    return Section(verdicts=verdicts, numbers=_builtins({"stego": stego, "control": control})), {}


def stegexpose_verdict(stego: Auc, control: Auc) -> Verdict:
    """The AUC on renders of the stego model, beside that between controls."""
    excess = abs(stego.auc - 0.5) - abs(control.auc - 0.5)
    word: Word = "fine" if stego.low <= 0.5 <= stego.high or excess <= IMAGE_AUC else "visible"
    limit = f"at most {IMAGE_AUC} further from 0.5, or 0.5 in the interval"
    beside = f"{auc_text(control)}, between controls"
    return Verdict("StegExpose on renders", f"AUC {auc_text(stego)}", beside, limit, word)


def stegexpose_aucs(subject: Subject, models: Sequence[Gaussians]) -> list[Auc]:
    """AUCs of StegExpose between renders of the first control and of each of the models."""
    cover = subject.scenes[0]
    cameras = [view.camera for view in select_views(cover.views)]
    plain, *others = (
        [image.numpy() for _, image in renders_of(model, cameras, cover.background)]
        for model in (subject.controls[0], *models)
    )
    return [stegexpose_auc(plain, renders) for renders in others]


def leaks(subject: Subject, seed: int, share: Share) -> tuple[Section, Pictures]:
    """Attacks without the key on each secret, with the file or with its decoder."""
    heads = ("PSNR, dB (leak)", "SSIM (leak)", "gradients (leak)", "variant", "what it does")
    tables, results, pictures = [], {}, {}
    for index, (secret, opened) in enumerate(zip(subject.in_cover, subject.run.opened, strict=True), start=1):
        share((index - 1) / len(subject.in_cover))
        attacks = file_attacks(subject.scenes[0], seed=seed)
        if opened.decode is not None:
            attacks.append(decoder_attack(opened.decode, opened.key_size, seed=seed))
        name = role_of(index, len(subject.scenes))
        results[name], shown = look_for_secret(subject.stego, subject.controls, secret, attacks)
        tables.append(Table((f"attack on the {name}", *heads), tuple(map(_leak_row, results[name]))))
        pictures[name] = contact_sheet(("published model", "plain model", "the secret"), shown)
    verdicts = leak_verdicts(results)
    return Section(verdicts=verdicts, tables=tables, numbers=_builtins(results)), pictures


def _leak_row(attack: AttackResult) -> tuple[str, ...]:
    scores, leak = attack.scores, attack.leak
    return (
        attack.attack,
        f"{scores.psnr_fitted:.2f} ({leak.psnr_fitted:+z.2f})",
        f"{scores.ssim_fitted:.3f} ({leak.ssim_fitted:+z.3f})",
        f"{scores.gradient:.3f} ({leak.gradient:+z.3f})",
        attack.best,
        attack.sentence,
    )


def leak_verdicts(results: Mapping[str, Sequence[AttackResult]]) -> list[Verdict]:
    """The attack without the key that shows most of a secret; `results`: attacks by secret."""
    attacks = [(name, attack) for name, rows in results.items() for attack in rows]
    if not attacks:
        return []
    name, attack = max(attacks, key=lambda item: item[1].leak.evidence())
    leak, where = attack.leak, f"{name}, {attack.attack}: {attack.best}"
    value = f"{leak.psnr_fitted:+z.2f} dB, {leak.ssim_fitted:+z.3f} SSIM, {leak.gradient:+z.2f} gradients"
    limit = f"at most {PSNR_LIMIT} dB, {SSIM_LIMIT} and {GRADIENT_LIMIT}"
    word: Word = "fine" if leak.evidence() <= 1 else "visible"
    return [Verdict("leaks without the key", f"{value} ({where})", "0, plain models", limit, word)]


def robustness(subject: Subject, seed: int, share: Share) -> tuple[Section, Pictures]:
    """PSNR loss of the cover and the secrets when the stego model changes."""
    openers, scenes = subject.run.openers, subject.scenes
    results = measure_robustness(subject.stego, openers, scenes, seed=seed, share=share)
    names = [f"{role_of(index, len(scenes))}, dB" for index in range(len(scenes))]
    table = Table(("change", *names), tuple(map(_change_row, results)))
    numbers = {"changes": _builtins(results)}
    return Section(verdicts=pruning_verdicts(results), tables=[table], numbers=numbers), {}


def _change_row(result: ChangeResult) -> tuple[str, ...]:
    if result.cover is None:
        return result.sentence, f"not tried: {result.skipped}"
    cells = [
        f"{quality.psnr:.2f} ({-quality.loss:+z.2f})" if quality.opens else "does not open"
        for quality in (result.cover, *result.secrets)
    ]
    repeated = f" Mean over {result.seeds} seeds." if result.seeds > 1 else ""
    return f"{result.sentence}{repeated}", *cells


def pruning_verdicts(results: Sequence[ChangeResult]) -> list[Verdict]:
    """Random loss of a quarter of the Gaussians, if it was tried."""
    verdicts = []
    for result in results:
        if (result.attack, result.strength) == (PRUNING, PRUNED) and result.cover and result.secrets:
            opens = all(secret.opens for secret in result.secrets)
            loss, limit = max(secret.loss for secret in result.secrets), result.cover.loss + PRUNING_LOSS
            value = f"secret {-loss:+z.2f} dB" if opens else "the secret does not open"
            beside, most = f"cover {-result.cover.loss:+z.2f} dB", f"at most {PRUNING_LOSS} dB more"
            word: Word = "fine" if opens and loss <= limit else "missed"
            measure = f"loss of a random {PRUNED:.0%} of the Gaussians"
            verdicts.append(Verdict(measure, value, beside, most, word))
    return verdicts


def speed(subject: Subject, seed: int, share: Share) -> tuple[Section, Pictures]:
    """Rendering times of the stego model and of the revealed secrets."""
    times = render_times(subject, subject.stego)
    names = ["published model", *(role_of(index, len(times)) for index in range(1, len(times)))]
    rows = [
        (name, f"{time.seconds:.3g}", f"{time.ratio:.2f}") for name, time in zip(names, times, strict=True)
    ]
    table = Table(("model", "seconds per render", "time over a plain model"), tuple(rows))
    return Section(tables=[table], numbers=_builtins(dict(zip(names, times, strict=True)))), {}


def render_times(subject: Subject, stego: Gaussians, *, rounds: int = 15) -> list[RenderTime]:
    """The render times of `stego` and of the revealed secrets; without a plain model, beside themselves."""
    (cover, _, original), *secrets = subject.shown
    return [
        measure_render_time(model, model if plain is None else plain, scene, rounds=rounds)
        for scene, model, plain in [(cover, stego, original), *secrets]
    ]


def _builtins(result: Any) -> Any:
    """JSON of dataclasses; numbers that are not finite become null."""
    return msgspec.json.decode(msgspec.json.encode(result))


@dataclass(frozen=True)
class Part:
    """An entry of the table of parts."""

    title: str
    note: str  # what its numbers mean
    measure: Callable[[Subject, int, Share], tuple[Section, Pictures]]
    views: int  # takes about as long as measuring so many test views: see `Subject.view_seconds`
    only_3dgs: bool = True  # needs a published 3DGS model


PARTS = {
    "images": Part(
        "Test views",
        "Of 8-bit pictures. PSNR and SSIM: higher is better; LPIPS: lower is better. The baseline is plain "
        "3DGS of the same scene, with as many training steps if the run was made with --bound. A wrong key "
        "should show no more of the secret than the published model itself does (chance level).",
        images,
        48,
        only_3dgs=False,
    ),
    "parameters": Part(
        "Gaussians beside those of plain models",
        "Distances in units of the cover's range; a ratio of 1 is another training seed. The classifier "
        "needs a plain model of the same scene, which an observer rarely has; an AUC of 0.5 is guessing. "
        "3D-Sinkhorn is for comparison with the paper and gets no verdict: it does not change if scales "
        "are doubled or colours swapped.",
        parameters,
        300,
    ),
    "stealth": Part(
        "The file by itself",
        "Low bits, equal numbers, opacities and the order of rows, beside plain models of the cover from "
        "other seeds. p is the probability that another such model is as unusual. Where a plain model, "
        "such as a given cover of another trainer, is unusual too, p says nothing about the secret. An "
        "observer with plain models of other scenes can train detectors: `benchmarks/stealth.py`.",
        stealth,
        150,
    ),
    "stegexpose": Part(
        "StegExpose on renders",
        "It looks for replaced low bits of 8-bit pixels, but a renderer computes each pixel: 0.5 is "
        "expected whatever the model hides.",
        stegexpose,
        60,
        only_3dgs=False,
    ),
    "leaks": Part(
        "Leaks without the key",
        "Attacks on the published file, scored against the secret's test views after a fit of colours. In "
        "brackets: the difference from the same attack on plain models; 0 shows nothing of the secret.",
        leaks,
        200,
    ),
    "robustness": Part(
        "Robustness",
        "PSNR on test views after a change of the published model; in brackets, the change.",
        robustness,
        1200,
    ),
    "speed": Part("Speed", "Both models are rendered in turn.", speed, 32, only_3dgs=False),
}
