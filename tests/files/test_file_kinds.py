"""Messages about files that keyss does not read, by name or content."""

from __future__ import annotations

import gzip
import io
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from files.scene_files import photo
from keyss.core import InputError
from keyss.files import identify_file, load_scene, read_model

CONVERT = "convert it to .ply first, e.g. with `splat-transform IN OUT.ply`"


def zipped(name: str = "meta.json") -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr(name, "{}")
    return data.getvalue()


def checkpoint(*, new: bool) -> bytes:
    data = io.BytesIO()
    torch.save({"means": torch.zeros(3)}, data, _use_new_zipfile_serialization=new)
    return data.getvalue()


def arrays() -> bytes:
    data = io.BytesIO()
    np.savez(data, means=np.zeros(3))
    return data.getvalue()


def pictured(kind: str) -> bytes:
    data = io.BytesIO()
    Image.fromarray(photo(0)).save(data, kind)
    return data.getvalue()


FILES = {  # name and content, and what they are
    "a.spz": (gzip.compress(b"NGSP" + bytes(12)), "an SPZ model; give it where a model is asked for"),
    "A.SPZ": (b"NGSP" + bytes(12), "an SPZ model"),
    "a.sog": (zipped(), "an SOG model; give it where a model is asked for"),
    "a.splat": (bytes(64), "a .splat model; give it where a model is asked for"),
    "a.ksplat": (bytes(64), f"a .ksplat model, which keyss does not read; {CONVERT}"),
    "a.glb": (b"glTF", "a glTF file"),
    "a.lcc": (b"{}", f"an LCC model, which keyss does not read; {CONVERT}"),
    "a.pt": (checkpoint(new=True), "a checkpoint of a training; keyss never opens pickles"),
    "a.ckpt": (checkpoint(new=True), "a checkpoint of a training"),
    "a.pth": (checkpoint(new=False), "a checkpoint of a training"),
    "ckpt_6999_rank0": (checkpoint(new=True), "a checkpoint of a training"),
    "old": (checkpoint(new=False), "a checkpoint of a training"),
    "scan.laz": (b"LASF", "a point cloud; keyss hides 3DGS models"),
    "a.psht": (bytes(9), "a project of a training program; export a .ply"),
    "a.npz": (arrays(), "arrays of NumPy; export a .ply"),
    "a.obj": (b"v 0 0 0\n", "a mesh; keyss hides 3DGS models, which a training such as `keyss fit`"),
    "a.usdz": (zipped("a.usdc"), "a USD scene; export a .ply"),
    "a.csv": (b"x,y,z\n1,2,3\n", "a table; export a .ply"),
    "a.zip": (zipped(), "a ZIP archive; unpack it"),
    "a": (gzip.compress(b"1"), "gzip data; unpack it"),
    "b": (b"NGSP" + bytes(12), "an SPZ model"),
    "c": (zipped(), "a ZIP archive"),
    "d": (pictured("PNG"), "a picture"),
    "e.dat": (pictured("JPEG"), "a picture"),
    "f": (b"ply\nformat ascii 1.0\n", "a PLY file under another name; rename it to end in .ply"),
    "transforms.json": (b"{}", "a JSON file; give the folder that it lies in"),
    "g.bin": (b"\x01\x02", "a file of unknown kind"),
    "key.txt": (b"q7Rv2LxT9bWm4KzD", "a file of unknown kind"),
    "h.spz": (b"", "an empty file"),
}


READ = {"a.spz", "A.SPZ", "a.sog", "a.splat", "a.glb", "a.zip", "b", "c", "f"}


@pytest.mark.parametrize("name", FILES)
def test_identify_file(tmp_path: Path, name: str) -> None:
    content, found = FILES[name]
    (tmp_path / name).write_bytes(content)
    assert identify_file(tmp_path / name).startswith(found)
    assert "q7R" not in identify_file(tmp_path / name)
    with pytest.raises(InputError) as refused:
        load_scene(tmp_path / name)
    assert f"{tmp_path / name}: expected a scene folder, found {found}" in str(refused.value)
    if name in READ:  # as what it is, whatever its name, and then found damaged
        return
    with pytest.raises(InputError) as refused:
        read_model(tmp_path / name)
    assert f"{tmp_path / name}: expected a 3DGS model (.compressed.ply, .ply, " in str(refused.value)
    assert f"), found {found}" in str(refused.value)


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        ("page.spz", b"<!DOCTYPE html>", "a web page"),
        ("random.sog", bytes(range(99)), "a file of unknown kind"),
        ("sent.ply", gzip.compress(b"ply\nformat ascii 1.0\n"), "gzip data; unpack it"),
    ],
    ids=["web page", "noise", "gzip"],  # not the contents: gzip's has the time
)
def test_content_contradicts_the_name(tmp_path: Path, name: str, content: bytes, found: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"{name}: expected a 3DGS model .*, found {found}"):
        read_model(tmp_path / name)


def test_pipes_do_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert identify_file(tmp_path / "pipe") == "neither a file nor a folder"
    with pytest.raises(InputError, match=r"expected a 3DGS model .*, found neither a file nor a folder"):
        read_model(tmp_path / "pipe")
