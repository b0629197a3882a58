"""The report: one HTML file that opens from disk and, by its own policy, loads nothing."""

from __future__ import annotations

import hashlib
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import msgspec
from markupsafe import Markup, escape

from keyss.audits import numbers
from keyss.audits.record import Audit, ModelImages
from keyss.audits.summary import auc_text, headline, missing_readers, verdicts, worst_leak
from keyss.audits.untrusted import AuditPictures, check_bounds, clean
from keyss.core import InputError, import_extra
from keyss.measure.images import ImageComparison
from keyss.measure.robustness.survival import breakdown_points
from keyss.viewer.page import embedding_rules, page_with
from keyss.viewer.showing import is_readable

if TYPE_CHECKING:
    from jinja2 import Environment

MAX_EMBEDDED = 32 << 20  # bytes of a published model; 130,000 Gaussians of SH degree 3
_STYLES = ("page.css", "pictures.css", "print.css")
_AUDIT = "`keyss audit RUN --key-file KEY` measures it"
_EVALUATE = "`keyss evaluate RUN --key-file KEY` measures it, and a new audit includes it"
_NO_MODEL = "the method does not publish a 3DGS model"
# Fields of `Audit` in the order of the page; an asterisk: only 3DGS models have it.
_PARTS = {
    "images": "Images against the test photos",
    "wrong_key": "Wrong keys",
    "leaks": "Leaks without the key*",
    "stealth": "The file by itself*",
    "parameters": "Statistics of the model*",
    "stegexpose": "StegExpose",
    "robustness": "Robustness*",
    "speed": "Speed, files and readers",
}


@dataclass(frozen=True)
class Published:
    """The published model in a report."""

    page: str | None  # the viewer with the model in it, as a whole page
    instead: str = ""  # why there is none


def report_bytes(audit: Audit, folder: Path, published: Path) -> bytes:
    """The content of the report.

    It needs no network: pictures, figures, style, script and, up to 32 MiB, the published model in the viewer
    are inside. The same audit of the same model gives the same bytes. `folder` holds the audit's pictures, as
    a run's does. Raises InputError for an audit that is too large or names pictures outside the folder.
    """
    try:
        check_bounds(audit)
    except RecursionError as error:
        raise InputError(f"{folder}: the audit's configuration is nested too deeply") from error
    return page(audit, AuditPictures(folder), published_model(published, audit.run.up)).encode()


def published_model(path: Path, up: str) -> Published:
    """The viewer with a run's published model, unless it is larger than 32 MiB or a link to elsewhere."""
    inside = path.resolve().parent == path.parent.parent.resolve() / path.parent.name
    try:
        with path.open("rb") as file:
            data = file.read(MAX_EMBEDDED + 1) if inside else b""
    except OSError:
        data = b""
    if not is_readable(path.name, data):
        return Published(None, "It was not in RUN/publish when this page was written.")
    if len(data) > MAX_EMBEDDED:
        size = f"It is larger than {MAX_EMBEDDED >> 20} MiB, too large for this page."
        return Published(None, f"{size} `keyss view RUN/publish/{path.name}` shows it.")
    return Published(page_with(data, path.name, up).decode())


def page(audit: Audit, pictures: AuditPictures, published: Published) -> str:
    """A whole HTML document. Raises InputError for pictures and curves that are not as they should be."""
    script = _asset("slider.js")
    lines, notes = verdicts(audit), _not_measured(audit)
    models = audit.images.models if audit.images else ()
    all_photos = all(model.photos for model in models)
    sections = {  # title and content
        "verdict": ("Verdict", lines),
        "pictures": ("Pictures", audit.images and audit.images.pictures),
        "published": ("The published model", published),
        "images": (f"Against the test {'photos' if all_photos else 'views'}", audit.images),
        "wrong-keys": ("Wrong keys", audit.wrong_key),
        "leaks": ("Leaks without the key", audit.leaks),
        "stealth": ("The file by itself", audit.stealth),
        "statistics": ("The model's statistics", audit.parameters),
        "renders": ("Detectors on renders", audit.stegexpose),
        "robustness": ("Robustness", audit.robustness),
        "speed": ("Speed, files and readers", audit.speed),
        "not-measured": ("Not measured", notes),
        "configuration": ("Configuration and versions", audit.run.config or audit.run.versions),
    }
    return (
        _environment()
        .get_template("page.html")
        .render(
            audit=audit,
            title=_title(audit),
            sections={name: title for name, (title, content) in sections.items() if content},
            pictures=pictures,
            published=published,
            lines=lines,
            headline=headline(lines),
            notes=notes,
            comparisons=_comparisons(models),
            worst_leak=worst_leak,
            all_photos=all_photos,
            breakdown_points=breakdown_points(audit.robustness or ()),
            style=Markup("".join(map(_asset, _STYLES))),
            script=Markup(script),
            policy=_policy(script, viewer=published.page is not None),
        )
    )


