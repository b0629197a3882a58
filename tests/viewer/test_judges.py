"""Spark and PlayCanvas read our files."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from files.formats.examples import model_of
from keyss.files import read_model, write_model
from serving import serving
from viewer.browser import PATIENCE, PROGRAM, ROOT, WEB

pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="no Chromium on PATH"),
    pytest.mark.skipif(shutil.which("node") is None, reason="no node on PATH"),
    pytest.mark.skipif(not (WEB / "node_modules").exists(), reason="no web/node_modules: `make web`"),
]

FORMATS = ("ply", "compressed.ply", "sog", "spz")
WITH_A_SECRET = "carried.ply"
HALF = 2e-3  # spark keeps positions in half precision


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Models in every format, one with a secret, and a page with the readers."""
    folder = tmp_path_factory.mktemp("judged")
    for suffix in FORMATS:
        write_model(folder / f"model.{suffix}", model_of(500, 3))
    shutil.copy(ROOT / "tests" / "vectors" / WITH_A_SECRET, folder)
    bundle = [
        "node_modules/.bin/esbuild",
        "tests/judges.ts",
        "--bundle",
        "--log-level=error",
        f"--outdir={folder}",
    ]
    subprocess.run(bundle, cwd=WEB, check=True)
    (folder / "index.html").write_text(
        '<!doctype html><link rel="icon" href="data:,"><script src="judges.js"></script>'
    )
    return folder


@pytest.fixture(scope="module")
def page(chromium: Any, folder: Path) -> Iterator[Any]:
    page = chromium.new_page()
    page.set_default_timeout(PATIENCE)
    with serving(folder) as address:
        page.goto(address)
        yield page


@pytest.mark.parametrize(
    ("judge", "name"),
    [
        ("spark", "model.sog"),
        ("spark", WITH_A_SECRET),
        ("playcanvas", WITH_A_SECRET),
        *(
            pytest.param(judge, name, marks=pytest.mark.slow)
            for judge, name in (
                *(
                    (judge, name)
                    for judge in ("spark", "playcanvas")
                    for name in ("model.ply", "model.compressed.ply")
                ),
                ("playcanvas", "model.sog"),
                ("spark", "model.spz"),  # PlayCanvas's engine does not read it
            )
        ),
    ],
)
def test_other_readers_agree(page: Any, folder: Path, judge: str, name: str) -> None:
    found = page.evaluate(f"judges.{judge}('{name}')")
    ours = read_model(folder / name).means.numpy().astype(np.float64)
    if name.endswith(".spz"):
        ours = ours * [1, -1, -1]  # spark shows the axes of the file, which has y up
    theirs = np.array(found["means"]).reshape(-1, 3)
    assert found["count"] == len(ours) == len(theirs)
    distances = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    nearest = distances.argmin(axis=1)
    assert len(set(nearest.tolist())) == len(ours)
    assert (distances.min(axis=1) <= HALF * np.maximum(1, np.abs(ours).max(axis=1))).all()
