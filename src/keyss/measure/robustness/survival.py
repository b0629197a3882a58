"""What changes of a published model cost its cover and its secrets, and which of them dies first."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from statistics import mean
from typing import Any

from keyss.core.errors import BackendError, KeyssError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity
from keyss.fitting.image_metrics import quality, subsample_views
from keyss.measure.robustness import changes as change
from keyss.measure.robustness.changes import Change
from keyss.measure.robustness.conversions import converters
from keyss.measure.robustness.reopening import Reopen
from keyss.measure.robustness.retraining import fine_tuning, purification

PRUNED = (0.05, 0.10, 0.15, 0.25, 0.50)
NOISE = (0.001, 0.01, 0.1)
DRAWS = 3  # of what is removed at random: which Gaussians they are makes a difference of a dB or two
DEAD = 6.0  # dB: four times the squared error
UNCHANGED = "none"


def default_changes(
    cover: Scene, *, seed: int = 0, purify_steps: int = 300, tune_steps: int = 500, sog_iterations: int = 1
) -> list[Change]:
    """All changes, those of an attack one after another, the mildest first.

    `cover`: its training photos serve those who train on; so many steps. `sog_iterations`: see `converters`.
    """
    return [
        *(change.random_pruning(share, seed + draw) for share in PRUNED for draw in range(DRAWS)),
        *(change.opacity_pruning(share) for share in PRUNED),
        *(change.cropping(seed + draw) for draw in range(DRAWS)),
        *(change.fewer_harmonics(degree) for degree in (2, 1, 0)),
        change.half_floats(),
        *(change.noise(attribute, strength, seed) for attribute in change.NOISY for strength in NOISE),
        *(converter.change() for converter in converters(sog_iterations)),
        *(purification(cover, given_up, purify_steps, seed) for given_up in (0.0, 0.01)),
        fine_tuning(cover, tune_steps, seed),
    ]


def robustness(
    stego: Gaussians,
    reopen: Sequence[Reopen],  # one for each secret: a `Reopener`, or another method's
    cover: Scene,
    secrets: Sequence[Scene],
    *,
    changes: Sequence[Change] | None = None,
    views: int = 8,
    seed: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[dict[str, Any]]:
    """PSNR and SSIM of cover and secrets against test photos after each of the `changes`, and the losses.

    The first row is the unchanged model, from which losses are counted (dB of PSNR). In each row "secrets"
    has for each secret whether it still "opens", and if not, the "error"; then its quality is the floor, what
    a person has without it: the changed model itself, as seen from the secret's cameras. A row whose tool is
    missing says so in "skipped" and has no qualities. `changes`: `default_changes` by default, about 50.
    `views`: at most so many test views of each scene. `progress`: called with rows done, rows in all, and the
    next row's name. Drawn on the device of `stego`. JSON-able; the same seed gives the same numbers.
    Raises UsageError unless each secret can be reopened, and the KeyssError of one that does not open in the
    unchanged model.
    """
    if len(reopen) != len(secrets):
        raise UsageError(
            f"expected one way to reopen for each of {len(secrets)} secret(s), got {len(reopen)}"
        )
    changes = default_changes(cover, seed=seed) if changes is None else changes
    same = Change(UNCHANGED, 0, "", "Nothing is changed.", lambda model: model)
    frames = [each(stego).frame for each in reopen]
    rows: list[dict[str, Any]] = []
    for number, each in enumerate([same, *changes]):
        if progress is not None:
            progress(number, len(changes) + 1, f"{each.attack} {each.strength:g} {each.unit}".strip())
        row: dict[str, Any] = {
            "attack": each.attack,
            "strength": each.strength,
            "unit": each.unit,
            "sentence": each.sentence,
            "seed": each.seed,
        }
        rows.append(row)
        try:
            changed = each(stego)
        except BackendError as error:
            row["skipped"] = f"{error}"
            continue
        row["gaussians"] = len(changed)
        row["cover"] = _quality(changed, cover, views)
        row["secrets"] = [
            _secret(changed, *parts, views) for parts in zip(reopen, frames, secrets, strict=True)
        ]
        for now, before in zip(
            [row["cover"], *row["secrets"]], [rows[0]["cover"], *rows[0]["secrets"]], strict=True
        ):
            now["loss"] = before["psnr"] - now["psnr"]
    if progress is not None:
        progress(len(rows), len(rows), "")
    return rows


def verdicts(rows: Sequence[dict[str, Any]], dead: float = DEAD) -> list[dict[str, Any]]:
    """For each attack among `rows` its curve of losses, and whether the secret dies later than the cover.

    "curve": [strength, loss of the cover, loss of the secret] in dB, for the attack's strengths in their
    order; means over rows of one strength, and of several secrets the one that loses most counts. A scene is
    dead at a strength if it has lost `dead` dB or more, and a secret also if it did not open in one of the
    rows. "secret_dies_at", "cover_dies_at": the first strength at which that is so, None if never. "verdict"
    tells who is dead at the first strength at which any is: "later" the cover alone, "sooner" the secret
    alone, "together" both; "neither" if there is none. "excess": by how many dB more the secret loses than
    the cover, at most, at strengths at which the cover lives; None if there is none.
    """
    attacks: dict[str, dict[float, list[dict[str, Any]]]] = {}
    for row in rows:
        if row["attack"] != UNCHANGED and "skipped" not in row:
            attacks.setdefault(row["attack"], {}).setdefault(row["strength"], []).append(row)
    return [_verdict(attack, own, dead) for attack, own in attacks.items()]


def _verdict(attack: str, rows: Mapping[float, Sequence[dict[str, Any]]], dead: float) -> dict[str, Any]:
    curve, cover_dead, secret_dead = [], [], []
    for strength, same in rows.items():
        cover = mean(row["cover"]["loss"] for row in same)
        secret = mean(max(each["loss"] for each in row["secrets"]) for row in same)
        opens = all(each["opens"] for row in same for each in row["secrets"])
        curve.append([strength, cover, secret])
        cover_dead.append(cover >= dead)
        secret_dead.append(secret >= dead or not opens)
    return {
        "attack": attack,
        "unit": next(iter(rows.values()))[0]["unit"],
        "curve": curve,
        "secret_dies_at": _first(curve, secret_dead),
        "cover_dies_at": _first(curve, cover_dead),
        "excess": max((secret - cover for _, cover, secret in curve if cover < dead), default=None),
        "verdict": _who_first(secret_dead, cover_dead),
    }


def _first(curve: Sequence[Sequence[float]], flags: Sequence[bool]) -> float | None:
    return next((strength for (strength, _, _), flag in zip(curve, flags, strict=True) if flag), None)


def _who_first(secret: Sequence[bool], cover: Sequence[bool]) -> str:
    for secret_dead, cover_dead in zip(secret, cover, strict=True):
        if secret_dead and cover_dead:
            return "together"
        if secret_dead or cover_dead:
            return "sooner" if secret_dead else "later"
    return "neither"


def _secret(
    changed: Gaussians, reopen: Reopen, frame: Similarity, scene: Scene, views: int
) -> dict[str, Any]:
    try:
        revealed = reopen(changed).gaussians.to(changed.device)
        return {**_quality(revealed, scene, views), "opens": True}
    except KeyssError as error:
        shown = frame.inverse().apply_gaussians(changed.to("cpu")).to(changed.device)
        return {**_quality(shown, scene, views), "opens": False, "error": f"{error}"}


def _quality(model: Gaussians, scene: Scene, views: int) -> dict[str, Any]:
    return asdict(quality(model, subsample_views(scene.test, views), scene.background.to(model.device)))
