"""Secrets of every channel in single-file pages, in headless Chromium."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

import keyss
from keyss.channels import SUFFIXES, channel_for
from keyss.channels.names import Publish
from keyss.files import read_model, write_model
from keyss.files.formats.spz import SpzCodes
from keyss.methods import HiddenFile, embed_models
from keyss.viewer import export_html
from lab.lifelike import lifelike
from viewer.browser import CLOSE, IN_CHROMIUM, KEYS, POSE, Visit, bright_model, psnr, render_pose

pytestmark = IN_CHROMIUM

PUBLISHED = {"ply": "ply"} | {suffix.removeprefix("."): publish for publish, suffix in SUFFIXES.items()}
OTHERS = (*list(PUBLISHED)[1:], "decoded.ply", "appended.ply", "appended.spz", "appended.sog")


def keys_of(kind: str) -> tuple[str, ...]:
    return KEYS if kind in PUBLISHED else KEYS[:1]


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Hides secrets in a model of a kind."""
    folder = tmp_path_factory.mktemp("published")

    @cache
    def stego(kind: str) -> Path:
        cover, format = bright_model(4000, 0), PUBLISHED.get(kind)
        if kind == "decoded.ply":
            cover = SpzCodes.of(cover).dequantise()
        publish: Publish = "converted" if kind.startswith("appended") else "unchanged"
        channel = channel_for(publish, format=format, cover=cover)  # type: ignore[arg-type]
        keys, secrets = keys_of(kind), [bright_model(100, seed).with_sh_degree(1) for seed in (1, 2)]
        model = embed_models(channel.prepare(cover), keys, secrets[: len(keys)], entropy=bytes(32)).gaussians
        write_model(folder / f"stego.{kind}", model)
        return folder / f"stego.{kind}"

    return stego


@pytest.mark.parametrize("kind", ["ply", *(pytest.param(kind, marks=pytest.mark.slow) for kind in OTHERS)])
def test_keys(tab: Visit, published: Callable[[str], Path], tmp_path: Path, kind: str) -> None:
    """Every key takes as many derivations."""
    stego = published(kind)
    tab.goto(export_html(stego, tmp_path / "page.html")[0].as_uri() + POSE)
    cover = tab.picture()
    assert psnr(cover, render_pose(read_model(stego), POSE)) > CLOSE
    work = tab.assert_finds_nothing("another key")
    assert len(work) > 1
    for key in keys_of(kind):
        revealed = keyss.reveal(stego, key).gaussians
        assert tab.try_key(key) == work
        tab.at(POSE)
        shown = tab.picture()
        assert psnr(shown, render_pose(revealed, POSE)) > CLOSE > psnr(shown, cover)
        tab.save("#download", tmp_path / "secret.ply")
        assert read_model(tmp_path / "secret.ply").digest() == revealed.digest()
    assert all(url.startswith(("file:", "blob:null/")) for url in tab.requests), tab.requests


@pytest.mark.slow
def test_file_in_colours(tab: Visit, tmp_path: Path) -> None:
    note = HiddenFile("a note.txt", b"Written at noon, read at night.\n")
    prepared = channel_for("converted", "colours").prepare(lifelike(6000, 0).with_sh_degree(0))
    write_model(tmp_path / "stego.spz", prepared.embed([(KEYS[0], note.payload())], entropy=bytes(32)))
    tab.goto(export_html(tmp_path / "stego.spz", tmp_path / "page.html")[0].as_uri())
    seen = []
    for key in ("another key", KEYS[0]):
        seen.append(tab.try_key(key, thorough=True))
        said = tab.page.locator("[role=status]").inner_text()
        assert said.startswith("The key reveals a file." if key == KEYS[0] else "This key opens nothing")
        assert tab.page.locator("#save").is_visible() == (key == KEYS[0])
    assert seen[0] == seen[1]
    assert len(seen[0]) > 17
    assert tab.page.locator("#save").inner_text() == f"Save a note.txt ({len(note.data)} bytes)"
    assert tab.save("#save", tmp_path / "note.txt") == note.name
    assert (tmp_path / "note.txt").read_bytes() == note.data
