"""The public functions on files."""

from __future__ import annotations

import difflib
import inspect
import json
import re
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import torch
from numpy.lib.recfunctions import unstructured_to_structured
from plyfile import PlyData, PlyElement

import keyss
from keyss import CarryOptions, FitConfig, Secret, SecretFile
from keyss.cli import main
from keyss.core import InputError, OutputError, Scene, UsageError, WrongKeyError
from keyss.progress import Reporter
from tiny_scenes import HEIGHT, WIDTH, random_gaussians, tiny_scene

CONFIG = CarryOptions(
    fit=FitConfig(iterations=60, max_gaussians=300, grow_start=0.2, grow_every=20, evaluate_every=0, seed=0),
    fine_tune="always",
)
ANY = replace(CONFIG, publish="converted")  # so small a cover has no room


def test_progress_is_shown_by_default(capsys: pytest.CaptureFixture[str]) -> None:
    config = replace(CONFIG.fit, iterations=2)
    keyss.fit(tiny_scene(0), config=config)
    assert "2 steps" in capsys.readouterr().err
    keyss.fit(tiny_scene(0), config=config, reporter=Reporter())
    assert capsys.readouterr().err == ""


def write_nerfstudio(
    folder: Path,
    scene: Scene,
    *,
    scale: float = 1.0,
    rotation: np.ndarray | None = None,
    shift: tuple[float, ...] = (0.0, 0.0, 0.0),
    points: bool = False,
) -> Path:
    """Write a scene in Nerfstudio's layout, transformed in double precision."""
    (folder / "images").mkdir(parents=True)
    rotation = np.eye(3) if rotation is None else rotation
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = []
    for view in sorted(scene.views, key=lambda view: view.camera.name):
        camera = view.camera
        cv2.imwrite(str(folder / "images" / camera.name), view.image.numpy()[:, :, ::-1])
        pose = np.linalg.inv(camera.viewmat.double().numpy())
        pose[:3, :3] = rotation @ pose[:3, :3]
        pose[:3, 3] = scale * rotation @ pose[:3, 3] + shift
        frames.append({"file_path": f"images/{camera.name}", "transform_matrix": (pose @ flip).tolist()})
    K = scene.train[0].camera.K
    intrinsics = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    data = {"w": WIDTH, "h": HEIGHT, **intrinsics, "frames": frames}
    if points:
        data["ply_file_path"] = "points.ply"
        moved = scale * scene.points.double().numpy() @ rotation.T + shift
        rows = unstructured_to_structured(moved, names=list("xyz"))
        PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "points.ply"))
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def psnr_of_pictures(model: Path, scene: Path, width: int | None = None) -> float:
    """Mean over the test views of a scene, independent of keyss's measures."""
    pictures = [picture for _, picture in keyss.render(model, scene, views=keyss.ViewOptions(width))]
    errors = [
        (picture.float() - view.image.float()).square().mean() / 255**2
        for picture, view in zip(pictures, keyss.load_scene(scene, width=width).test, strict=True)
    ]
    return float(-10 * torch.stack(errors).log10().mean())


