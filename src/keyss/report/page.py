"""The report: one HTML file that opens from disk, loads nothing and, by its own policy, may not."""

from __future__ import annotations

import hashlib
from base64 import b64encode
from functools import partial
from importlib.resources import files
from itertools import zip_longest
from pathlib import Path, PurePath

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from keyss.core.errors import InputError
from keyss.files.atomic import write_bytes
from keyss.measure.images import ImageComparison
from keyss.measure.robustness.survival import mean_over_draws
from keyss.report import numbers
from keyss.report.published import Published, published_model
from keyss.report.untrusted import AuditPictures, check_bounds, clean, flat
from keyss.report.verdicts import auc_text, detector_rocs, headline, missing_readers, verdicts, worst_leak
from keyss.runs.audit_record import Audit, ImagesResult, read_audit
from keyss.runs.files import REPORT, stego_in
from keyss.runs.folder import write_again
from keyss.viewer.page import embedding_rules

_STYLES = ("page.css", "pictures.css", "print.css")
_HOW = "`keyss audit RUN --key-file KEY` measures it"
_NO_MODEL = "what this method publishes is no 3DGS model"
_OF_3DGS_MODELS = ("Leaks without the key", "The file by itself", "Statistics of the model", "Robustness")
_EVALUATE = "`keyss evaluate RUN --key-file KEY` measures it, and audits after it have it"


def write_report(run_folder: Path | str) -> Path:
    """Write RUN/private/report.html from RUN/private/audit, atomically, and return its path.

    One file that needs no network: pictures, figures, style and script are in it, and so it shows the secret.
    The published model is in it as well, in the viewer, where it is not too large: see `published_model`.
    The same audit of the same model gives the same bytes. Raises InputError when there is no audit, or it is
    broken, too large or names pictures outside its folder; OutputError when the file cannot be written.
    """
    run = Path(run_folder)
    data = report_bytes(read_audit(run), run, stego_in(run))
    write_again(run, "audit", REPORT, partial(write_bytes, data=data))
    return run / REPORT


def report_bytes(audit: Audit, folder: Path, published: Path) -> bytes:
    """The file's content; pictures are in `folder`, laid out as in a run's. Raises InputError."""
    try:
        check_bounds(audit)
    except RecursionError as error:
        raise InputError(f"{folder}: the audit's configuration is nested too deeply") from error
    return page(audit, AuditPictures(folder), published_model(published, audit.run.up)).encode()


def page(audit: Audit, pictures: AuditPictures, published: Published) -> str:
    """A whole HTML document. Raises InputError for pictures and curves that are not as they should be."""
    script = _asset("slider.js")
    lines, notes = verdicts(audit), _not_measured(audit)
    found = {  # section by section: its title, and whether there is anything in it
        "verdict": ("Verdict", lines),
        "pictures": ("Pictures", audit.images and audit.images.pictures),
        "published": ("The published model", published),
        "images": (f"Against the test {'photos' if all(audit.run.photos) else 'views'}", audit.images),
        "wrong-keys": ("Wrong keys", audit.wrong_key),
        "leaks": ("Leaks without the key", audit.leaks),
        "stealth": ("The file by itself", audit.stealth),
        "statistics": ("The model's statistics", audit.parameters),
        "renders": ("Detectors on renders", audit.stegexpose),
        "robustness": ("What survives", audit.robustness),
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
            sections={name: title for name, (title, content) in found.items() if content},
            pictures=pictures,
            published=published,
            lines=lines,
            headline=headline(lines),
            notes=notes,
            comparisons=_comparisons(audit.images) if audit.images else [],
            worst_leak=worst_leak,
            all_photos=all(audit.run.photos),
            detectors=[*detector_rocs(audit, "StegExpose"), *detector_rocs(audit, "sealwatch")],
            changes=mean_over_draws(audit.robustness.changes) if audit.robustness else [],
            style=Markup("".join(map(_asset, _STYLES))),
            script=Markup(script),
            policy=_policy(script, viewer=published.page is not None),
        )
    )


def _policy(script: str, *, viewer: bool) -> str:
    """Should markup ever slip through the escaping, browsers run no other scripts and fetch nothing."""
    rules = {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": "'unsafe-inline'",
        "script-src": f"'sha256-{b64encode(hashlib.sha256(script.encode()).digest()).decode()}'",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    if viewer:  # whose frame inherits these, and has stricter ones of its own
        more = embedding_rules()
        rules |= more | {"script-src": f"{rules['script-src']} {more['script-src']}"}
    return "; ".join(f"{name} {sources}" for name, sources in rules.items())


def prose(text: str) -> Markup:
    """Text in which `backquotes` mark what is typed."""
    code = Markup("<code>{}</code>")
    return Markup("").join(
        code.format(part) if i % 2 else part for i, part in enumerate(clean(text).split("`"))
    )


def escaped(page: str) -> Markup:
    """A whole page as an attribute; unlike texts of others it keeps its length and all characters."""
    return escape(page)


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("keyss.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    formats = [*filter(callable, vars(numbers).values()), auc_text, escaped, flat, prose]
    environment.filters |= {each.__name__: each for each in formats}
    from keyss.report import figures  # matplotlib takes a second, and few who hide write a report

    environment.globals["figures"] = figures
    return environment


def _finalized(value: object) -> object:
    """What goes into the page for an expression: texts of others as one printable line."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return clean(value)
    return "" if value is None else value


def _title(audit: Audit) -> str:
    """What is hidden where."""
    cover, *secrets = (PurePath(path).name or path for path in (audit.run.cover, *audit.run.secrets))
    return f"{' and '.join(secrets) or 'A secret'}, hidden in {cover}"


def _comparisons(images: ImagesResult) -> list[tuple[str, ImageComparison, int | None]]:
    """The comparisons of an audit with names and numbers of Gaussians, each followed by its baseline."""
    compared = [images.cover, *images.secrets]
    baselines = [images.cover_baseline, *images.secret_baselines]
    models = list(zip_longest(compared, images.gaussians, baselines, images.baseline_gaussians))
    found = []
    for index, (own, gaussians, baseline, others) in enumerate(models[: len(compared)]):
        name = numbers.numbered("secret", index - 1, len(images.secrets)) if index else "cover"
        found.append((f"{name}, {'revealed' if index else 'stego model'}", own, gaussians))
        if baseline is not None:
            found.append((f"{name}, plain model (baseline)", baseline, others))
    return found


def _not_measured(audit: Audit) -> list[str]:
    """What an audit could have, and has not."""
    parts = {
        "Images against the test photos": audit.images,
        "Wrong keys": audit.wrong_key,
        "Leaks without the key": audit.leaks,
        "The file by itself": audit.stealth,
        "Statistics of the model": audit.parameters,
        "StegExpose": audit.stegexpose,
        "Robustness": audit.robustness,
        "Speed, files and readers": audit.speed,
    }
    notes = [
        f"{name}: {_NO_MODEL if name in _OF_3DGS_MODELS and not audit.run.standard else how}."
        for name, found in parts.items()
        for how in (_EVALUATE if name == "Wrong keys" else _HOW,)
        if not found
    ]
    if audit.stegexpose and audit.stegexpose.sealwatch_missing:
        notes.append(f"sealwatch: {audit.stegexpose.sealwatch_missing}")
    notes += [f"Reading by {reader}: {note}" for reader, note in missing_readers(audit).items()]
    return notes


def _asset(name: str) -> str:
    return files("keyss.report").joinpath("assets", name).read_text(encoding="utf-8")
