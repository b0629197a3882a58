"""The viewer as files: one page that has everything in it, or a folder for a static host.

The page asks nobody for anything: its content security policy allows no other host, and where everything is
in one file, not even the host that it came from. No secret is in it, only the model that is published anyway.
"""

from __future__ import annotations

import hashlib
import html
from base64 import b64encode
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from keyss.core.errors import InputError, OutputError, UsageError
from keyss.files.atomic import write_bytes
from keyss.files.output import check_not_an_input, check_output_file
from keyss.viewer.showing import shown

SCRIPT, STYLE, LICENCES, INDEX = "viewer.js", "viewer.css", "licences.txt", "index.html"
MAX_IN_ONE_FILE = 64 << 20  # bytes of a model; browsers take text of 512 MiB, and time for it
MAX_BYTES = 2 << 30
# Argon2id is WebAssembly; workers, and pictures that are saved, come from blobs that the page makes itself.
_WASM, _SELF = "'wasm-unsafe-eval'", "'self'"
_NOTHING = "object-src 'none'; base-uri 'none'; form-action 'none'"


def served_policy() -> str:
    """The content security policy of a page whose parts lie beside it."""
    scripts = f"script-src {_SELF} {_WASM}; worker-src {_SELF} blob:"
    return f"default-src {_SELF}; {scripts}; img-src {_SELF} blob: data:; {_NOTHING}"


def page_beside(model: str, up: str = "-y") -> bytes:
    """The page for `model`, the address of a file beside it; style and script lie beside it too."""
    return _served("keyss-model", model, up)


def page_live(state: str, up: str = "-y") -> bytes:
    """The page for a training that goes on; `state`: the address of what `keyss.viewer.live` says of it."""
    return _served("keyss-live", state, up)


def page_with(model: bytes, name: str, up: str = "-y") -> bytes:
    """The page with the `model` and everything else in it; `name` is shown, `up` is "-y", "z" or "y"."""
    style, script = asset(STYLE).decode(), asset(SCRIPT).decode()
    data = f'<script id="model" type="application/octet-stream" data-name="{html.escape(name)}">'
    scripts = f"script-src {_hash(script)} {_WASM}; worker-src blob:"
    rules = f"{scripts}; style-src {_hash(style)}; img-src blob: data:; {_NOTHING}"
    return _page(
        policy=f"default-src 'none'; {rules}",
        style=f"<style>{style}</style>",
        model=data + b64encode(model).decode() + "</script>",
        script=f"<!-- {_comment(asset(LICENCES).decode())} -->\n<script>{script}</script>",
        up=up,
    )


def embedding_rules() -> dict[str, str]:
    """What the policy of a page that has `page_with` in a frame has to allow: sources by directive."""
    script = f"{_hash(asset(SCRIPT).decode())} {_WASM}"
    return {"script-src": script, "worker-src": "blob:", "img-src": "blob: data:"}


def export_html(
    model: Path | str, out: Path | str, *, up: str = "-y", overwrite: bool = False
) -> tuple[Path, ...]:
    """Write the viewer with the published `model`: one file, or a folder where `out` does not end in .html.

    One file opens from disk; a folder, for larger models, has to be served. `up`: "-y", as captures made with
    COLMAP have it, "z" or "y". A model of a format that the page does not read is converted, with a
    KeyssWarning. Returns what was written.
    Raises UsageError for a model that is too large, InputError for what is none, OutputError.
    """
    model, out = Path(model), Path(out)
    found = shown(model)
    if found.bytes > MAX_BYTES:
        raise UsageError(f"{model} has {found.bytes:,} bytes, and a page takes {MAX_BYTES:,}")
    try:
        with found.open() as file:
            data = file.read()
    except OSError as error:
        raise InputError(f"{model}: cannot be read: {error.strerror}") from error
    if out.suffix.lower() in (".html", ".htm"):
        if len(data) > MAX_IN_ONE_FILE:
            raise UsageError(
                f"{model} has {len(data):,} bytes, and one page takes {MAX_IN_ONE_FILE:,}: name a folder "
                "for the output, which a web server can serve"
            )
        check_not_an_input(out, [model])
        write_bytes(check_output_file(out, overwrite), page_with(data, found.name, up))
        return (out,)
    contents = {INDEX: page_beside(quote(found.name), up), found.name: data}
    contents |= {name: asset(name) for name in (SCRIPT, STYLE, LICENCES)}
    if len(contents) < 5:
        raise UsageError(f"{model} has the name of a file of the viewer: give it another one")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    for name in contents:
        check_not_an_input(out / name, [model])
        check_output_file(out / name, overwrite)
    for name, content in contents.items():
        write_bytes(out / name, content)
    return tuple(out / name for name in contents)


def asset(name: str) -> bytes:
    """A file of the built application."""
    return files("keyss.viewer").joinpath("assets", name).read_bytes()


def _served(name: str, content: str, up: str) -> bytes:
    return _page(
        policy=served_policy(),
        style=f'<link rel="stylesheet" href="{STYLE}">',
        model=f'<meta name="{name}" content="{html.escape(content)}">',
        script=f'<script src="{SCRIPT}"></script>',
        up=up,
    )


def _page(*, up: str = "-y", **parts: str) -> bytes:
    page = asset("page.html").decode().replace('data-up="-y"', f'data-up="{html.escape(up)}"')
    policy = f'<meta http-equiv="Content-Security-Policy" content="{html.escape(parts.pop("policy"))}">'
    for name, part in {"policy": policy, **parts}.items():
        before, found, after = page.partition(f"<!--{name}-->")
        assert found, name
        page = before + part + after
    return page.encode()


def _hash(text: str) -> str:
    return f"'sha256-{b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _comment(text: str) -> str:
    """Text that ends no comment."""
    return text.replace("--", "- -")
