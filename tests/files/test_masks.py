"""Masks of photos, as Nerfstudio and COLMAP have them: what they leave out."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from files.scene_files import HEIGHT, WIDTH, save, write_colmap, write_json, write_nerfstudio
from keyss.core import InputError, KeyssWarning, Scene
from keyss.files import load_scene

LEFT = np.zeros((HEIGHT, WIDTH), np.uint8)
LEFT[:, : WIDTH // 2] = 255  # the left half counts


def masked_nerfstudio(folder: Path, mask: np.ndarray | None = LEFT, **extra: object) -> Path:
    """A scene of 3 photos, the second of which has a mask."""
    write_nerfstudio(folder, **extra)
    meta = json.loads((folder / "transforms.json").read_text())
    meta["frames"][1]["mask_path"] = "masks/1.png"
    write_json(folder / "transforms.json", meta)
    if mask is not None:
        save(folder / "masks" / "1.png", mask)
    return folder


def masks_of(scene: Scene) -> list[torch.Tensor | None]:
    return [view.mask for view in sorted(scene.views, key=lambda view: view.camera.name)]


@pytest.mark.parametrize("values", ["0 and 255", "0 and 1", "colours", "Booleans"])
def test_mask_path_in_transforms_json(tmp_path: Path, values: str) -> None:
    kinds = {"0 and 1": LEFT // 255, "colours": np.dstack([LEFT] * 3), "Booleans": LEFT > 0}
    with pytest.warns(KeyssWarning, match="1 of 3 photos have masks, which leave 50% of their pixels out"):
        scene = load_scene(masked_nerfstudio(tmp_path, kinds.get(values, LEFT)))
    first, second, third = masks_of(scene)
    assert (first, third) == (None, None)
    assert second is not None
    assert torch.equal(second, torch.from_numpy(LEFT > 0))


def test_scene_digest_includes_masks(tmp_path: Path) -> None:
    digests = {load_scene(write_nerfstudio(tmp_path)).digest()}
    for mask in (LEFT, np.flip(LEFT, 1)):
        with pytest.warns(KeyssWarning, match="masks"):
            digests.add(load_scene(masked_nerfstudio(tmp_path, mask)).digest())
    assert len(digests) == 3


@pytest.mark.parametrize("name", ["01.png.png", "01.png", "01.PNG"])
def test_masks_of_colmap(tmp_path: Path, name: str) -> None:
    save(write_colmap(tmp_path) / "masks" / name, LEFT)
    with pytest.warns(KeyssWarning, match="1 of 3 photos have masks"):
        scene = load_scene(tmp_path)
    assert [mask is not None for mask in masks_of(scene)] == [False, True, False]


def test_masks_without_photos(tmp_path: Path) -> None:
    save(write_colmap(tmp_path) / "masks" / "mask-1.png", LEFT)
    with pytest.warns(KeyssWarning, match=r"no mask is used.*expected 00\.png\.png"):
        scene = load_scene(tmp_path)
    assert masks_of(scene) == [None] * 3


def test_resampled_masks_cover_partly_masked_pixels(tmp_path: Path) -> None:
    hole = np.full((HEIGHT, WIDTH), 255, np.uint8)
    hole[3, 4] = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)
        half = masks_of(load_scene(masked_nerfstudio(tmp_path / "a", hole), width=WIDTH // 2))[1]
        bent = masks_of(load_scene(masked_nerfstudio(tmp_path / "b", hole, k1=0.3)))[1]
        coarse = masks_of(load_scene(masked_nerfstudio(tmp_path / "c", hole[1::2, ::2])))[1]
    covered = [(~mask).nonzero().tolist() for mask in (half, bent, coarse) if mask is not None]
    assert covered[0] == [[1, 2]]
    assert 1 <= len(covered[1]) <= 4
    assert covered[2] == [[2, 4], [2, 5], [3, 4], [3, 5]]


def test_unusable_masks(tmp_path: Path) -> None:
    wrong = {"black": np.zeros_like(LEFT), "another aspect": LEFT[:-2], "absent": None}
    said = (
        r"1\.png: .* found a black one",
        r"1\.png: .* aspect, 12x8, found 12x6",
        r"1\.png: .*no such file",
    )
    for (kind, mask), expected in zip(wrong.items(), said, strict=True):
        with pytest.raises(InputError, match=expected):
            load_scene(masked_nerfstudio(tmp_path / kind, mask))
    folder = masked_nerfstudio(tmp_path / "outside")
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace("masks/1.png", "/etc/passwd"))
    with pytest.raises(InputError, match="expected paths in the scene's folder"):
        load_scene(folder)
