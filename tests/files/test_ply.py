"""The Inria PLY: exact round trips, other programs, hostile bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies as st

from keyss.core import Gaussians, InputError, KeyssWarning
from keyss.files import read_model, write_model
from keyss.files.models import reads_as
from keyss.files.ply_table import LEAST_LOG_SCALE
from keyss.runs import ModelInfo
from keyss.runs.describe import info
from tiny_scenes import random_gaussians

Transform = Callable[..., Path]
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def names_of(degree: int, *, normals: bool = True) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    return [
        *("x", "y", "z"),
        *(("nx", "ny", "nz") if normals else ()),
        *("f_dc_0", "f_dc_1", "f_dc_2"),
        *rest,
        "opacity",
        *("scale_0", "scale_1", "scale_2"),
        *("rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def columns_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Each property's values by name, written independently of the writer."""
    n, k = gaussians.sh.shape[:2]
    columns = {name: gaussians.means[:, i] for i, name in enumerate("xyz")}
    columns |= {f"n{axis}": torch.zeros(n) for axis in "xyz"}
    columns |= {f"f_dc_{c}": gaussians.sh[:, 0, c] for c in range(3)}
    for c in range(3):
        columns |= {f"f_rest_{c * (k - 1) + j}": gaussians.sh[:, 1 + j, c] for j in range(k - 1)}
    columns |= {"opacity": gaussians.opacity_logits}
    columns |= {f"scale_{i}": gaussians.log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": gaussians.quats[:, i] for i in range(4)}
    return {name: values.numpy() for name, values in columns.items()}


def ply_bytes(
    columns: dict[str, np.ndarray], *, form: str = "binary_little_endian", kinds: dict[str, str] | None = None
) -> bytes:
    """A PLY with the properties in the order of `columns`; `kinds` names types other than float."""
    codes = {"float": "f4", "double": "f8", "uchar": "u1", "short": "i2", "int32": "i4"}
    kinds = {name: (kinds or {}).get(name, "float") for name in columns}
    n = len(next(iter(columns.values())))
    header = f"ply\nformat {form} 1.0\nelement vertex {n}\n"
    header += "".join(f"property {kind} {name}\n" for name, kind in kinds.items()) + "end_header\n"
    if form == "ascii":
        lines = (" ".join(repr(float(v)) for v in row) for row in zip(*columns.values(), strict=True))
        return header.encode() + "\n".join(lines).encode()
    order = ">" if form == "binary_big_endian" else "<"
    data = np.zeros(n, dtype=[(name, order + codes[kind]) for name, kind in kinds.items()])
    for name, values in columns.items():
        data[name] = values
    return header.encode() + data.tobytes()


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A small valid model of degree 1, as written by us."""
    path = tmp_path / "model.ply"
    write_model(path, random_gaussians(5, sh_degree=1))
    return path


# --- writing ---------------------------------------------------------------------------------------------


def test_inria_layout(tmp_path: Path) -> None:
    gaussians = random_gaussians(7, sh_degree=3)
    write_model(tmp_path / "a.ply", gaussians)
    expected = {name: columns_of(gaussians)[name] for name in names_of(3)}
    assert len(expected) == 62
    assert (tmp_path / "a.ply").read_bytes() == ply_bytes(expected)


# --- reading ---------------------------------------------------------------------------------------------

finite = st.floats(width=32, allow_nan=False, allow_infinity=False)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), n=st.integers(1, 3), degree=st.integers(0, 3))
def test_round_trip_is_exact(tmp_path: Path, data: st.DataObject, n: int, degree: int) -> None:
    size = n * len(names_of(degree, normals=False))
    values = torch.tensor(data.draw(st.lists(finite, min_size=size, max_size=size)), dtype=torch.float32)
    parts = values.split([3 * n, 4 * n, 3 * n, n, size - 11 * n])
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, -1, 3)]
    gaussians = Gaussians(*(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))
    write_model(tmp_path / "a.ply", gaussians)
    back = read_model(tmp_path / "a.ply")
    assert back.sh_degree == degree
    assert back.digest() == gaussians.digest()


@pytest.mark.parametrize("degree", [0, 3])
def test_reads_as(tmp_path: Path, degree: int) -> None:
    model, path = random_gaussians(9000, sh_degree=degree), tmp_path / "a.ply"
    write_model(path, model)
    assert reads_as(path, model)
    for field in ("means", "sh"):
        other = model.map(torch.clone)
        getattr(other, field)[8999].view(torch.int32).view(-1)[-1] ^= 1
        assert not reads_as(path, other)
    assert not reads_as(path, model[:8999])
    assert not reads_as(path, Gaussians.cat([model, model[:1]]))
    assert not reads_as(path, model.with_sh_degree(1))


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_property_order_and_types(tmp_path: Path, form: str, degree: int) -> None:
    """Any order, no normals, and properties of every size in between."""
    gaussians = random_gaussians(6, sh_degree=degree)
    columns = columns_of(gaussians)
    names = names_of(degree, normals=False)
    np.random.default_rng(degree).shuffle(names)
    names[4:4] = ["red", "label", "confidence", "f_extra"]
    columns |= {name: np.arange(6.0) for name in ("red", "label", "confidence", "f_extra")}
    kinds = {"red": "uchar", "label": "short", "confidence": "double", "x": "double", "f_dc_1": "double"}
    path = tmp_path / "a.ply"
    path.write_bytes(ply_bytes({name: columns[name] for name in names}, form=form, kinds=kinds))
    assert read_model(path).digest() == gaussians.digest()


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [
        ("opacity", np.nan, "float"),
        ("x", np.inf, "float"),
        ("f_rest_8", -np.inf, "float"),
        ("y", 1e60, "double"),
    ],
)
def test_rows_with_nan_or_infinity_are_left_out(tmp_path: Path, name: str, value: float, kind: str) -> None:
    model = random_gaussians(4, sh_degree=1)
    columns = columns_of(model)
    columns[name] = np.array([columns[name][0], value, value, columns[name][3]])
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns, kinds={name: kind}))
    said = rf"a.ply: 2 of 4 Gaussians are left out: they have NaN or infinite values \({name} in 2\)"
    with pytest.warns(KeyssWarning, match=said):
        found = read_model(tmp_path / "a.ply")
    assert found.digest() == model[torch.tensor([0, 3])].digest()
    with pytest.warns(KeyssWarning, match=said):
        facts = info(tmp_path / "a.ply")
    assert isinstance(facts, ModelInfo)
    assert facts.gaussians == 2
    columns[name] = np.full(4, value)
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns, kinds={name: kind}))
    with pytest.raises(InputError, match=rf"among 4 Gaussians: {name} in 4$"):
        read_model(tmp_path / "a.ply")


def test_zero_scales_are_kept(tmp_path: Path) -> None:
    """Scales of 0 are log scales of minus infinity; they are drawn as discs."""
    model = random_gaussians(4, sh_degree=0)
    columns = columns_of(model)
    columns["scale_1"] = np.array([-np.inf, -3.0, -np.inf, -3.0])
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns))
    found = read_model(tmp_path / "a.ply")
    assert found.log_scales[:, 1].tolist() == pytest.approx([LEAST_LOG_SCALE, -3.0] * 2)
    assert (found.scales > 0).all()
    write_model(tmp_path / "b.splat", found)
    assert len(read_model(tmp_path / "b.splat")) == 4


# --- models of other programs ----------------------------------------------------------------------------


@pytest.mark.parametrize("unit", [0.001, 1e6])
@pytest.mark.parametrize("which", ["scales", "opacities", "scales and opacities"])
def test_activated_scales_and_opacities_are_refused(tmp_path: Path, unit: float, which: str) -> None:
    model = random_gaussians(400, sh_degree=0)
    generator = torch.Generator().manual_seed(0)
    scales = torch.exp(torch.randn(400, 3, generator=generator) - 3)
    opacities = torch.rand(400, generator=generator)
    plain = Gaussians(unit * model.means, model.quats, (unit * scales).log(), opacities.logit(), model.sh)
    write_model(tmp_path / "plain.ply", plain)
    assert read_model(tmp_path / "plain.ply").digest() == plain.digest()
    if "scales" in which:
        plain = replace(plain, log_scales=plain.scales)
    if "opacities" in which:
        plain = replace(plain, opacity_logits=plain.opacities)
    write_model(tmp_path / "activated.ply", plain)
    for read in (read_model, info):
        with pytest.raises(InputError, match=f"its {which} are those that renderers use.* apply log to"):
            read(tmp_path / "activated.ply")


def test_2dgs_and_rgb_models(tmp_path: Path) -> None:
    columns = columns_of(random_gaussians(4, sh_degree=0))
    flat = {name: values for name, values in columns.items() if name != "scale_2"}
    (tmp_path / "a.ply").write_bytes(ply_bytes(flat))
    with pytest.raises(InputError, match=r"a\.ply: this is a 2DGS model.*SuperSplat"):
        read_model(tmp_path / "a.ply")
    rgb = {name: values for name, values in columns.items() if not name.startswith("f_dc")}
    rgb |= {name: np.full(4, 128) for name in ("red", "green", "blue")}
    kinds = dict.fromkeys(("red", "green", "blue"), "uchar")
    (tmp_path / "b.ply").write_bytes(ply_bytes(rgb, kinds=kinds))
    with pytest.raises(InputError, match="--ply-color-mode sh_coeffs"):
        read_model(tmp_path / "b.ply")


# --- what is refused -------------------------------------------------------------------------------------


def header_of(*lines: str) -> bytes:
    return "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]).encode()


XYZ = ("element vertex 1", "property float x", "property float y", "property float z")
BROKEN = {
    "empty": (b"", "found an empty file"),
    "an image": (b"\x89PNG\r\n\x1a\n" + bytes(100), "found a picture"),
    "no end": (b"ply\nformat ascii 1.0\n", "ends inside the header"),
    "no format": (b"ply\nelement vertex 1\nend_header\n", "one 'format' line"),
    "two formats": (header_of("format ascii 1.0"), "cannot parse line"),
    "future": (b"ply\nformat ascii 2.0\nend_header\n", "cannot parse line"),
    "no vertex": (header_of("element face 1"), "got 1 and 0"),
    "two vertex elements": (header_of(*XYZ, *XYZ), "got 1 and 2"),
    "property of nothing": (header_of("property float x"), "cannot parse line"),
    "property twice": (header_of(*XYZ, "property float x"), "cannot parse line"),
    "unknown type": (header_of("element vertex 1", "property half x"), "cannot parse line"),
    "list in vertex": (header_of(*XYZ, "property list uchar int f"), "list property"),
    "list before": (header_of("element a 1", "property list uchar int f", *XYZ), "list property"),
    "point cloud": (header_of(*XYZ) + bytes(12), "a mesh or point cloud, not a 3DGS model.*missing: f_dc_0"),
    "compressed": (header_of("element vertex 1", "property uint packed_position"), "compressed"),
    "no model": (
        header_of("element vertex 1", "property float u") + bytes(4),
        "not a 3DGS model.*missing: x, y, z",
    ),
    "odd f_rest": (header_of(*XYZ, "property float f_rest_0") + bytes(16), "0, 9, 24 or 45"),
    "gap in f_rest": (
        header_of(*XYZ, *(f"property float f_rest_{i + 1}" for i in range(9))) + bytes(48),
        "0, 9, 24",
    ),
    "negative": (header_of("element vertex -1"), "cannot parse line"),
    "fraction": (header_of("element vertex 1.5"), "cannot parse line"),
    "underscore": (header_of("element vertex 1_0"), "cannot parse line"),
    "word": (header_of("element vertex many"), "cannot parse line"),
    "endless line": (b"ply\ncomment " + b"a" * 100_000, "longer than"),
    "endless lines": (b"ply\n" + b"comment\n" * 20_000, "longer than"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_invalid_files(tmp_path: Path, case: str) -> None:
    data, message = BROKEN[case]
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(InputError, match=message):
        read_model(tmp_path / "a.ply")


def test_truncation(model: Path) -> None:
    data = model.read_bytes()
    body = data.index(b"end_header\n") + len(b"end_header\n")
    stride = (len(data) - body) // 5
    offsets = {*range(body + 2), *(body + row * stride + shift for row in range(5) for shift in (-1, 0, 1))}
    for offset in sorted({*offsets, len(data) - 1} - {len(data)}):
        model.write_bytes(data[:offset])
        with pytest.raises(InputError):
            read_model(model)


# --- other people's models and tools ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "count", "degree"),
    [("guitar", 90_854, 0), ("biker", 152_746, 0), ("playbot_lod2", 125_000, 2), ("playbot_lod4", 8_406, 2)],
)
def test_real_models(real_data: Path, tmp_path: Path, name: str, count: int, degree: int) -> None:
    source = real_data / "splats" / f"{name}.ply"
    gaussians = read_model(source)
    assert (len(gaussians), gaussians.sh_degree) == (count, degree)
    theirs = gsply.plyread(source)
    assert np.array_equal(gaussians.means.numpy(), theirs.means)
    assert np.array_equal(gaussians.sh[:, 0].numpy(), theirs.sh0)
    write_model(tmp_path / "a.ply", gaussians)
    assert read_model(tmp_path / "a.ply").digest() == gaussians.digest()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_round_trip(tmp_path: Path, degree: int) -> None:
    gaussians = random_gaussians(50, sh_degree=degree)
    write_model(tmp_path / "a.ply", gaussians)
    theirs = gsply.plyread(tmp_path / "a.ply")
    assert np.array_equal(theirs.means, gaussians.means.numpy())
    assert np.array_equal(theirs.scales, gaussians.log_scales.numpy())
    assert np.array_equal(theirs.quats, gaussians.quats.numpy())
    assert np.array_equal(theirs.opacities, gaussians.opacity_logits.numpy())
    assert np.array_equal(theirs.sh0, gaussians.sh[:, 0].numpy())
    assert np.array_equal(theirs.shN.reshape(50, -1, 3), gaussians.sh[:, 1:].numpy())

    gsply.plywrite(
        tmp_path / "b.ply",
        gaussians.means.numpy(),
        gaussians.log_scales.numpy(),
        gaussians.quats.numpy(),
        gaussians.opacity_logits.numpy(),
        gaussians.sh[:, 0].numpy(),
        gaussians.sh[:, 1:].numpy() if degree else None,
    )
    assert read_model(tmp_path / "b.ply").digest() == gaussians.digest()
