"""Secrets that were published as any format, end to end in headless Chromium."""

from __future__ import annotations

from pathlib import Path

import pytest

from keyss.channels import channel_for
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.methods import HiddenFile, embed_models
from keyss.viewer import export_html
from measure.lifelike import lifelike
from viewer.browser import CLOSE, IN_CHROMIUM, POSE, Visit, drawn, made, psnr

pytestmark = IN_CHROMIUM

KEY = "the first key"
SUFFIXES = (".ply", ".spz", ".sog")


@pytest.fixture(scope="module")
def secret() -> Gaussians:
    return made(100, 1).with_sh_degree(1)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory, secret: Gaussians) -> tuple[Path, Gaussians]:
    """A folder with a model as it was published and as others converted it, and what its key opens."""
    folder = tmp_path_factory.mktemp("published")
    room = channel_for("any", "appended").prepare(made(4000, 0))
    hidden = embed_models(room, [KEY], [secret], entropy=bytes(32))
    write_model(folder / "stego.ply", hidden.gaussians)
    for suffix in SUFFIXES[1:]:
        write_model(folder / f"stego{suffix}", read_model(folder / "stego.ply"))
    return folder, hidden.opened[0].reveal(hidden.gaussians)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_key_opens_the_scene_and_a_wrong_one_nothing(
    tab: Visit, published: tuple[Path, Gaussians], secret: Gaussians, suffix: str
) -> None:
    folder, revealed = published
    stego = folder / f"stego{suffix}"
    (page,) = export_html(stego, folder / f"{suffix[1:]}.html")
    tab.goto(page.as_uri() + POSE)
    cover = tab.picture()
    assert psnr(cover, drawn(read_model(stego), POSE)) > CLOSE
    tab.finds_nothing("another key")
    tab.try_key(KEY)
    tab.at(POSE)
    shown = tab.picture()
    assert psnr(shown, drawn(secret, POSE)) > CLOSE > psnr(shown, cover)
    tab.saved("#download", folder / "secret.ply")
    assert read_model(folder / "secret.ply").digest() == revealed.digest()


def test_a_file_in_colours_is_saved_and_all_keys_look_alike(tab: Visit, tmp_path: Path) -> None:
    note = HiddenFile("a note.txt", b"Written at noon, read at night.\n")
    room = channel_for("any", "colours").prepare(lifelike(6000, 0).with_sh_degree(0))
    write_model(tmp_path / "stego.spz", room.embed([(KEY, note.payload())], entropy=bytes(32)))
    tab.goto(export_html(tmp_path / "stego.spz", tmp_path / "page.html")[0].as_uri())
    seen = []
    for key in ("another key", KEY):
        tab.page.evaluate(
            """() => {
                window.seen = [];
                const shown = document.getElementById('progress');
                const note = () => window.seen.push(shown.value);
                new MutationObserver(note).observe(shown, { attributeFilter: ['value'] });
            }"""
        )
        tab.try_key(key)
        assert tab.page.locator("#save").is_visible() == (key == KEY)
        seen.append(list(dict.fromkeys(tab.page.evaluate("window.seen"))))
    assert seen[0] == seen[1]
    assert len(seen[0]) > 17
    assert tab.page.locator("#save").inner_text() == f"Save a note.txt ({len(note.data)} bytes)"
    assert tab.saved("#save", tmp_path / "note.txt") == note.name
    assert (tmp_path / "note.txt").read_bytes() == note.data


@pytest.mark.alone
def test_a_wrong_key_takes_as_long_as_a_right_one(tab: Visit, published: tuple[Path, Gaussians]) -> None:
    folder, _ = published
    tab.goto(export_html(folder / "stego.spz", folder / "timed.html")[0].as_uri())
    tab.takes_as_long_for_each("wrong", KEY, "wrong again", KEY)