def _policy(script: str, *, viewer: bool) -> str:
    """Even if markup slipped through the escaping, browsers would run no other script and fetch nothing."""
    rules = {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": "'unsafe-inline'",
        "script-src": f"'sha256-{b64encode(hashlib.sha256(script.encode()).digest()).decode()}'",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    if viewer:  # its frame inherits these rules and has stricter ones of its own
        more = embedding_rules()
        rules |= more | {"script-src": f"{rules['script-src']} {more['script-src']}"}
    return "; ".join(f"{name} {sources}" for name, sources in rules.items())


def prose(text: str) -> Markup:
    """Text in which `backquotes` mark code."""
    code = Markup("<code>{}</code>")
    return Markup("").join(
        code.format(part) if i % 2 else part for i, part in enumerate(clean(text).split("`"))
    )


def as_json(value: object) -> Markup:
    """A record as indented JSON."""
    lines = msgspec.json.format(msgspec.json.encode(value).decode(), indent=2).splitlines()
    return Markup("\n").join(map(clean, lines))


def escaped(page: str) -> Markup:
    """A whole page as an attribute, with all its characters, unlike untrusted text."""
    return escape(page)


def _environment() -> Environment:
    jinja2 = import_extra("jinja2", "audit", "write a report")
    environment: Environment = jinja2.Environment(
        loader=jinja2.PackageLoader("keyss.audits"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    formats = [*filter(callable, vars(numbers).values()), auc_text, escaped, as_json, prose]
    environment.filters |= {each.__name__: each for each in formats}
    from keyss.audits import figures  # imports matplotlib

    environment.globals["figures"] = figures
    return environment


def _finalized(value: object) -> object:
    """The value of an expression in a template; untrusted text becomes one printable line."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return clean(value)
    return "" if value is None else value


def _title(audit: Audit) -> str:
    """Names the secrets and the cover."""
    cover, *secrets = (PurePath(path).name or path for path in (audit.run.cover, *audit.run.secrets))
    return f"{' and '.join(secrets) or 'A secret'}, hidden in {cover}"


def _comparisons(models: Sequence[ModelImages]) -> list[tuple[str, ImageComparison, int | None]]:
    """Name, comparison and number of Gaussians of each model, each followed by its baseline."""
    rows: list[tuple[str, ImageComparison, int | None]] = []
    for index, model in enumerate(models):
        kind = "revealed" if index else "stego model"
        rows.append((f"{model.scene}, {kind}", model.images, model.gaussians))
        if model.baseline is not None:
            rows.append((f"{model.scene}, plain model (baseline)", model.baseline, model.baseline_gaussians))
    return rows


def _not_measured(audit: Audit) -> list[str]:
    """Everything that the audit lacks, and how to get it."""
    notes = []
    for name, title in _PARTS.items():
        if not getattr(audit, name):
            how = _EVALUATE if name == "wrong_key" else _AUDIT
            impossible = title.endswith("*") and not audit.run.standard
            notes.append(f"{title.rstrip('*')}: {_NO_MODEL if impossible else how}.")
    notes += [f"Reading by {reader}: {note}" for reader, note in missing_readers(audit).items()]
    return notes


def _asset(name: str) -> str:
    return files("keyss.audits").joinpath("assets", name).read_text(encoding="utf-8")