@pytest.fixture(scope="module")
def run(folders: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "hidden"
    keyss.hide(folders[0], [Secret(folders[1], "the key")], method=ANY, out=out)
    return out


def test_evaluate_reproduces_metrics(run: Path) -> None:
    before = json.loads((run / "private" / "metrics.json").read_text())
    after = keyss.evaluate(run, ["the key"])
    assert json.loads(msgspec.json.encode(after)) == before
    assert json.loads((run / "private" / "metrics.json").read_text()) == before
    with pytest.raises(WrongKeyError):
        keyss.evaluate(run, ["another"])


def test_metrics_match_revealed_file(run: Path, folders: tuple[Path, Path], tmp_path: Path) -> None:
    secret = keyss.reveal(run / "publish" / "model.ply", "the key", out=tmp_path / "secret.ply").gaussians
    again = keyss.read_model(tmp_path / "secret.ply")
    assert torch.equal(secret.means, again.means)
    assert torch.equal(secret.sh, again.sh)
    metrics = json.loads((run / "private" / "metrics.json").read_text())
    psnr = psnr_of_pictures(tmp_path / "secret.ply", folders[1])
    assert psnr == pytest.approx(metrics["secrets"][0]["psnr"], abs=0.1)


def test_hide_is_deterministic(run: Path, folders: tuple[Path, Path], tmp_path: Path) -> None:
    keyss.hide(folders[0], [Secret(folders[1], "the key")], method=ANY, out=tmp_path / "again")
    for name in ("publish/model.ply", "private/secret-1.ply"):
        assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes()


def test_existing_outputs_are_refused(run: Path, folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "x.ply").write_text("mine")
    with pytest.raises(OutputError, match="exists"):
        keyss.reveal(run / "publish" / "model.ply", "the key", out=tmp_path / "x.ply")
    with pytest.raises(OutputError, match="exists"):
        keyss.hide(folders[0], [Secret(folders[1], "k")], method=CONFIG, out=tmp_path)
    with pytest.raises(OutputError, match="exists"):
        keyss.fit(folders[0], out=tmp_path)
    assert (tmp_path / "x.ply").read_text() == "mine"
    keyss.reveal(run / "publish" / "model.ply", "the key", out=tmp_path / "x.ply", overwrite=True)
    assert len(keyss.read_model(tmp_path / "x.ply"))


def test_render_output_files(run: Path, folders: tuple[Path, Path], tmp_path: Path) -> None:
    pictures = keyss.render(run / "publish" / "model.ply", folders[0], out=tmp_path / "images")
    assert {p.name for p in (tmp_path / "images").iterdir()} == {"private", *(name for name, _ in pictures)}
    name, image = pictures[0]
    read = cv2.imread(str(tmp_path / "images" / name))
    assert np.array_equal(read[:, :, ::-1], image.numpy())
    assert len(keyss.render(run / "publish" / "model.ply", folders[0], split="all")) == 16
    for name in ("turn.mp4", "turn.GIF", "view.png"):
        with pytest.raises(UsageError, match=r"\.webp"):
            keyss.render(run / "publish" / "model.ply", out=tmp_path / name)
        assert not (tmp_path / name).exists()


def test_info(run: Path, folders: tuple[Path, Path]) -> None:
    def info(path: Path) -> dict[str, Any]:
        facts: dict[str, Any] = msgspec.to_builtins(keyss.info(path))
        return facts

    assert info(run / "publish" / "model.ply")["sh_degree"] == 3
    assert info(run / "publish" / "model.ply").keys() == info(run / "private" / "cover.ply").keys()
    assert info(folders[0])["test_views"] == 2
    assert info(run)["metrics"]["gaussians"] == len(keyss.read_model(run / "publish" / "model.ply"))
    with pytest.raises(InputError, match="does not exist"):
        keyss.info(run / "nothing")


def test_secret_repr_omits_key() -> None:
    assert "hunter2" not in repr(Secret("scene", "hunter2")) + repr(keyss.SecretFile("file", "hunter2"))


def test_invalid_keys(folders: tuple[Path, Path], tmp_path: Path) -> None:
    scene, other = folders
    for keys, words in ((["key", "key"], "same key"), (["\u212b", "\u00c5"], "same key"), ([""], "empty")):
        with pytest.raises(UsageError, match=words):
            keyss.hide(scene, [Secret(other, key) for key in keys], method=CONFIG, out=tmp_path / "run")
    with pytest.raises(UsageError, match="1 to 256 secrets"):
        keyss.hide(scene, [], method=CONFIG, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_command_line_matches_api(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KEYSS_KEY", "the key")
    for index, count in enumerate((1500, 700)):
        keyss.write_model(tmp_path / f"{index}.ply", random_gaussians(count, seed=index))
    cover, secret = (tmp_path / f"{index}.ply" for index in (0, 1))
    python = CarryOptions(publish="converted", fine_tune="always").with_fit(iterations=2, seed=0)
    keyss.hide(
        cover,
        [Secret(secret, "the key")],
        method=python,
        views=keyss.ViewOptions(24),
        out=tmp_path / "python",
    )
    options = "--publish converted --fine-tune always --width 24 --iterations 2 --seed 0"
    paths = ("--cover", cover, "--secret", secret, "-o", tmp_path / "line")
    assert main(["hide", *options.split(), *map(str, paths)]) == 0
    for name in ("private/config.json", "publish/model.ply"):
        assert (tmp_path / "line" / name).read_bytes() == (tmp_path / "python" / name).read_bytes(), name
    config = json.loads((tmp_path / "line" / "private" / "config.json").read_text())["options"]
    assert (config["iterations"], config["fit"]["iterations"]) == (2, 2)
    metrics = json.loads((tmp_path / "line" / "private" / "metrics.json").read_text())
    assert metrics["iterations"] == 2


def _signatures() -> str:
    """Public names with parameters, defaults and results."""
    lines = []
    for name in sorted(keyss.__all__):
        value = getattr(keyss, name)
        lines.append(name)
        if (inspect.isclass(value) and not is_dataclass(value)) or not callable(value):
            continue
        signature = inspect.signature(value)
        for each in signature.parameters.values():
            kind = "" if each.kind is each.POSITIONAL_OR_KEYWORD else "only by name, "
            default = "" if each.default is each.empty else f" = {_default(each.default)}"
            annotation = re.sub(r"^Annotated\[(.*), CommandLineOption\(.*", r"\1", str(each.annotation))
            lines.append(f"    {kind}{each.name}: {annotation}{default}")
        if not inspect.isclass(value):
            lines.append(f"    -> {signature.return_annotation}")
    return "\n".join(lines) + "\n"


def _default(value: object) -> str:
    return "..." if "object at" in repr(value) or "factory" in repr(value) else repr(value)


def test_public_api() -> None:
    """Change `public_api.txt` only for intended breaks."""
    frozen = Path(__file__).with_name("public_api.txt").read_text(encoding="utf-8")
    difference = difflib.unified_diff(frozen.splitlines(), _signatures().splitlines(), lineterm="")
    assert "\n".join(difference) == ""


@pytest.mark.parametrize(
    ("secrets", "words"),
    [
        (["g.ply"], r"expected a list of Secret\(scene, key\), or of SecretFile, got str"),
        ("g.ply", "expected a list of Secret"),
        (Secret("g.ply", "key"), "expected a list of Secret"),
        ([], "expected 1 to"),
        ([Secret("g.ply", "key"), SecretFile(b"", "other key")], "got Secret and SecretFile"),
    ],
)
def test_secrets_say_what_is_expected(secrets: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        keyss.hide(random_gaussians(), secrets)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"min_psnr": 0}, "`min_psnr` is for hidden scenes"), ({"method": "keyss"}, "keyss hides scenes only")],
)
def test_options_of_scenes_are_refused_for_files(options: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        keyss.hide(random_gaussians(), [SecretFile(b"", "a key of a file")], **options)


def test_method_by_name_has_the_default_preset() -> None:
    chosen = [keyss.Secret(tiny_scene(1), "a key of a secret scene")]
    costs = [
        keyss.hide(tiny_scene(), chosen, method=method, publish="converted", dry_run=True).cost
        for method in ("carry", CarryOptions.preset("default"), CarryOptions.preset("quick"))
    ]
    assert [cost.steps for cost in costs] == [(1000, 2150)] * 2 + [(500, 1075)]
    with pytest.raises(UsageError, match="expected quick or default or full"):
        CarryOptions.preset("slow")
