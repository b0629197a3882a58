"""Tables of an audit's numbers, each value beside its bound or its null."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean

from keyss.report.markup import Content, Html, element, join, prose
from keyss.report.numbers import (
    NOTHING,
    bytes_text,
    difference,
    integer,
    number,
    seconds_text,
    significant,
    times,
)
from keyss.report.reading import Part
from keyss.report.survival import UNCHANGED, Fate, Survival
from keyss.report.verdicts import PROGRAMS, Verdict, auc_text, rocs

# What a key of a comparison is called, and its digits; in this order.
_IMAGE_METRICS = {
    "psnr": ("PSNR, dB", 2),
    "ssim_3dgs": ("SSIM, 3DGS's", 4),
    "ssim_standard": ("SSIM, standard", 4),
    "lpips_alex": ("LPIPS, AlexNet", 4),
    "flip": ("FLIP", 4),
}
_DETECTORS = {
    "primary_sets": "primary sets",
    "chi_square": "chi-square",
    "sample_pairs": "sample pairs",
    "rs": "RS",
    "fusion": "all, averaged",
}
_LEAK_SCORES = {
    "psnr": ("PSNR, dB", 2),
    "psnr_fitted": ("PSNR, colours fitted, dB", 2),
    "ssim": ("SSIM", 3),
    "ssim_fitted": ("SSIM, colours fitted", 3),
    "gradient": ("gradients", 3),
    "gradient_coarse": ("coarse gradients", 3),
}


def table(caption: str, head: Sequence[Content], rows: Sequence[Sequence[Content]], texts: int = 1) -> Html:
    """A table whose first `texts` columns are text and whose others are numbers, in a box that scrolls."""

    def kind(index: int) -> str | None:
        return None if index < texts else "number"

    header = element("tr", *(element("th", cell, scope="col", class_=kind(i)) for i, cell in enumerate(head)))
    body = [
        element(
            "tr",
            element("th", row[0], scope="row"),
            *(element("td", cell, class_=kind(i)) for i, cell in enumerate(row[1:], start=1)),
        )
        for row in rows
    ]
    return element(
        "div",
        element("table", element("caption", caption), element("thead", header), element("tbody", *body)),
        class_="scroll",
    )


def folded(summary: str, *content: Content) -> Html:
    """Content behind a line that opens it."""
    return element("details", element("summary", summary), *content)


def verdict_table(lines: Sequence[Verdict]) -> Html:
    """The summary."""
    rows = [
        (
            element("a", line.measure[:1].upper() + line.measure[1:], href=f"#{line.section}"),
            line.value,
            line.beside or NOTHING,
            line.limit,
            element("span", line.word, class_=f"word {line.word}"),
        )
        for line in lines
    ]
    head = ("Measure", "Measured", "Bound or null", "Limit", "Verdict")
    return element("div", table("Every measure against its limit", head, rows, texts=5), class_="verdicts")


def image_table(images: Part) -> Html | None:
    """Means over the test views, published and revealed models beside their bounds."""
    rows = [(name, part) for name, part in compared(images) if part.part("mean")]
    if not rows:
        return None
    metrics = _measured(_IMAGE_METRICS, [part.part("mean") for _, part in rows])
    return table(
        "Means over the test views",
        ["", *(label for label, _ in metrics.values())],
        [
            [name, *(number(part.part("mean").number(key), digits) for key, (_, digits) in metrics.items())]
            for name, part in rows
        ],
    )


def view_table(name: str, comparison: Part) -> Html | None:
    """A comparison view by view, folded."""
    views = comparison.parts("views")
    metrics = _measured(_IMAGE_METRICS, views)
    if not metrics:
        return None
    rows = [
        [view.text("name"), *(number(view.number(key), digits) for key, (_, digits) in metrics.items())]
        for view in views
    ]
    head = ["view", *(label for label, _ in metrics.values())]
    return folded(f"{name}, view by view ({len(rows)})", table(name, head, rows))


def compared(images: Part) -> list[tuple[str, Part]]:
    """The comparisons of an audit with their names, each followed by its bound."""
    secrets, bounds = images.parts("secrets", 100), images.parts("secret_bounds", 100)
    rows = [
        ("cover, published", images.part("cover")),
        ("cover, plain 3DGS (bound)", images.part("cover_bound")),
    ]
    for index, secret in enumerate(secrets):
        name = numbered("secret", index, len(secrets))
        rows.append((f"{name}, revealed", secret))
        if index < len(bounds):
            rows.append((f"{name}, plain 3DGS (bound)", bounds[index]))
    return rows


def wrong_key_table(wrong: Part) -> Html | None:
    """What wrong keys show, in dB."""
    rows: list[tuple[str, str, str]] = []
    cover = wrong.part("vs_cover")
    if cover:
        rows.append(
            ("against the cover's photos", number(cover.number("mean"), 2), number(cover.number("min"), 2))
        )
    secrets, floors = wrong.parts("vs_secrets", 100), wrong.numbers("floor")
    for index, secret in enumerate(secrets):
        name = numbered("the secret", index, len(secrets))
        mean, most = number(secret.number("mean"), 2), number(secret.number("max"), 2)
        rows.append((f"against the photos of {name}", mean, most))
        if index < len(floors):
            floor = number(floors[index], 2)
            rows.append((f"the published model itself, against {name} (floor)", floor, NOTHING))
    caption = f"PSNR in dB of what {integer(wrong.number('keys'))} wrong keys show"
    return table(caption, ("", "mean", "worst"), rows) if rows else None


def sinkhorn_table(sinkhorn: Part) -> Html | None:
    """The published distance, beside what it is between plain models."""
    stego, null = sinkhorn.part("stego"), sinkhorn.parts("null", 1000)
    names = [
        n for n in ("opacity", "rotation", "scale", "position", "colour", "mean", "sum") if n in stego.entries
    ]
    rows: list[tuple[str, str, str]] = [
        (name, number(stego.number(name), 4), _mean_and_range([each.number(name) for each in null], 4))
        for name in names
    ]
    if (score := sinkhorn.number("score")) is not None:
        rows.append(("composite score (eq. 10)", number(score, 2), NOTHING))
    return (
        table("Distances; of the null, mean and range", ("", "published model", "plain models (null)"), rows)
        if rows
        else None
    )


def distance_table(attributes: Mapping[str, Part]) -> Html | None:
    """Distances of attributes in units of the cover's range."""
    rows = [
        (name, *(significant(part.number(key)) for key in ("distance", "null")), times(part.number("ratio")))
        for name, part in attributes.items()
    ]
    head = ("", "published model", "plain models (null)", "ratio")
    return table("Wasserstein distances, in units of the cover's range", head, rows) if rows else None


