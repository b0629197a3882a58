"""`keyss reveal` and `keyss verify`."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from channels.lsb.quantised import codes_of, model_of
from channels.lsb.trained_like import trained_like
from cli.harness import PROGRAM, Result, Run, assert_refused, listing, write_key
from keyss.channels import LOW_BITS, Payload, QuantisedCover
from keyss.channels.colours import carriers
from keyss.channels.container import SALTS_TRIED
from keyss.channels.lsb import shards
from keyss.core import Gaussians
from keyss.files import read_model, write_model
from keyss.keys import DerivedKey
from keyss.methods.codec.model_bytes import encode
from keyss.runs.revealing import check_model
from tiny_scenes import random_gaussians

KEY = "q7Rv2LxT9bWm4KzD"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Key files; a model with a secret, whole and without a fifth; less than half of one that was full."""
    folder = tmp_path_factory.mktemp("files")
    for name, key in (("key", KEY), ("other", KEY[::-1])):
        write_key(folder / name, key)
    cover = trained_like(1500)
    prepared = LOW_BITS.prepare(cover)
    whole = prepared.embed([(KEY, Payload("carry", encode(trained_like(500, 1))))])
    data = np.random.default_rng(0).bytes(prepared.capacity.bytes)
    full = prepared.embed([(KEY, Payload("carry", data))])
    models = {"plain": cover, "whole": whole, "pruned": whole[:1200], "few": full[:700]}
    for name, model in models.items():
        write_model(folder / f"{name}.ply", model)
    return folder


@pytest.fixture
def reveal(keyss: Run, files: Path, tmp_path: Path) -> Run:
    """Reveal a model into `s.ply`."""

    def run(model: Path | str, *more: object, key: str = "key") -> Result:
        return keyss("reveal", files / model, "--key-file", files / key, "-o", tmp_path / "s.ply", *more)

    return run


def test_implausible_gaussian_count(keyss: Run, files: Path, tmp_path: Path) -> None:
    data = encode(model_of(100, sh_degree=0))
    hostile = Payload("carry", (1 << 17).to_bytes(4, "little") + data[4:])
    write_model(tmp_path / "stego.spz", QuantisedCover.of(codes_of(".spz")).embed([(KEY, hostile)]))
    for command, *out in (("reveal", "-o", tmp_path / "s.ply"), ("verify",)):
        result = keyss(command, tmp_path / "stego.spz", "--key-file", files / "key", *out)
        assert_refused(result, 4, "declares 131,072 Gaussians, more than")


class TestCounts:
    def test_whole_secret(self, reveal: Run, tmp_path: Path) -> None:
        assert reveal("whole.ply") == Result(0, f"{tmp_path}/s.ply: 500 of 500 Gaussians\n", "")

    def test_restored_secret_warning(self, reveal: Run, tmp_path: Path) -> None:
        result = reveal("pruned.ply")
        assert (result.status, result.out) == (0, f"{tmp_path}/s.ply: 500 of 500 Gaussians\n")
        assert re.match(r"keyss: warning: \d+ of [\d,]+ shards .* were lost, and restored", result.err)
        assert len(result.err.splitlines()) == 1

    def test_lost_secret(self, reveal: Run, tmp_path: Path) -> None:
        assert_refused(reveal("few.ply"), 4, "the key is right, but too much of the model was lost")
        assert listing(tmp_path) == {}


