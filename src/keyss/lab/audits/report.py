"""The report: one HTML file that opens from disk and loads nothing, enforced by its policy.

Texts, images and size of an audit are untrusted.
"""

from __future__ import annotations

import hashlib
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from importlib.resources import files
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import msgspec
from markupsafe import Markup

from keyss.core import InputError, import_extra
from keyss.files.images import probe_image
from keyss.files.inputs import read_file
from keyss.lab.audits import numbers
from keyss.lab.audits.parts import OF_3DGS_MODELS
from keyss.lab.audits.record import AUDIT_FOLDER, Audit, ModelImages
from keyss.lab.audits.summary import auc_text, headline, verdicts, worst_leak
from keyss.measure.image_scores import ImageComparison

if TYPE_CHECKING:
    from jinja2 import Environment

_STYLES = ("page.css", "pictures.css", "print.css")
_AUDIT = "`keyss audit RUN --key-file KEY` measures it"
_EVALUATE = "`keyss evaluate RUN --key-file KEY` measures it, and a new audit includes it"
_NO_MODEL = "the method does not publish a 3DGS model"
_MAX_PICTURE = 32 * 2**20
_MAX_PICTURES = 256 * 2**20  # bytes of all pictures; browsers cannot show more
_MAX_ENTRIES = 10_000
_MAX_NUMBER = 1e15
_MAX_TEXT = 1_000
_PNG = b"\x89PNG\r\n\x1a\n"
# By field of `Audit`, in the order of the page: the id of the section and its title.
_PARTS = {
    "images": ("images", "Against the test views"),
    "wrong_key": ("wrong-keys", "Wrong keys"),
    "leaks": ("leaks", "Leaks without the key"),
    "stealth": ("stealth", "The file by itself"),
    "parameters": ("statistics", "Statistics of the model"),
    "stegexpose": ("renders", "StegExpose on renders"),
    "robustness": ("robustness", "Robustness"),
    "speed": ("speed", "Speed and files"),
}


def report_bytes(audit: Audit, folder: Path) -> bytes:
    """The content of the report.

    Pictures, style and script are embedded. Deterministic. `folder` holds the audit's pictures, like a run's.
    Raises InputError for an audit that is too large or names pictures outside the folder.
    """
    try:
        check_bounds(audit)
    except RecursionError as error:
        raise InputError(f"{folder}: the audit's configuration is nested too deeply") from error
    script = _asset("slider.js")
    lines, notes = verdicts(audit), _missing_parts(audit)
    models = audit.images.models if audit.images else ()
    sections = {"verdict": "Verdict"} if lines else {}
    if audit.images and audit.images.pictures:
        sections["pictures"] = "Pictures"
    sections |= {id: title for name, (id, title) in _PARTS.items() if getattr(audit, name)}
    if notes:
        sections["not-measured"] = "Not measured"
    if audit.run.config or audit.run.versions:
        sections["configuration"] = "Configuration and versions"
    page = (
        _environment()
        .get_template("page.html")
        .render(
            audit=audit,
            title=_title(audit),
            sections=sections,
            pictures=AuditPictures(folder),
            lines=lines,
            headline=headline(lines),
            notes=notes,
            comparisons=_comparisons(models),
            worst_leak=worst_leak,
            all_photos=all(model.photos for model in models),
            style=Markup("".join(map(_asset, _STYLES))),
            script=Markup(script),
            policy=_policy(script),
        )
    )
    return page.encode()


def _policy(script: str) -> str:
    """A content security policy: even unescaped markup could run no other script and fetch nothing."""
    digest = b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'; "
        "base-uri 'none'; form-action 'none'"
    )


def prose(text: str) -> Markup:
    """Format text with `backquotes` as code."""
    code = Markup("<code>{}</code>")
    return Markup("").join(
        code.format(part) if i % 2 else part for i, part in enumerate(clean(text).split("`"))
    )