def detector_table(audit: Part) -> Html | None:
    """AUC of each detector on renders of the published model against a plain one's, and of two plain ones."""
    detectors, null = (audit.part(key).part("detectors") for key in ("stegexpose", "stegexpose_null"))
    rows = [
        (f"StegExpose, {label}", number(detectors.number(key), 2), number(null.number(key), 2))
        for key, label in _DETECTORS.items()
        if key in detectors.entries
    ]
    for program in PROGRAMS:
        nulls = dict(rocs(audit, program, "_null"))
        rows += [
            (name, auc_text(roc), auc_text(nulls[name]) if name in nulls else NOTHING)
            for name, roc in rocs(audit, program)
        ]
    return table("AUC of each detector", ("", "AUC", "between plain models"), rows) if rows else None


def score_table(name: str, scores: Sequence[Part]) -> Html | None:
    """StegExpose's scores of images, folded."""
    rows = [[score.text("name"), *(number(score.number(key), 4) for key in _DETECTORS)] for score in scores]
    if not rows:
        return None
    return folded(f"{name} ({len(rows)})", table(name, ["render", *_DETECTORS.values()], rows))


def leak_table(caption: str, attacks: Sequence[Part]) -> Html:
    """Scores against the secret's photos, and how much better they are than those of an innocent model."""
    scores = _measured(_LEAK_SCORES, attacks)
    rows: list[list[Content]] = []
    for attack in attacks:
        control = " (control)" if attack.flag("control") else ""
        row: list[Content] = [join([attack.text("attack"), control, _small(attack.text("sentence"))])]
        for key, (_, digits) in scores.items():
            leak = attack.part("leak").number(key)
            found = number(attack.number(key), digits)
            row.append(found if leak is None else join([found, _small(difference(leak, digits))]))
        rows.append(row)
    return table(caption, ["what is done", *(label for label, _ in scores.values())], rows)


