"""The sections of a report: for each measure what it means, its figures and its tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePath

from keyss.report import meanings, plots, tables
from keyss.report.comparisons import captioned, comparison
from keyss.report.markup import Content, Html, element, join, prose
from keyss.report.meanings import Meaning
from keyss.report.numbers import integer, seconds_text
from keyss.report.reading import Part, Pictures
from keyss.report.survival import survivals
from keyss.report.verdicts import headline, verdicts


@dataclass(frozen=True)
class Section:
    """A part of the page that can be linked to."""

    id: str
    title: str
    content: Html


def sections(audit: Part, pictures: Pictures) -> list[Section]:
    """All sections that the audit has something for. Raises InputError."""
    makers: tuple[Callable[[Part, Pictures], Section | None], ...] = (
        _verdicts,
        _pictures,
        _images,
        _wrong_keys,
        _leaks,
        _statistics,
        _renders,
        _robustness,
        _speed,
        _not_measured,
        _configuration,
    )
    return [section for make in makers if (section := make(audit, pictures)) is not None]


def title(audit: Part) -> str:
    """What is hidden where."""
    run = audit.part("run")
    secrets = [PurePath(path).name or path for path in run.texts("secrets")]
    cover = PurePath(run.text("cover")).name or "a cover"
    return f"{' and '.join(secrets) or 'A secret'}, hidden in {cover}"


def facts(audit: Part) -> Html:
    """What was audited, in a few lines."""
    run, null = audit.part("run"), audit.part("null")
    methods = {
        "learned": "learned: trained together with the cover",
        "carry": "carry: quantised, in low bits of the cover",
    }
    width = run.number("width")
    rows = [
        ("Method", methods.get(run.text("method"), run.text("method"))),
        ("Cover", run.text("cover")),
        ("Secrets" if len(run.texts("secrets")) > 1 else "Secret", ", ".join(run.texts("secrets"))),
        ("Gaussians", "" if run.number("gaussians") is None else integer(run.number("gaussians"))),
        ("Photos", "" if width is None else f"{width:.0f} pixels wide"),
        ("Preset", run.text("preset")),
        ("Null", _null_text(null)),
        ("Run", run.text("path")),
        ("Audit", _made_by(audit)),
    ]
    return element(
        "dl",
        *(join([element("dt", name), element("dd", text)]) for name, text in rows if text),
        class_="facts",
    )


def _null_text(null: Part) -> str:
    models, seeds = null.number("models"), null.numbers("seeds")
    if not models:
        return ""
    which = f", seeds {', '.join(f'{seed:.0f}' for seed in seeds[:20])}" if seeds else ""
    return f"{integer(models)} plain 3DGS models{which}"


def _made_by(audit: Part) -> str:
    version, seconds = audit.text("keyss"), audit.number("seconds")
    parts = [f"keyss {version}" if version else "", f"took {seconds_text(seconds)}" if seconds else ""]
    return ", ".join(part for part in parts if part)


def _verdicts(audit: Part, _: Pictures) -> Section | None:
    lines = verdicts(audit)
    if not lines:
        return None
    return Section(
        "verdict",
        "Verdict",
        join(
            [
                element("p", headline(lines), class_="headline"),
                tables.verdict_table(lines),
                _explained(meanings.VERDICT),
            ]
        ),
    )


def _pictures(audit: Part, pictures: Pictures) -> Section | None:
    groups = [comparison(group, pictures) for group in audit.parts("pictures", 200)]
    return _section(
        "pictures",
        "Pictures",
        meanings.PICTURES,
        element("div", *groups, class_="pictures") if any(groups) else None,
    )


def _images(audit: Part, _: Pictures) -> Section | None:
    images = audit.part("images")
    missing: dict[str, str] = {}
    for _name, part in tables.compared(images):
        notes = part.part("missing")
        missing |= {name: notes.text(name) for name in notes.entries}
    return _section(
        "images",
        "Against the test photos",
        meanings.IMAGES,
        tables.image_table(images),
        *(tables.view_table(name, part) for name, part in tables.compared(images)),
        *(
            element("p", prose(sentence), class_="note")
            for _, sentence in sorted(missing.items())
            if sentence
        ),
    )


def _wrong_keys(audit: Part, _: Pictures) -> Section | None:
    return _section(
        "wrong-keys",
        "Wrong keys",
        meanings.WRONG_KEYS,
        tables.wrong_key_table(audit.part("wrong_key")),
    )


def _leaks(audit: Part, pictures: Pictures) -> Section | None:
    content: list[Content] = []
    secrets = audit.lists("leaks", 500)
    for index, attacks in enumerate(secrets):
        if not attacks:
            continue
        name = tables.numbered("Secret", index, len(secrets))
        content.append(tables.leak_table(f"{name}: against its photos, and beside it what leaks", attacks))
        shown = [
            captioned(picture, attack.text("attack"))
            for attack in attacks
            if (picture := pictures.read(attack, "picture")) is not None
        ]
        if shown:
            content.append(element("div", *shown, class_="gallery"))
    return _section(
        "leaks",
        "Leaks without the key",
        meanings.LEAKS,
        *content,
    )


def _statistics(audit: Part, _: Pictures) -> Section | None:
    distances = audit.part("distances").named("attributes", 100)
    distance = _measure(
        "Distances of the attributes",
        meanings.DISTANCES,
        _beside(plots.distances(distances), tables.distance_table(distances)),
    )
    two_sample = _measure(
        "A classifier between two models",
        meanings.TWO_SAMPLE,
        plots.two_sample(audit.part("two_sample")),
    )
    histograms = _measure(
        "Histograms",
        meanings.HISTOGRAMS,
        plots.histograms(audit.named("histograms", 32)),
    )
    sinkhorn = _measure(
        "3D-Sinkhorn, as published",
        meanings.SINKHORN,
        tables.sinkhorn_table(audit.part("sinkhorn")),
    )
    return _section("statistics", "The model's statistics", None, distance, two_sample, histograms, sinkhorn)


def _renders(audit: Part, _: Pictures) -> Section | None:
    stegexpose = audit.part("stegexpose")
    return _section(
        "renders",
        "Detectors on renders",
        meanings.RENDERS,
        _beside(plots.roc(audit), tables.detector_table(audit)),
        tables.score_table("StegExpose's scores, plain models", stegexpose.parts("plain")),
        tables.score_table("StegExpose's scores, published model", stegexpose.parts("stego")),
    )


def _robustness(audit: Part, _: Pictures) -> Section | None:
    rows = survivals(audit)
    return _section(
        "robustness",
        "What survives",
        meanings.ROBUSTNESS,
        plots.losses(rows),
        tables.robustness_table(rows),
    )


def _speed(audit: Part, _: Pictures) -> Section | None:
    speed = audit.part("speed")
    reveal = speed.number("reveal_seconds")
    made = tables.speed_tables(speed)
    return _section(
        "speed",
        "Speed, files and readers",
        meanings.SPEED,
        _beside(*made),
        None if reveal is None else element("p", f"Revealing with the key took {seconds_text(reveal)}."),
    )


_HOW = "`keyss audit RUN --key-file KEY` measures it"
_NULL = "it needs plain models: `keyss audit RUN --key-file KEY --null 3`"
_MEASURES = (
    ("images", "Images against the test photos", _HOW),
    (
        "wrong_key",
        "Wrong keys",
        "`keyss evaluate RUN --key-file KEY` measures it, and audits after it have it",
    ),
    ("leaks", "Leaks without the key", _HOW),
    ("distances", "Distances of attributes", _NULL),
    ("two_sample", "The classifier between two models", _NULL),
    ("histograms", "Histograms", _HOW),
    ("sinkhorn", "3D-Sinkhorn", _HOW),
    ("stegexpose", "StegExpose", _HOW),
    ("sealwatch", "sealwatch", _HOW),
    ("robustness", "Robustness", _HOW),
    ("speed", "Speed, files and readers", _HOW),
    ("pictures", "Pictures", _HOW),
)


def _not_measured(audit: Part, _: Pictures) -> Section | None:
    notes = []
    for key, name, how in _MEASURES:
        value = audit.entries.get(key)
        reason = audit.part(key).text("missing") if isinstance(value, dict) else ""
        if reason:
            notes.append(f"{name}: {reason}")
        elif not value:
            notes.append(f"{name}: {how}.")
    if not audit.part("null").number("models"):
        notes.append(f"The null: {_NULL}. Without it distances have nothing beside them.")
    if not notes:
        return None
    return Section(
        "not-measured", "Not measured", element("ul", *(element("li", prose(note)) for note in notes))
    )


def _configuration(audit: Part, _: Pictures) -> Section | None:
    run = audit.part("run")
    config, versions = run.part("config").flat(), run.part("versions").flat()
    return _section(
        "configuration",
        "Configuration and versions",
        None,
        tables.folded("Versions", tables.table("Versions", ("", "version"), versions, texts=2))
        if versions
        else None,
        tables.folded("Configuration", tables.table("Configuration", ("", "value"), config, texts=2))
        if config
        else None,
    )


def _section(id: str, title: str, meaning: Meaning | None, *content: Content) -> Section | None:
    """A section, if it has any content."""
    if not any(content):
        return None
    return Section(id, title, join([_explained(meaning) if meaning else None, *content]))


def _measure(title: str, meaning: Meaning, *content: Content) -> Html | None:
    """A measure of several in a section, if it has any content."""
    return join([element("h3", title), _explained(meaning), *content]) if any(content) else None


def _explained(meaning: Meaning) -> Html:
    return element(
        "p", meaning.means, " ", element("span", meaning.does_not, class_="limits"), class_="meaning"
    )


def _beside(*content: Content) -> Html | None:
    """A figure and its table, beside each other where there is room."""
    return element("div", *content, class_="columns") if any(content) else None
