"""The report: one HTML file that opens from disk and loads nothing, enforced by its policy."""

from __future__ import annotations

import hashlib
import re
from base64 import b64encode
from collections.abc import Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path, PurePath

from markupsafe import Markup, escape

from keyss.core import InputError, import_extra
from keyss.files.images import probe_image
from keyss.files.inputs import read_file
from keyss.lab.audits import formatting
from keyss.lab.audits.audit_run import PICTURES, Audit
from keyss.lab.audits.parts import ImageComparison, ModelImages
from keyss.lab.audits.summary import auc_text, headline, verdicts, worst_leak

_STYLES = ("page.css", "pictures.css", "print.css")
_MAX_PICTURE = 32 * 2**20  # bytes
# By field of `Audit`, in the order of the page: the id of the section and its title.
_PARTS = {
    "images": ("images", "Against the test views"),
    "wrong_key": ("wrong-keys", "Wrong keys"),
    "leaks": ("leaks", "Leaks without the key"),
    "stealth": ("stealth", "The file by itself"),
    "parameters": ("statistics", "Statistics of the model"),
    "stegexpose": ("renders", "StegExpose on renders"),
    "robustness": ("robustness", "Robustness"),
    "speed": ("speed", "Speed"),
}


def report_bytes(audit: Audit, run: Path) -> bytes:
    """The content of the report.

    Pictures, style and script are embedded. Deterministic. `run` is a folder laid out like a run's, with the
    audit's pictures. Raises InputError for names outside their folder.
    """
    script, lines = _asset("slider.js"), verdicts(audit)
    models = audit.images.models if audit.images else ()
    sections = {"verdict": "Verdict"} if lines else {}
    if audit.images and audit.images.pictures:
        sections["pictures"] = "Pictures"
    sections |= {id: title for name, (id, title) in _PARTS.items() if getattr(audit, name)}
    jinja2 = import_extra("jinja2", "audit", "write a report")
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("keyss.lab.audits"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: "" if value is None else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    formats = [*filter(callable, vars(formatting).values()), auc_text, prose]
    environment.filters |= {each.__name__: each for each in formats}
    page: str = environment.get_template("page.html").render(
        audit=audit,
        title=_title(audit),
        sections=sections,
        missing=[title for name, (_, title) in _PARTS.items() if not getattr(audit, name)],
        picture=partial(embed_picture, run / PICTURES),
        lines=lines,
        headline=headline(lines),
        comparisons=_comparisons(models),
        worst_leak=worst_leak,
        all_photos=all(model.photos for model in models),
        style=Markup("".join(map(_asset, _STYLES))),
        script=Markup(script),
        policy=_policy(script),
    )
    return page.encode(errors="replace")


def _policy(script: str) -> str:
    """A content security policy: even unescaped markup could run no other script and fetch nothing."""
    digest = b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'; "
        "base-uri 'none'; form-action 'none'"
    )


def prose(sentence: str) -> Markup:
    """Format text with `backquotes` as code."""
    return Markup(re.sub("`(.*?)`", r"<code>\1</code>", escape(sentence)))


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


def _asset(name: str) -> str:
    return files("keyss.lab.audits").joinpath("assets", name).read_text(encoding="utf-8")


def embed_picture(folder: Path, name: str) -> dict[str, int | str]:
    """Width and height of a picture in pixels, and its data as an URL.

    Raises InputError if it is outside the folder, missing, unreadable or too large.
    """
    path = folder / name
    if name != PurePath(name).name or path.is_symlink():
        raise InputError(f"expected a picture in {folder}, found {name!r}")
    data = read_file(path, _MAX_PICTURE)
    width, height, _ = probe_image(path)
    url = "data:image/png;base64," + b64encode(data).decode()
    return {"width": width, "height": height, "url": url}
