"""hide, reveal, view and convert on models as other programs write them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import gsply
import numpy as np
import pytest
from numpy.lib.recfunctions import append_fields, repack_fields
from plyfile import PlyData, PlyElement

from channels.lsb.trained_like import trained_like
from cli.harness import Run, write_key
from keyss.files import read_model, write_model

Write = Callable[[Path, np.ndarray], None]
COUNT = 800


def plyfile_writer(*more: PlyElement, first: bool = False, **options: object) -> Write:
    """Write with plyfile, with other elements before or after the Gaussians."""

    def write(path: Path, rows: np.ndarray) -> None:
        own = [PlyElement.describe(rows, "vertex")]
        PlyData([*more, *own] if first else [*own, *more], **options).write(str(path))

    return write


def write_doubles(path: Path, rows: np.ndarray) -> None:
    plyfile_writer(byte_order=">")(path, rows.astype([(name, "f8") for name in rows.dtype.names]))


def write_labels(path: Path, rows: np.ndarray) -> None:
    """Add point colours and object numbers."""
    kinds = {"red": "u1", "green": "u1", "blue": "u1", "segment": "i4"}
    values = [np.arange(len(rows)).astype(kind) for kind in kinds.values()]
    plyfile_writer()(path, append_fields(rows, list(kinds), values, usemask=False))


def write_sorted_properties(path: Path, rows: np.ndarray) -> None:
    names = [name for name in sorted(rows.dtype.names) if not name.startswith("n")]
    plyfile_writer()(path, repack_fields(rows[names]))


def write_crlf(path: Path, rows: np.ndarray) -> None:
    plyfile_writer()(path, rows)
    header, end, data = path.read_bytes().partition(b"end_header\n")
    path.write_bytes((header + end).replace(b"\n", b"\r\n") + data)


def value_writer(**values: float) -> Write:
    """Overwrite values of the first half of the Gaussians."""

    def write(path: Path, rows: np.ndarray) -> None:
        for name, value in values.items():
            rows[name][: len(rows) // 2] = value
        plyfile_writer()(path, rows)

    return write


def write_gsply(path: Path, rows: np.ndarray) -> None:
    plyfile_writer()(path, rows)
    gsply.plywrite(str(path), gsply.plyread(str(path)))


FACES = PlyElement.describe(np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))]), "face")
CAMERA = PlyElement.describe(np.zeros(1, [("view_px", "f4"), ("frame", "i4")]), "camera")
KINDS: dict[str, Write] = {
    "big-endian doubles": write_doubles,
    "text": plyfile_writer(text=True),
    "a camera before the Gaussians": plyfile_writer(CAMERA, first=True, comments=["SH degree 1"]),
    "faces behind the Gaussians": plyfile_writer(FACES),
    "labels": write_labels,
    "properties by name, no normals": write_sorted_properties,
    "lines that end as on Windows": write_crlf,
    "gsply": write_gsply,
    "quaternions of length 0": value_writer(rot_0=0, rot_1=0, rot_2=0, rot_3=0),
    "round and opaque": value_writer(scale_0=-4, scale_1=-4, scale_2=-4, opacity=20),
    "one stray Gaussian": lambda path, rows: value_writer(x=0)(path, np.append(rows, move_far_out(rows[:1]))),
    "copies of one Gaussian": lambda path, rows: plyfile_writer()(path, np.repeat(rows[:1], len(rows))),
}


def move_far_out(rows: np.ndarray) -> np.ndarray:
    rows = rows.copy()
    rows["y"] = 1e9
    return rows


@pytest.mark.parametrize("kind", KINDS)
def test_hide_reveal_view_convert(keyss: Run, tmp_path: Path, kind: str) -> None:
    model, run, revealed = tmp_path / "model.ply", tmp_path / "run", tmp_path / "revealed.ply"
    write_model(model, trained_like(COUNT, 0, 1))
    write_model(tmp_path / "secret.ply", trained_like(30, 1, 1))
    KINDS[kind](model, PlyData.read(str(model))["vertex"].data.copy())
    key = write_key(tmp_path / "key.txt")
    secret = ("--secret", tmp_path / "secret.ply", "--key-file", key)
    result = keyss("hide", "--cover", model, *secret, "--width", 24, "--iterations", 5, "-o", run)
    assert result.status == 0, result.err
    result = keyss("reveal", run / "publish" / "model.ply", "--key-file", key, "-o", revealed)
    assert result.status == 0, result.err
    assert len(read_model(revealed)) == 30
    assert keyss("view", model, "-o", tmp_path / "page.html").status == 0
    result = keyss("convert", model, "-o", tmp_path / "model.spz")
    assert result.status == 0 or (kind == "one stray Gaussian" and "remove Gaussians far out" in result.err)
