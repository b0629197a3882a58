"""Extra properties and comments of .ply files are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from channels.lsb.trained_like import trained_like
from cli.harness import Run, write_key
from files.test_ply import columns_of, ply_bytes
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.files.ply_table import read_vertices

COUNT = 1500
COMMENTS = b"comment Exported by the studio's tool, 2\xe9\nobj_info taken in May\n"


def write_extended(model: Gaussians, path: Path, form: str = "binary_little_endian") -> dict[str, np.ndarray]:
    """Write `model` with extra properties of several types among its own."""
    rng = np.random.default_rng(0)
    n = len(model)
    extra = {
        "label": rng.integers(-(2**31), 2**31, n),
        "nx": rng.normal(size=n).astype(np.float32),
        "confidence": rng.random(n).astype(np.float32),
        "time": rng.random(n),
        "class": rng.integers(0, 256, n),
        "f0": rng.integers(-(2**15), 2**15, n),
    }
    columns = columns_of(model)
    both = {"label": extra["label"]} | columns | extra
    kinds = {"label": "int32", "time": "double", "class": "uchar", "f0": "short"}
    data = ply_bytes(both, form=form, kinds=kinds)
    path.write_bytes(data.replace(b"element vertex", COMMENTS + b"element vertex", 1))
    return extra


def check_extras(path: Path, extra: dict[str, np.ndarray], rows: slice = slice(None)) -> None:
    with path.open("rb") as file:
        vertices = read_vertices(file)
        table = np.concatenate(list(vertices.blocks))
    assert "\n".join(vertices.comments).encode("latin-1") + b"\n" == COMMENTS
    assert list(table.dtype.names or ()) == list(
        dict.fromkeys(["label", *columns_of(trained_like(1)), *extra])
    )
    for name, values in extra.items():
        assert np.array_equal(table[name][: len(values[rows])], values[rows]), name


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_convert_keeps_extra_properties(keyss: Run, tmp_path: Path, form: str) -> None:
    model = trained_like(COUNT)
    extra = write_extended(model, tmp_path / "a.ply", form)
    result = keyss("convert", tmp_path / "a.ply", "-o", tmp_path / "b.ply")
    assert "renders the same" in result.out
    check_extras(tmp_path / "b.ply", extra)
    assert read_model(tmp_path / "b.ply").digest() == model.digest()
    assert keyss("convert", tmp_path / "a.ply", "-o", tmp_path / "c.spz").status == 0  # has no room for them


@pytest.mark.parametrize(
    ("what", "publish"),
    [
        ("--secret", ["unchanged"]),
        ("--secret", ["converted"]),
        ("--secret-file", ["unchanged"]),
        ("--secret-file", ["converted"]),
        ("--secret-file", ["converted", "--channel", "colours"]),
    ],
)
def test_hide_keeps_extra_properties(keyss: Run, tmp_path: Path, what: str, publish: list[str]) -> None:
    extra = write_extended(trained_like(COUNT), tmp_path / "cover.ply")
    write_model(tmp_path / "secret.ply", trained_like(60, 1))
    (tmp_path / "secret.txt").write_bytes(b"seven words")
    secret = tmp_path / ("secret.ply" if what == "--secret" else "secret.txt")
    key = write_key(tmp_path / "key")
    options = ["--publish", *publish, *(["--min-psnr", "0", "--width", "24"] if what == "--secret" else [])]
    out = tmp_path / "run"
    cover = tmp_path / "cover.ply"
    result = keyss("hide", "--cover", cover, what, secret, "--key-file", key, "-o", out, *options)
    assert result.status == 0, result.err
    stego = tmp_path / "run" / "publish" / "model.ply"
    check_extras(stego, extra)
    out = tmp_path / f"out{secret.suffix}"
    assert keyss("reveal", stego, "--key-file", key, "-o", out).status == 0


@pytest.mark.parametrize("start", ["scale_0", "opacity"])
def test_hide_keeps_the_header_of_another_program(keyss: Run, tmp_path: Path, start: str) -> None:
    """Properties in another order, and no normals, as gsply and trainers write them."""
    columns = columns_of(trained_like(COUNT))
    names = [name for name in columns if name not in ("nx", "ny", "nz")]
    at = names.index(start)
    data = ply_bytes({name: columns[name] for name in [*names[:3], *names[at:], *names[3:at]]})
    (tmp_path / "cover.ply").write_bytes(data)
    (tmp_path / "secret.txt").write_bytes(b"seven words")
    key = write_key(tmp_path / "key")
    arguments = ["--cover", tmp_path / "cover.ply", "--secret-file", tmp_path / "secret.txt"]
    result = keyss("hide", *arguments, "--key-file", key, "-o", tmp_path / "run")
    assert result.status == 0, result.err
    published = (tmp_path / "run" / "publish" / "model.ply").read_bytes()
    assert published.partition(b"end_header")[0] == data.partition(b"end_header")[0]
    assert published != data
    stego = tmp_path / "run" / "publish" / "model.ply"
    assert keyss("reveal", stego, "--key-file", key, "-o", tmp_path / "out").status == 0
