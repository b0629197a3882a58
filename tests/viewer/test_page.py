"""The page that `keyss view` writes or serves, and its build from `web/`."""

from __future__ import annotations

import hashlib
import http.client
import os
import re
import shutil
import subprocess
import threading
from base64 import b64decode, b64encode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest

from keyss.core import InputError, OutputError, UsageError
from keyss.files import write_model
from keyss.viewer import ModelServer, asset, export_html
from tiny_scenes import random_gaussians
from viewer.browser import ROOT, WEB


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "a model & <more>.ply"
    write_model(path, random_gaussians(5))
    return path


@contextmanager
def running(server: ModelServer) -> Iterator[None]:
    thread = threading.Thread(target=server.run)
    thread.start()
    yield
    server.close()
    thread.join()


@pytest.fixture
def server(model: Path) -> Iterator[ModelServer]:
    found = ModelServer(model)
    with running(found):
        yield found


def get(
    server: ModelServer, path: str, *, folder: str | None = None, hosts: list[str] | None = None
) -> tuple[int, bytes, dict[str, str]]:
    """Status, content and headers of a request with the given `Host` headers."""
    where = urlsplit(server.address)
    connection = http.client.HTTPConnection(where.hostname or "", where.port, timeout=10)
    connection.putrequest("GET", (where.path if folder is None else folder) + path, skip_host=True)
    for host in [where.netloc] if hosts is None else hosts:
        connection.putheader("Host", host)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.getheaders())


def test_single_file_page(model: Path, tmp_path: Path) -> None:
    (out,) = export_html(model, tmp_path / "page.html")
    page = out.read_text()
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    script = re.search(r"<script>(.*?)</script>", page, re.DOTALL)
    assert script[1] == asset("viewer.js").decode()  # contains no </script>
    digest = b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    assert f"script-src &#x27;sha256-{digest}&#x27;" in policy[1]
    assert policy[1].startswith("default-src &#x27;none&#x27;;")
    assert "unsafe-inline" not in policy[1]
    assert "unsafe-eval" not in policy[1].replace("wasm-unsafe-eval", "")
    data = re.search(r'data-name="a model &amp; &lt;more&gt;.ply">([^<]*)</script>', page)
    assert b64decode(data[1]) == model.read_bytes()
    assert "PlayCanvas" in page
    assert not re.search(r'(src|href)="', page)


def test_folder_page(model: Path, tmp_path: Path) -> None:
    written = export_html(model, tmp_path / "site")
    names = {path.name for path in written}
    assert names == {"index.html", "viewer.js", "viewer.css", "embed.js", "licences.txt", model.name}
    assert (tmp_path / "site" / model.name).read_bytes() == model.read_bytes()
    assert 'name="keyss-model" content="a%20model%20%26%20%3Cmore%3E.ply"' in written[0].read_text()
    with pytest.raises(OutputError, match="exists"):
        export_html(model, tmp_path / "site")
    export_html(model, tmp_path / "site", overwrite=True)


@pytest.mark.parametrize(("out", "page"), [("page.html", "page.html"), ("site", "site/index.html")])
def test_names_that_are_not_text(model: Path, tmp_path: Path, out: str, page: str) -> None:
    named = model.rename(tmp_path / os.fsdecode(b"K\xfcche.ply"))
    export_html(named, tmp_path / out)
    assert "K\N{REPLACEMENT CHARACTER}che.ply" in unquote((tmp_path / page).read_text("utf-8"))


@pytest.mark.parametrize("out", ["page.html", "site"])
def test_undrawable_models(model: Path, tmp_path: Path, out: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = model.read_bytes()
    start = whole.index(b"end_header\n") + len(b"end_header\n")
    nan = np.full(len(whole[start:]) // 4, np.nan, "<f4").tobytes()
    empty = whole[:start].replace(b"vertex 5\n", b"vertex 0\n")
    scaled = random_gaussians(200, sh_degree=0)
    write_model(model, replace(scaled, log_scales=scaled.scales, opacity_logits=scaled.opacities))
    refused = {
        whole[:start] + nan: "NaN or infinite values",
        empty: "holds no Gaussians",
        model.read_bytes(): "export it again without activating them",
    }
    for content, message in refused.items():
        model.write_bytes(content)
        for shown in (lambda: export_html(model, tmp_path / out), lambda: ModelServer(model)):
            with pytest.raises(InputError, match=message):
                shown()
    model.write_bytes(whole)
    monkeypatch.setattr("keyss.viewer.page.MAX_BYTES", len(whole) - 1)
    with pytest.raises(UsageError, match="more than the"):
        export_html(model, tmp_path / out)
    assert not (tmp_path / out).exists()


def test_server(server: ModelServer, model: Path) -> None:
    where = urlsplit(server.address)
    assert re.fullmatch(r"/[\w-]{20,}/", where.path)
    with running(other := ModelServer(model)):
        assert urlsplit(other.address).path != where.path
    status, page, headers = get(server, "")
    assert status == 200
    assert headers["Content-Security-Policy"].startswith("default-src 'self';")
    name = re.search(rb'name="keyss-model" content="([^"]*)"', page)
    assert get(server, name[1].decode())[1] == model.read_bytes()
    assert get(server, "viewer.js")[1] == asset("viewer.js")
    for path in ("model/", "model/..%2f..%2fetc/passwd", "../../etc/passwd", "page.html", "a/b"):
        assert get(server, path)[0] == 404, path
    for path in ("/", "/viewer.js", f"/{name[1].decode()}"):  # guessable without the secret path
        assert get(server, path, folder="")[0] == 404, path
    with pytest.raises(OutputError, match="cannot serve"):
        ModelServer(model, port=where.port or 0)


@pytest.mark.parametrize(
    ("address", "served"),
    [
        ("127.0.0.1", ["127.0.0.1", "localhost", "LOCALHOST"]),
        ("127.0.0.2", ["127.0.0.2", "localhost"]),
        ("localhost", ["127.0.0.1", "localhost"]),
        ("::1", ["[::1]", "localhost"]),
    ],
)
def test_host_header(model: Path, address: str, served: list[str]) -> None:
    """Other names (DNS rebinding) are refused, however they parse."""
    try:
        found = ModelServer(model, address)
    except OutputError:
        pytest.skip(f"this machine has no address {address}")
    with running(found):
        port = urlsplit(found.address).port
        for name in served:
            assert get(found, "", hosts=[f"{name}:{port}"])[0] == 200, name
            assert get(found, "", hosts=[name])[0] == 200, name
            assert get(found, "", hosts=[f"{name}:{port}"] * 2)[0] == 403, name
        hostile = [
            "evil.example",
            "evil.example@localhost",
            "localhost#evil.example",
            "localhost/evil.example",
        ]
        hostile += ["localhost.", "[", "", "localhost:x", "localhost:1:2", "localhost:1 2", "127.0.0.3"]
        for name in hostile:
            assert get(found, "", hosts=[name])[0] == 403, name
            assert get(found, "", hosts=[served[0], name])[0] == 403, name
        assert get(found, "", hosts=[])[0] == 403


@pytest.mark.skipif(shutil.which("node") is None, reason="no node on PATH")
@pytest.mark.skipif(not (WEB / "node_modules").exists(), reason="no web/node_modules: `make web` installs it")
def test_assets_are_up_to_date(tmp_path: Path) -> None:
    subprocess.run(["node", "build.mjs", str(tmp_path)], cwd=WEB, check=True)
    shipped = ROOT / "src" / "keyss" / "viewer" / "assets"
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in shipped.iterdir()}
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (shipped / path.name).read_bytes(), f"`make web` was not run: {path.name}"