def as_json(value: object) -> Markup:
    """A record as indented JSON."""
    lines = msgspec.json.format(msgspec.json.encode(value).decode(), indent=2).splitlines()
    return Markup("\n").join(map(clean, lines))


def _environment() -> Environment:
    jinja2 = import_extra("jinja2", "audit", "write a report")
    environment: Environment = jinja2.Environment(
        loader=jinja2.PackageLoader("keyss.lab.audits"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_finalize,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    formats = [*filter(callable, vars(numbers).values()), auc_text, as_json, prose]
    environment.filters |= {each.__name__: each for each in formats}
    return environment


def _finalize(value: object) -> object:
    """Convert the value of an expression in a template; untrusted text becomes one printable line."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return clean(value)
    return "" if value is None else value


def _title(audit: Audit) -> str:
    """The title, with the names of the secrets and the cover."""
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


def _missing_parts(audit: Audit) -> list[str]:
    """Sentences on missing parts of the audit, and how to get them."""
    notes = []
    for name, (_, title) in _PARTS.items():
        if not getattr(audit, name):
            how = _EVALUATE if name == "wrong_key" else _AUDIT
            impossible = name in OF_3DGS_MODELS and not audit.run.standard
            notes.append(f"{title}: {_NO_MODEL if impossible else how}.")
    return notes


def _asset(name: str) -> str:
    return files("keyss.lab.audits").joinpath("assets", name).read_text(encoding="utf-8")


def check_bounds(value: object, place: str = "audit") -> None:
    """Raise InputError for a list of more than 10,000 entries or a number beyond 1e15 in a record."""
    entries: dict[object, object] = {}
    if is_dataclass(value):
        entries = {f".{each.name}": getattr(value, each.name) for each in fields(value)}
    elif isinstance(value, dict):
        entries = {f".{clean(str(name))}": item for name, item in value.items()}
    elif isinstance(value, list | tuple):
        entries = {f"[{index}]": item for index, item in enumerate(value)}
    elif isinstance(value, int | float) and abs(value) > _MAX_NUMBER:
        raise InputError(f"{place}: expected a number of at most {_MAX_NUMBER:g} in size")
    if len(entries) > _MAX_ENTRIES:
        raise InputError(f"{place}: expected at most {_MAX_ENTRIES:,} entries, found {len(entries):,}")
    for name, item in entries.items():
        check_bounds(item, f"{place}{name}")


def clean(text: str) -> str:
    """One line of at most 1,000 printable characters: no control or bidirectional characters."""
    text = text[: _MAX_TEXT - 1] + "…" if len(text) > _MAX_TEXT else text
    return "".join(
        c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in text
    )


@dataclass(frozen=True)
class EmbeddedPicture:
    """A picture inside a page."""

    width: int  # pixels
    height: int
    url: str  # data:


class AuditPictures:
    """The pictures of an audit: PNG files in its folder."""

    def __init__(self, run: Path) -> None:
        self._folder = run / AUDIT_FOLDER
        self._left = _MAX_PICTURES

    def read(self, name: str) -> EmbeddedPicture:
        """Read a picture that the audit names.

        Raises InputError if it is outside the audit's folder, missing, not a PNG or too large.
        """
        try:
            folder = self._folder.resolve()
            path = (folder / name).resolve()
        except (OSError, RuntimeError, ValueError) as error:  # loops of links, invalid names
            raise InputError(f"expected the name of a picture, found {name!r}") from error
        if not path.is_relative_to(folder):
            raise InputError(f"expected a picture in {self._folder}, found {name!r}")
        data = read_file(path, min(_MAX_PICTURE, self._left))
        if not data.startswith(_PNG):
            raise InputError(f"{path}: expected a PNG picture")
        width, height, _ = probe_image(path)
        self._left -= len(data)
        return EmbeddedPicture(width, height, "data:image/png;base64," + b64encode(data).decode())
