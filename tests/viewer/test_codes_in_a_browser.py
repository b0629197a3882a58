"""Secrets in the codes of published files, end to end in headless Chromium."""

from __future__ import annotations

from pathlib import Path

import pytest

from keyss.channels import SUFFIXES, channel_for
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.methods import embed_models
from keyss.viewer import export_html
from viewer.browser import CLOSE, IN_CHROMIUM, POSE, Visit, drawn, made, psnr

pytestmark = IN_CHROMIUM

KEYS = ("the first key", "ein zweiter Schlüssel")
PUBLISHED = dict[str, tuple[Path, list[Gaussians]]]


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> PUBLISHED:
    """By format a page with a model of 4,000 Gaussians, and what its two keys open."""
    folder, found = tmp_path_factory.mktemp("published"), {}
    for publish, suffix in SUFFIXES.items():
        room = channel_for(publish).prepare(made(4000, 0))  # type: ignore[arg-type]
        secrets = [made(100, seed).with_sh_degree(1) for seed in (1, 2)]
        hidden = embed_models(room, KEYS, secrets, entropy=bytes(32))
        write_model(folder / f"stego{suffix}", hidden.gaussians)
        (page,) = export_html(folder / f"stego{suffix}", folder / f"{publish}.html")
        found[suffix] = page, [each.reveal(hidden.gaussians) for each in hidden.opened]
    return found


@pytest.mark.parametrize("suffix", SUFFIXES.values())
def test_two_keys_open_two_secrets_and_a_wrong_one_nothing(
    tab: Visit, published: PUBLISHED, suffix: str, tmp_path: Path
) -> None:
    page, secrets = published[suffix]
    tab.goto(page.as_uri() + POSE)
    cover = tab.picture()
    assert psnr(cover, drawn(read_model(page.parent / f"stego{suffix}"), POSE)) > CLOSE
    tab.finds_nothing("another key")
    for key, secret in zip(KEYS, secrets, strict=True):
        tab.try_key(key)
        tab.at(POSE)
        shown = tab.picture()
        assert psnr(shown, drawn(secret, POSE)) > CLOSE > psnr(shown, cover)
        tab.saved("#download", tmp_path / "secret.ply")
        assert read_model(tmp_path / "secret.ply").digest() == secret.digest()


@pytest.mark.alone
def test_a_wrong_key_takes_as_long_as_a_right_one(tab: Visit, published: PUBLISHED) -> None:
    tab.goto(published[".spz"][0].as_uri())
    tab.takes_as_long_for_each("wrong", KEYS[0], "wrong again", KEYS[1])