class TestOpensNothing:
    """A plain model, a wrong key and lost low bits give the same message after the same work."""

    @pytest.fixture
    def work(self, monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
        """Counts of derived keys and AES blocks."""
        done = {"keys": 0, "blocks": 0}
        encrypt, derive = shards.encrypted_blocks, DerivedKey.of

        def counted(key: bytes, data: np.ndarray) -> np.ndarray:
            done["blocks"] += data.size // 16
            return encrypt(key, data)

        def derived(key: str, salt: bytes) -> DerivedKey:
            done["keys"] += 1
            return derive(key, salt)

        monkeypatch.setattr(shards, "encrypted_blocks", counted)
        monkeypatch.setattr(DerivedKey, "of", derived)
        return done

    def test_failures_are_indistinguishable(
        self, reveal: Run, files: Path, tmp_path: Path, work: dict[str, int]
    ) -> None:
        erased = read_model(files / "whole.ply")
        rounded = erased.map(lambda values: (values * 2**10).round() / 2**10)
        write_model(tmp_path / "rounded.ply", rounded)
        attempts = [("plain.ply", "key"), ("whole.ply", "other"), (tmp_path / "rounded.ply", "key")]
        result, made = [], []
        for model, key in attempts:
            work.update(keys=0, blocks=0)
            result.append(reveal(model, key=key))
            made.append(dict(work))
        assert result[0] == result[1] == result[2]
        assert made[0]["keys"] == made[1]["keys"] == made[2]["keys"]
        assert max(each["blocks"] for each in made) < 1.05 * min(each["blocks"] for each in made)
        assert made[0]["keys"] == SALTS_TRIED + carriers.SALTS + 1  # low bits, then colours
        assert_refused(result[0], 3, "opens nothing here")
        for word in ("another key", "converted or quantised", "moved", "trained on"):
            assert word in result[0].err


@pytest.mark.parametrize("how", ["same", "symlink", "hardlink"])
def test_input_is_never_overwritten(keyss: Run, files: Path, tmp_path: Path, how: str) -> None:
    model = tmp_path / "stego.ply"
    shutil.copy(files / "whole.ply", model)
    out = model if how == "same" else tmp_path / "link.ply"
    if how == "symlink":
        out.symlink_to(model)
    elif how == "hardlink":
        os.link(model, out)
    before = listing(tmp_path)
    result = keyss("reveal", model, "--key-file", files / "key", "-o", out, "--overwrite")
    assert_refused(result, 2, "is the input")
    assert listing(tmp_path) == before


def program(*arguments: object, data: bytes = b"", **more: str) -> tuple[int, bytes, str]:
    done = subprocess.run(
        [*PROGRAM, *map(str, arguments)],
        input=data,
        capture_output=True,
        check=False,
        env={**os.environ, **more},
        timeout=120,
    )
    return done.returncode, done.stdout, done.stderr.decode()


def test_pipes(files: Path, tmp_path: Path) -> None:
    data = (files / "whole.ply").read_bytes()
    status, out, err = program("reveal", "-", "-o", "-", data=data, KEYSS_KEY=KEY)
    assert (status, err.splitlines()[-1]) == (0, "standard output: 500 of 500 Gaussians")
    (tmp_path / "s.ply").write_bytes(out)
    assert len(read_model(tmp_path / "s.ply")) == 500
    status, out, err = program("info", "-", "--json", data=out)
    assert (status, json.loads(out)["gaussians"]) == (0, 500)


class TestVerify:
    def test_valid_model(self, keyss: Run, files: Path) -> None:
        facts = []
        for name in ("plain.ply", "whole.ply"):
            result = keyss("verify", files / name, "--json")
            assert (result.status, result.err) == (0, "")
            facts.append(json.loads(result.out) | {"path": ""})
        assert facts[0] == facts[1]
        assert facts[0]["secrets"] == []
        assert facts[0]["model"]["gaussians"] == 1500
        assert "secret  not checked" in keyss("verify", files / "whole.ply").out

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda m: m.means[3].fill_(1e10), "as far out"),
            (lambda m: m.log_scales[3].fill_(30), "as large"),
            (lambda m: m.quats[3].zero_(), "quaternion of length 0"),
            (lambda m: m.sh[3].fill_(1e6), "harmonics beyond"),
            (lambda m: m.opacity_logits.fill_(-12), "all Gaussians are invisible"),
            (
                lambda m: [values[:300].copy_(values[300:600]) for values in vars(m).values()],
                "copied from others",
            ),
        ],
    )
    def test_invalid_model(
        self, keyss: Run, files: Path, tmp_path: Path, change: Callable[[Gaussians], object], words: str
    ) -> None:
        model = read_model(files / "plain.ply")
        change(model)
        write_model(tmp_path / "m.ply", model)
        result = keyss("verify", tmp_path / "m.ply")
        assert result.status == 4
        assert words in result.err
        assert "Gaussians of SH degree" in result.out

    def test_invalid_model_with_whole_secret(self, keyss: Run, files: Path, tmp_path: Path) -> None:
        model = read_model(files / "whole.ply")
        write_model(tmp_path / "twice.ply", model[torch.arange(len(model)).repeat(2)])
        result = keyss("verify", tmp_path / "twice.ply", "--key-file", files / "key")
        assert result.status == 4
        assert "500 of 500 Gaussians: about 1," in result.out  # were copied
        assert "copied from others" in result.err

    def test_merged_model_with_whole_secret(self, keyss: Run, files: Path, tmp_path: Path) -> None:
        merged = Gaussians.cat([read_model(files / "whole.ply"), trained_like(1500, 9)])
        write_model(tmp_path / "merged.ply", merged)
        result = keyss("verify", tmp_path / "merged.ply", "--key-file", files / "key")
        assert result.status == 4
        assert "500 of 500 Gaussians" in result.out
        assert "Gaussians were added to the file" in result.err

    def test_which_of_two_keys_opens_nothing(self, keyss: Run, files: Path) -> None:
        given = ("--key-file", files / "key", "--key-file", files / "other")
        refused = keyss("verify", files / "whole.ply", *given)
        assert_refused(refused, 3, "key 2 of 2: this key opens nothing")
        assert "; the model itself: sound" in refused.err

    def test_missing_key_file(self, keyss: Run, files: Path) -> None:
        refused = keyss("verify", files / "whole.ply", "--key-file", files / "none")
        assert_refused(refused, 4, "none does not exist; `keyss keygen -o FILE` makes a key")

    def test_damaged_secret(self, keyss: Run, files: Path) -> None:
        result = keyss("verify", files / "pruned.ply", "--key-file", files / "key")
        assert result.status == 4
        assert "shards of the secret's payload were lost, and restored" in result.err
        assert_refused(
            keyss("verify", files / "few.ply", "--key-file", files / "key"), 4, "was lost or changed"
        )
        assert_refused(keyss("verify", files / "plain.ply", "--key-file", files / "key"), 3, "opens nothing")


def test_duplicates_match_pairwise_comparison() -> None:
    model = random_gaussians(3000, seed=4)
    rows = torch.randint(0, 3000, (900,), generator=torch.Generator().manual_seed(5))
    repeated = Gaussians.cat([model, model[rows], model[rows[:40]]])
    repeated.means[:5] = 0.0
    repeated.means[3000:3900:2] = 0.0
    repeated.means[rows[::2]] = -0.0  # equals 0
    columns = [getattr(repeated, field.name).reshape(len(repeated), -1) for field in fields(repeated)]
    expected = len(repeated) - len(torch.unique(torch.cat(columns, dim=1), dim=0))
    assert check_model(repeated).duplicates == expected > 500