def robustness_table(rows: Sequence[Survival]) -> Html | None:
    """What each attack costs, in dB."""
    if not rows:
        return None
    secrets = max(len(row.secrets) for row in rows)
    head = ["what is done", "strength", "cover, PSNR", "cover loses"]
    for index in range(secrets):
        name = numbered("secret", index, secrets)
        head += [f"{name}, PSNR", f"{name} loses"]
    body = []
    for row in rows:
        cells = [_named(row), _strength(row), number(row.cover.psnr, 2), number(row.cover.loss, 2)]
        for secret in row.secrets:
            cells += _secret_cells(secret)
        body.append(cells + [NOTHING] * (len(head) - len(cells)))
    return table("What attacks on the file cost, in dB", head, body, texts=2)


def speed_tables(speed: Part) -> list[Html]:
    """Rendering, files and readers."""
    renders = [
        (each.text("model"), seconds_text(each.number("seconds")), times(each.number("ratio")))
        for each in speed.parts("render", 500)
    ]
    files = [(each.text("name"), bytes_text(each.number("bytes"))) for each in speed.parts("files", 500)]
    readers = [
        (
            each.text("reader"),
            each.text("file"),
            {True: "yes", False: "no", None: NOTHING}[each.flag("loads")],
            integer(each.number("gaussians")),
        )
        for each in speed.parts("readers", 500)
    ]
    tables = []
    if renders:
        tables.append(table("Rendering one view", ("model", "time", "against plain"), renders))
    if files:
        tables.append(table("Files", ("file", "size"), files))
    if readers:
        tables.append(table("Readers", ("reader", "file", "loads", "Gaussians"), readers, texts=3))
    return tables


def numbered(name: str, index: int, count: int) -> str:
    """A name, with its number if there are several."""
    return f"{name} {index + 1}" if count > 1 else name


def _measured(metrics: Mapping[str, tuple[str, int]], parts: Sequence[Part]) -> dict[str, tuple[str, int]]:
    """Those of the metrics that any part has."""
    return {key: how for key, how in metrics.items() if any(part.number(key) is not None for part in parts)}


def _secret_cells(secret: Fate) -> list[Content]:
    psnr, loss = number(secret.psnr, 2), number(secret.loss, 2)
    if secret.opens:
        return [psnr, loss]
    return [element("span", "does not open", title=secret.error or None), loss]


def _named(row: Survival) -> Content:
    note = f"left out: {row.skipped}" if row.skipped else row.sentence
    draws = f"Mean of {row.draws} draws." if row.draws > 1 else ""
    return join([row.attack, _small(" ".join(text for text in (note, draws) if text))])


def _strength(row: Survival) -> str:
    if row.strength is None or row.attack == UNCHANGED:
        return NOTHING
    return f"{row.strength:g} {row.unit}".strip()


def _small(text: str) -> Html:
    return element("small", prose(text))


def _mean_and_range(values: Sequence[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return NOTHING
    mean = number(fmean(known), digits)
    return (
        mean if len(known) == 1 else f"{mean} ({number(min(known), digits)} to {number(max(known), digits)})"
    )
