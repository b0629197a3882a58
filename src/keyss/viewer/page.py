"""The viewer as files: one self-contained page, or a folder for a static host.

The content security policy of a page allows its own host and the one in `Look`; that of a self-contained page
allows only the latter. The page contains the published model and no secret.
"""

from __future__ import annotations

import hashlib
import html
import re
import warnings
from base64 import b64encode
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from keyss.core.errors import KeyssWarning, OutputError, UsageError
from keyss.files.atomic import check_not_an_input, check_output_file, mode_like, write_bytes
from keyss.files.file_kinds import is_unpacked_sog, model_file
from keyss.files.inputs import as_text, read_file
from keyss.files.model_formats import FORMATS, format_of
from keyss.viewer.look import Look

SCRIPT, STYLE, LICENCES, INDEX = "viewer.js", "viewer.css", "licences.txt", "index.html"
EMBED = "embed.js"  # an element for other sites
MAX_IN_ONE_FILE = 64 << 20  # bytes of a model; browsers limit text to 512 MiB and parse it slowly
MAX_BYTES = 2 << 30
# Argon2id is WebAssembly. Workers and saved pictures are blobs that the page makes itself.
_WASM, _SELF = "'wasm-unsafe-eval'", "'self'"
_NOTHING = "object-src 'none'; base-uri 'none'; form-action 'none'"
# Of a page with separate script and style.
SERVED_POLICY = (
    f"default-src {_SELF}; script-src {_SELF} {_WASM}; worker-src {_SELF} blob:; "
    f"img-src {_SELF} blob: data:; {_NOTHING}"
)
_MAX_HEADER = 64 << 10  # bytes of a .ply
_ORIGIN = re.compile(r"https?://[A-Za-z0-9.-]+(:[0-9]+)?")


def served_page(url: str, look: Look) -> bytes:
    """The page with separate style and script; `url`: of the model."""
    return _page(
        policy=SERVED_POLICY,
        style=f'<link rel="stylesheet" href="{STYLE}">',
        model=f'<meta name="keyss-model" content="{html.escape(url)}">',
        script=f'<script src="{SCRIPT}"></script>',
        look=look,
    )


def page_with(model: bytes, name: str, look: Look) -> bytes:
    """A self-contained page with the `model`; it shows `name`."""
    style, script = asset(STYLE).decode(), asset(SCRIPT).decode()
    data = f'<script id="model" type="application/octet-stream" data-name="{html.escape(name)}">'
    scripts = f"script-src {_hash(script)} {_WASM}; worker-src blob:"
    rules = f"{scripts}; style-src {_hash(style)}; img-src blob: data:; {_NOTHING}"
    licences = asset(LICENCES).decode().replace("--", "- -")  # "--" may end a comment
    return _page(
        policy=f"default-src 'none'; {rules}",
        style=f"<style>{style}</style>",
        model=data + b64encode(model).decode() + "</script>",
        script=f"<!-- {licences} -->\n<script>{script}</script>",
        look=look,
    )


def export_html(
    model: Path | str, out: Path | str, *, look: Look | None = None, overwrite: bool = False
) -> tuple[Path, ...]:
    """Write the viewer with the published `model`: one file if `out` ends in .html or .htm, else a folder.

    The file opens from disk; a folder, for larger models, needs a web server, and has embed.js, an element
    for other sites. `look`: see `look_of_model`. A model in a format that the page does not read is
    converted, with a KeyssWarning. The files get the permissions of `model`. Returns the paths written.
    Raises UsageError if the model is too large, InputError if it is not a model, OutputError.
    """
    model, out = model_file(model), Path(out)
    (name, data), look = readable(model), look or {}
    for origin in (look[name] for name in ("host", "embedder") if name in look):
        if not _ORIGIN.fullmatch(origin):
            raise UsageError(f"expected an origin such as https://www.example.com, got {origin}")
    mode = mode_like(model)
    if out.suffix.lower() in (".html", ".htm"):
        if len(data) > MAX_IN_ONE_FILE:
            raise UsageError(
                f"{model} has {len(data):,} bytes, more than the {MAX_IN_ONE_FILE:,} that fit into one page: "
                "name an output folder instead, and put it on a web server"
            )
        check_not_an_input(out, [model])
        write_bytes(check_output_file(out, overwrite), page_with(data, name, look), mode)
        return (out,)
    contents = {INDEX: served_page(quote(name), look), name: data}
    contents |= {name: asset(name) for name in (SCRIPT, STYLE, LICENCES, EMBED)}
    if len(contents) < 6:
        raise UsageError(f"{model} has the name of a file of the viewer: rename it")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    for name in contents:
        check_not_an_input(out / name, [model])
        check_output_file(out / name, overwrite)
    for name, content in contents.items():
        write_bytes(out / name, content, mode)
    return tuple(out / name for name in contents)


def asset(name: str) -> bytes:
    """A file of the built application."""
    return files("keyss.viewer").joinpath("assets", name).read_bytes()


def _page(*, policy: str, look: Look, **parts: str) -> bytes:
    """`page.html` with its placeholders replaced."""
    shown = "".join(f' data-{name}="{html.escape(value)}"' for name, value in look.items())
    page = asset("page.html").decode().replace('<main id="main"', f'<main id="main"{shown}')
    if host := look.get("host"):
        sources = policy.split(";")[0].removeprefix("default-src ").replace("'none'", "")
        policy = policy.replace("img-src", f"connect-src {sources} {host}; img-src {host}")
    parts["policy"] = f'<meta http-equiv="Content-Security-Policy" content="{html.escape(policy)}">'
    for name, part in parts.items():
        before, placeholder, after = page.partition(f"<!--{name}-->")
        assert placeholder, name
        page = before + part + after
    return page.encode()


def _hash(text: str) -> str:
    return f"'sha256-{b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def readable(model: Path) -> tuple[str, bytes]:
    """Name and content of the model's file if the page reads its format, else a lossless conversion.

    Warns of a conversion. Warns and raises as `read_model`, and UsageError for a file that is too large.
    """
    from keyss.files.formats.sog import pack_unpacked
    from keyss.files.models import model_bytes
    from keyss.runs.files import as_model  # imports torch

    model = model_file(model)
    if model.is_file() and (size := model.stat().st_size) > MAX_BYTES:
        raise UsageError(f"{model} has {size:,} bytes, more than the {MAX_BYTES:,} that a page loads")
    gaussians, is_unpacked = as_model(model), is_unpacked_sog(model)
    data = pack_unpacked(model) if is_unpacked else read_file(model)
    is_text = b"\nformat ascii" in data[:_MAX_HEADER].partition(b"end_header")[0]
    by_content = [entry for entry in FORMATS if entry.starts(data)]
    formats = by_content or [entry for entry in FORMATS if entry is format_of(model)]
    if not is_text and any(entry.in_page for entry in formats):
        return as_text(f"{model.absolute().parent.name}.sog" if is_unpacked else model.name), data
    name, kind = as_text(f"{model.stem}.ply"), "a .ply in text" if is_text else f"a {model.suffix}"
    warnings.warn(
        f"{model}: the page does not read {kind}; it shows a lossless copy, {name}",
        KeyssWarning,
        stacklevel=3,
    )
    return name, model_bytes(name, gaussians)
