"""The command line: what it prints, what it exits with, and what it leaves on disk."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from files.scene_files import photo, save, write_blender, write_colmap, write_nerfstudio
from keyss import api as verbs
from keyss.cli import commands, main
from keyss.cli.tables import print_hiding
from keyss.files.ply import read_ply
from keyss.fitting.config import PRESETS as FIT_PRESETS
from keyss.fitting.image_metrics import ImageQuality
from keyss.measure.hiding import BaselineQuality, PsnrRange, WrongKeys
from keyss.methods import registry
from keyss.methods.learned.options import PRESETS as LEARNED_PRESETS
from keyss.runs.metrics import HideMetrics
from tiny_scenes import random_gaussians

METRICS = HideMetrics(
    method="learned",
    cover=ImageQuality(30.0, 0.5),
    secrets=(ImageQuality(20.0, 0.25),),
    baseline=BaselineQuality(ImageQuality(30.5, 0.6), (None,)),
    wrong_key=None,
    chance_level=(9.0,),
    gaussians=1234,
    secret_gaussians=(567,),
    iterations=10,
    seconds=1.0,
    width=100,
    seed=0,
    details={"carriers": 1000, "bits_per_gaussian": [568, 600]},
)
SMALL = ("--preset", "quick", "--iterations", "20", "--max-gaussians", "100", "--device", "cpu")
COMMANDS = [command.__name__ for command in commands.ALL]


@dataclass(frozen=True)
class Said:
    """What a run of the command line came to."""

    status: int
    out: str
    err: str


@pytest.fixture
def keyss(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Said]:
    """Runs the command line in this process, without a key in the environment and without a terminal."""
    monkeypatch.delenv("KEYSS_KEY", raising=False)
    monkeypatch.delenv("KEYSS_DEBUG", raising=False)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("sys.stdin", io.StringIO())

    def run(*arguments: object) -> Said:
        capsys.readouterr()
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = int(end.code or 0)
        return Said(status, *capsys.readouterr())

    return run


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scenes `a` and `b`, a key file, and `hidden`: b hidden in a."""
    folder = tmp_path_factory.mktemp("world")
    write_blender(folder / "a", count=3, channels=3)
    write_nerfstudio(folder / "b", count=4)
    (folder / "key.txt").write_text("q7Rv2LxT9bWm4KzD\n")
    (folder / "key.txt").chmod(0o600)
    (folder / "wrong.txt").write_text("fedcba9876543210\n")
    arguments = [
        "--sidecar",
        "--cover",
        folder / "a",
        "--secret",
        folder / "b",
        "--key-file",
        folder / "key.txt",
    ]
    status = main(["hide", *map(str, arguments), "-o", str(folder / "hidden"), *SMALL])
    assert status == 0
    return folder


def listing(folder: Path) -> dict[str, int]:
    """Every file and folder below, hidden ones too, with its time of change."""
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in sorted(folder.rglob("*"))}


def assert_refused(said: Said, status: int, words: str) -> None:
    """The exit status, and one or two lines that hold `words`."""
    assert said.status == status, said.err
    assert words in said.err
    assert said.err.startswith("keyss: ")
    assert 1 <= len(said.err.splitlines()) <= 2
    assert "Traceback" not in said.err
    assert said.out == ""


class TestHelp:
    def test_names_every_command(self, keyss: Callable[..., Said]) -> None:
        said = keyss("--help")
        assert said.status == 0
        assert all(f"• {name}" in said.out for name in COMMANDS)
        making = ["keygen", "fit", "hide", "reveal", "render"]
        judging = ["evaluate", "audit", "report", "steganalyze", "info", "demo"]
        assert making + judging == COMMANDS

    @pytest.mark.parametrize("command", COMMANDS)
    def test_shows_an_example(self, keyss: Callable[..., Said], command: str) -> None:
        said = keyss(command, "--help")
        assert said.status == 0
        assert f"example: keyss {command}" in said.out
        assert "default: None" not in said.out

    @pytest.mark.parametrize("command", COMMANDS)
    def test_no_option_is_accepted_and_ignored(self, keyss: Callable[..., Said], command: str) -> None:
        out = keyss(command, "--help").out
        assert ("--seed" in out) == (command in {"fit", "hide", "evaluate", "audit", "demo"})
        computing = {"fit", "hide", "reveal", "render", "evaluate", "audit", "demo"}
        assert ("--device {auto,cpu,cuda}" in out) == (command in computing)
        assert "nothing here" not in out

    @pytest.mark.parametrize("command", ["fit", "hide"])
    def test_shows_the_options_of_training(self, keyss: Callable[..., Said], command: str) -> None:
        out = keyss(command, "--help").out
        for option in ("preset", "iterations", "max-gaussians", "width", "background", "resume", "overwrite"):
            assert f"--{option}" in out

    def test_offers_the_presets_there_are(self, keyss: Callable[..., Said]) -> None:
        assert f"--preset {{{','.join(FIT_PRESETS)}}}" in keyss("fit", "--help").out
        for name, method in registry.METHODS.items():
            said = keyss("hide", "--method", name, "--help").out
            assert f"--preset {{{','.join(method.presets)}}}" in said
            assert f"(default: {next(iter(method.presets))})" in said

    @pytest.mark.parametrize("method", ["learned", "carry"])
    def test_of_hide_is_as_it_was(self, keyss: Callable[..., Said], method: str) -> None:
        """Names, defaults and sentences of all options; `hide_METHOD_help.txt` is what is meant."""
        meant = Path(__file__).with_name(f"hide_{method}_help.txt").read_text(encoding="utf-8")
        said = keyss("hide", "--method", method, "--help").out
        assert [line.rstrip() for line in said.splitlines()] == meant.splitlines()

    def test_needs_no_method_to_be_loaded(self) -> None:
        """`keyss --help` answers at once: torch takes seconds."""
        program = "import sys; from keyss.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
        program += "assert not {'torch', 'keyss.methods'} & set(sys.modules)"
        subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)

    def test_an_unknown_method_names_those_there_are(self, keyss: Callable[..., Said]) -> None:
        said = keyss("hide", "--method", "none", "--cover", "A", "--secret", "B", "-o", "out")
        assert said.status == 2
        assert "learned" in said.err
        assert "carry" in said.err

    @pytest.mark.parametrize("arguments", [(), ("frobnicate",), ("fit",), ("info", "x", "--nonsense")])
    def test_wrong_usage_exits_with_2(self, keyss: Callable[..., Said], arguments: tuple[str, ...]) -> None:
        said = keyss(*arguments)
        assert said.status == 2
        assert said.out == ""
        assert said.err


class TestKeygen:
    def test_prints_a_key_and_nothing_else(self, keyss: Callable[..., Said]) -> None:
        said = keyss("keygen")
        assert said.status == 0
        assert said.err == ""
        assert said.out.endswith("\n")
        key = said.out.removesuffix("\n")
        assert len(key) == 16
        assert key.isascii()
        assert key.isalnum()
        assert keyss("keygen").out != said.out

    def test_length(self, keyss: Callable[..., Said]) -> None:
        assert len(keyss("keygen", "--length", 40).out) == 41
        assert_refused(keyss("keygen", "--length", 0), 2, "1 to 1024")

    def test_bits(self, keyss: Callable[..., Said]) -> None:
        assert len(keyss("keygen", "--bits", 128).out) == 22 + 1
        assert_refused(keyss("keygen", "--bits", 128, "--length", 9), 2, "not both")
        assert_refused(keyss("keygen", "--bits", 0), 2, "--bits")

    def test_takes_no_seed(self, keyss: Callable[..., Said]) -> None:
        """A key that can be drawn again is no secret."""
        assert keyss("keygen", "--seed", 1).status == 2


class TestTheWholePath:
    def test_hide_left_its_results(self, world: Path) -> None:
        names = {path.name for path in (world / "hidden").iterdir()}
        assert names == {"stego.ply", "decoder.sealed", "metrics.json", "config.json", "private"}

    def test_reveal_render_evaluate_info(
        self, keyss: Callable[..., Said], world: Path, tmp_path: Path
    ) -> None:
        secret, images, key = tmp_path / "secret.ply", tmp_path / "images", world / "key.txt"
        said = keyss("reveal", world / "hidden" / "stego.ply", "--key-file", key, "-o", secret)
        left = len(read_ply(secret))  # without the cover's, which nothing draws
        assert 0 < left < 100
        assert said == Said(0, f"{secret}: {left} Gaussians\n", "")
        said = keyss("render", secret, "--cameras", world / "b", "-o", images, "--split", "all")
        assert said.status == 0
        assert said.out == f"{images}: 4 images\n"
        assert len(list(images.glob("*.png"))) == 4

        run = tmp_path / "run"
        shutil.copytree(world / "hidden", run)
        said = keyss("evaluate", run, "--key-file", key, "--wrong-keys", 2)
        assert said.status == 0
        assert "2 wrong keys, against the cover" in said.out
        metrics = json.loads((run / "metrics.json").read_text())
        assert metrics["wrong_key"]["keys"] == 2
        assert f"{metrics['secrets'][0]['psnr']:.2f}" in said.out

        said = keyss("info", secret, "--json")
        assert json.loads(said.out)["gaussians"] == left
        said = keyss("info", run)
        assert "metrics.secrets.1.psnr" in said.out
        assert "{" not in said.out

    def test_fit_prints_its_numbers_and_files(
        self, keyss: Callable[..., Said], world: Path, tmp_path: Path
    ) -> None:
        out = tmp_path / "plain"
        said = keyss("fit", world / "a", "-o", out, *SMALL, "--width", 8)
        assert said.status == 0
        assert "fit a: 20 steps" in said.err
        assert str(out / "model.ply") in said.out
        assert json.loads((out / "metrics.json").read_text())["width"] == 8

    def test_wrong_key_exits_with_3_and_writes_nothing(
        self, keyss: Callable[..., Said], world: Path, tmp_path: Path
    ) -> None:
        out = tmp_path / "secret.ply"
        arguments = ["reveal", world / "hidden" / "stego.ply", "--key-file", world / "wrong.txt", "-o", out]
        assert_refused(keyss(*arguments), 3, "opens nothing")
        assert listing(tmp_path) == {}

    def test_a_decoy_looks_like_a_success(
        self, keyss: Callable[..., Said], world: Path, tmp_path: Path
    ) -> None:
        (tmp_path / "a.txt").write_text((world / "key.txt").read_text())
        (tmp_path / "b.txt").write_text((world / "wrong.txt").read_text())
        said = []
        for name in "ab":
            (tmp_path / f"{name}.txt").chmod(0o600)
            key, out = tmp_path / f"{name}.txt", tmp_path / f"{name}.ply"
            stego = world / "hidden" / "stego.ply"
            said.append(keyss("reveal", stego, "--key-file", key, "--decoy", "-o", out))
        right, wrong = said
        assert right.status == 0
        assert wrong == Said(0, right.out.replace("a.ply", "b.ply"), right.err)
        assert len((tmp_path / "a.ply").read_bytes()) == len((tmp_path / "b.ply").read_bytes())


class TestNumbers:
    """What is printed of a hiding, whatever its method."""

    def table(self, metrics: HideMetrics) -> list[list[str]]:
        console = Console(file=io.StringIO(), width=120)
        print_hiding(metrics, console)
        text: str = console.file.getvalue()  # type: ignore[attr-defined]
        return [re.split("  +", line.strip()) for line in text.splitlines()]

    def test_a_row_for_each_and_what_the_method_adds(self) -> None:
        rows = self.table(METRICS)
        assert rows[:4] == [
            ["against the test photos", "PSNR", "SSIM", "baseline", "loss", "Gaussians"],
            ["cover", "30.00", "0.500", "30.50", "0.50", "1,234"],
            ["secret", "20.00", "0.250", "567"],
            ["the stego cover, against the secret", "9.00"],
        ]
        assert rows[-2:] == [["carriers: 1,000"], ["bits per gaussian: 568, 600"]]

    def test_columns_that_nothing_fills_are_left_out(self) -> None:
        rows = self.table(replace(METRICS, baseline=BaselineQuality(None, (None,)), details={}))
        assert rows[0] == ["against the test photos", "PSNR", "SSIM", "Gaussians"]
        assert rows[1] == ["cover", "30.00", "0.500", "1,234"]

    def test_wrong_keys_where_there_is_a_decoder(self) -> None:
        two = replace(
            METRICS,
            secrets=METRICS.secrets * 2,
            baseline=BaselineQuality(None, (None, None)),
            secret_gaussians=(5, 6),
            chance_level=(9.0, 8.0),
            wrong_key=WrongKeys(
                7, PsnrRange(28.0, 27.0, 29.0), (PsnrRange(8.0, 7.0, 9.5), PsnrRange(6.0, 5.0, 7.5))
            ),
        )
        rows = [row[:2] for row in self.table(two)]
        assert rows[3:10] == [
            ["secret 2", "20.00"],
            ["7 wrong keys, against the cover", "28.00"],
            ["the worst of them", "27.00"],
            ["the one nearest to the secret 1", "9.50"],
            ["the one nearest to the secret 2", "7.50"],
            ["the stego cover, against the secret 1", "9.00"],
            ["the stego cover, against the secret 2", "8.00"],
        ]


class TestArguments:
    """What reaches the functions."""

    @pytest.fixture
    def hidden(self, monkeypatch: pytest.MonkeyPatch) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
        calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

        def hide(*args: Any, **kwargs: Any) -> verbs.HideResult:
            calls.append((args, kwargs))
            return verbs.HideResult(random_gaussians(1), None, METRICS)

        monkeypatch.setattr(verbs, "hide", hide)
        return calls

    def test_secrets_and_keys_pair_up_in_order(
        self, keyss: Callable[..., Said], hidden: list[Any], tmp_path: Path
    ) -> None:
        for name in "bc":
            (tmp_path / f"{name}.txt").write_text(f"key of {name}")
        said = keyss(
            *("hide", "--cover", "A", "-o", "out", "--secret", "B", "--key-file", tmp_path / "b.txt"),
            *(
                "--secret",
                "C",
                "--key-file",
                tmp_path / "c.txt",
                "--secret-model",
                "mb",
                "--secret-model",
                "mc",
            ),
        )
        assert said.status == 0, said.err
        (cover, secrets), _ = hidden[0]
        assert cover == Path("A")
        assert secrets == [
            verbs.Secret(Path("B"), "key of b", Path("mb")),
            verbs.Secret(Path("C"), "key of c", Path("mc")),
        ]

    def test_options_override_the_preset(
        self, keyss: Callable[..., Said], hidden: list[Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("KEYSS_KEY", "k")
        said = keyss(
            *("hide", "--cover", "A", "--secret", "B", "-o", "out", "--preset", "quick", "--iterations", 7),
            *("--max-gaussians", 80, "--seed", 9, "--mask", "xyz,sc", "--start", "points", "--width", 10),
            *("--background", 1, 0.5, 0, "--cover-model", "m.ply", "--resume", "--device", "cpu"),
        )
        assert said.status == 0, said.err
        _, options = hidden[0]
        config = options.pop("method")
        assert (config.fit.iterations, config.fit.max_gaussians, config.fit.seed) == (7, 80, 9)
        assert config.mask == ("sc", "xyz")
        assert config.start == "points"
        assert config.decoder == "network"
        assert (config.iterations, config.max_gaussians) == (7, 80)
        assert config.fit.evaluate_every == LEARNED_PRESETS["quick"].fit.evaluate_every
        assert options.pop("reporter") is not None
        assert options == {
            "width": 10,
            "background": (1.0, 0.5, 0.0),
            "skip_missing": False,
            "cover_model": Path("m.ply"),
            "device": "cpu",
            "out": Path("out"),
            "overwrite": False,
            "resume": True,
        }

    def test_by_default_the_preset_stays_as_it_is(
        self, keyss: Callable[..., Said], hidden: list[Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("KEYSS_KEY", "k")
        assert keyss("hide", "--cover", "A", "--secret", "B", "-o", "out").status == 0
        assert hidden[0][1]["method"] == LEARNED_PRESETS["best"]
        assert keyss("hide", "--method", "carry", "--cover", "A", "--secret", "B", "-o", "out").status == 0
        assert hidden[1][1]["method"] == registry.get("carry").presets["best"]

    def test_options_of_a_method_reach_it(
        self, keyss: Callable[..., Said], hidden: list[Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("KEYSS_KEY", "k")
        scenes = ("hide", "--cover", "A", "--secret", "B", "-o", "out")
        assert keyss(*scenes, "--sidecar", "--key-encoder", "clip", "--clip-model", "C").status == 0
        learned = hidden[0][1]["method"]
        assert (learned.sidecar, learned.key_encoder, learned.clip_model) == (True, "clip", "C")
        assert keyss(*scenes, "--method", "carry", "--thin", "--dither", "--seed", 5).status == 0
        carry = hidden[1][1]["method"]
        assert (carry.prune_to_fit, carry.dither, carry.fit.seed) == (True, True, 5)

    @pytest.mark.parametrize(
        ("extra", "words"),
        [
            (("--iterations", 0), "iterations"),
            (("--max-gaussians", -5), "max_gaussians"),
            (("--seed", -1), "--seed"),
            (("--seed", 10**30), "--seed"),
            (("--mask", "op,colour"), "colour"),
            (("--secret-model", "x", "--secret-model", "y"), "--secret-model"),
            (("--secret", "C"), "KEYSS_KEY holds one key"),
        ],
    )
    def test_what_makes_no_sense_is_refused(
        self,
        keyss: Callable[..., Said],
        hidden: list[Any],
        monkeypatch: pytest.MonkeyPatch,
        extra: tuple[object, ...],
        words: str,
    ) -> None:
        monkeypatch.setenv("KEYSS_KEY", "k")
        assert_refused(keyss("hide", "--cover", "A", "--secret", "B", "-o", "out", *extra), 2, words)
        assert hidden == []

    def test_hide_needs_a_secret(self, keyss: Callable[..., Said], hidden: list[Any]) -> None:
        assert keyss("hide", "--cover", "A", "-o", "out").status == 2


def _scene_with(change: Callable[[Path], None]) -> Callable[[Path], list[object]]:
    """`fit` on a COLMAP scene after `change`."""

    def prepare(folder: Path) -> list[object]:
        write_colmap(folder / "scene", count=4)
        change(folder / "scene")
        return ["fit", folder / "scene", "-o", folder / "out", *SMALL]

    return prepare


def _ply_with(change: Callable[[bytes], bytes]) -> Callable[[Path], list[object]]:
    """`reveal` on a stego file after `change` of its bytes."""

    def prepare(folder: Path) -> list[object]:
        stego = folder / "hidden" / "stego.ply"
        stego.write_bytes(change(stego.read_bytes()))
        return ["reveal", stego, "--key-file", folder / "key.txt", "-o", folder / "secret.ply"]

    return prepare


def _decoder_with(change: Callable[[bytes], bytes]) -> Callable[[Path], list[object]]:
    def prepare(folder: Path) -> list[object]:
        decoder = folder / "hidden" / "decoder.sealed"
        decoder.write_bytes(change(decoder.read_bytes()))
        stego = folder / "hidden" / "stego.ply"
        return ["reveal", stego, "--key-file", folder / "key.txt", "-o", folder / "secret.ply"]

    return prepare


def _keep(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])


def _later_version(data: bytes) -> bytes:
    return data[:8] + b"\x07" + data[9:]


def _with_nan(data: bytes) -> bytes:
    at = data.index(b"end_header\n") + len(b"end_header\n")
    return data[:at] + b"\0\0\xc0\x7f" + data[at + 4 :]


def _with_count(count: str) -> Callable[[bytes], bytes]:
    return lambda data: data.replace(b"element vertex 100\n", f"element vertex {count}\n".encode())


def _other_model(folder: Path) -> list[object]:
    shutil.copy(folder / "hidden" / "private" / "secret-1.ply", folder / "hidden" / "stego.ply")
    stego = folder / "hidden" / "stego.ply"
    return ["reveal", stego, "--key-file", folder / "key.txt", "-o", folder / "secret.ply"]


def _hide(folder: Path, **changes: object) -> list[object]:
    options = {"--cover": folder / "a", "--secret": folder / "b", "--key-file": folder / "key.txt"}
    options |= {"--out": folder / "out"} | {
        f"--{name.replace('_', '-')}": value for name, value in changes.items()
    }
    return ["hide", "--sidecar", *(part for option in options.items() for part in option), *SMALL]


def _empty_key(folder: Path) -> list[object]:
    (folder / "empty.txt").write_text("\n")
    return _hide(folder, key_file=folder / "empty.txt")


def _without_clip(folder: Path) -> list[object]:
    pytest.importorskip("transformers", reason="needs keyss[clip]")
    return _hide(folder, key_encoder="clip", clip_model=folder / "a")


ERRORS: dict[str, tuple[int, str, Callable[[Path], list[object]]]] = {
    "missing folder": (4, "nowhere", lambda f: ["fit", f / "nowhere", "-o", f / "out"]),
    "unknown layout": (4, "Known layouts", lambda f: ["fit", f / "hidden/private", "-o", f / "out"]),
    "truncated points": (4, "points3D", _scene_with(lambda s: _keep(s / "sparse/0/points3D.bin", 40))),
    "image missing": (4, "01.png", _scene_with(lambda s: (s / "images/01.png").unlink())),
    "image of another size": (
        4,
        "01.png",
        _scene_with(lambda s: save(s / "images/01.png", photo(1, size=(13, 9)))),
    ),
    "one image": (4, "2 posed images", lambda f: ["fit", write_colmap(f / "s", count=1), "-o", f / "out"]),
    "no cover": (4, "nowhere", lambda f: _hide(f, cover=f / "nowhere")),
    "no secret": (4, "nowhere", lambda f: _hide(f, secret=f / "nowhere")),
    "no cover model": (4, "nowhere.ply", lambda f: _hide(f, cover_model=f / "nowhere.ply")),
    "output exists": (5, "--overwrite", lambda f: _hide(f, out=f / "hidden")),
    "output is a file": (5, "not a folder", lambda f: ["fit", f / "a", "-o", f / "key.txt"]),
    "key file missing": (4, "none.txt", lambda f: _hide(f, key_file=f / "none.txt")),
    "key file empty": (4, "keyss keygen", _empty_key),
    "too few key files": (2, "--key-file", lambda f: [*_hide(f), "--secret", f / "b"]),
    "no key at all": (2, "KEYSS_KEY", lambda f: ["reveal", f / "hidden/stego.ply", "-o", f / "s.ply"]),
    "header truncated": (4, "stego.ply", _ply_with(lambda data: data[:100])),
    "data truncated": (4, "stego.ply", _ply_with(lambda data: data[:-1])),
    "negative count": (4, "stego.ply", _ply_with(_with_count("-3"))),
    "absurd count": (4, "stego.ply", _ply_with(_with_count("99999999999999"))),
    "NaN": (4, "NaN", _ply_with(_with_nan)),
    "another version": (4, "version", _decoder_with(_later_version)),
    "decoder truncated": (4, "decoder.sealed", _decoder_with(lambda data: data[:-9])),
    "decoder empty": (4, "decoder.sealed", _decoder_with(lambda data: b"")),
    "another model": (4, "another model", _other_model),
    "no sidecar and nothing in the model": (
        3,
        "opens nothing",
        lambda f: ["reveal", f / "hidden/private/cover.ply", "--key-file", f / "key.txt", "-o", f / "s.ply"],
    ),
    "file exists": (
        5,
        "--overwrite",
        lambda f: [
            "reveal",
            f / "hidden/stego.ply",
            "--key-file",
            f / "key.txt",
            "-o",
            f / "hidden/stego.ply",
        ],
    ),
    "folder of the file missing": (
        5,
        "nowhere",
        lambda f: ["reveal", f / "hidden/stego.ply", "--key-file", f / "key.txt", "-o", f / "nowhere/s.ply"],
    ),
    "evaluate without a run": (
        4,
        "config.json",
        lambda f: ["evaluate", f / "a", "--key-file", f / "key.txt"],
    ),
    "info of nothing": (4, "nowhere", lambda f: ["info", f / "nowhere"]),
    "info of another file": (4, "key.txt", lambda f: ["info", f / "key.txt"]),
    "clip without a model": (6, "--clip-model", _without_clip),
    "clip model without clip": (2, "--key-encoder", lambda f: _hide(f, clip_model=f)),
    "width of nothing": (2, "width", lambda f: ["fit", f / "a", "-o", f / "out", "--width", 0]),
    "background out of range": (
        2,
        "background",
        lambda f: ["fit", f / "a", "-o", f / "out", "--background", 0, 0, 9],
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors_are_a_line_and_leave_nothing(
    keyss: Callable[..., Said], world: Path, tmp_path: Path, name: str
) -> None:
    status, words, prepare = ERRORS[name]
    shutil.copytree(world, tmp_path, dirs_exist_ok=True)
    arguments = prepare(tmp_path)
    before = listing(tmp_path)
    assert_refused(keyss(*arguments), status, words)
    assert listing(tmp_path) == before


def test_a_full_disk_is_a_line_and_leaves_nothing(
    keyss: Callable[..., Said], world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("keyss.files.atomic.os.fsync", full)
    arguments = [world / "hidden" / "stego.ply", "--key-file", world / "key.txt"]
    assert_refused(keyss("reveal", *arguments, "-o", tmp_path / "secret.ply"), 5, "No space left")
    arguments = [world / "hidden" / "stego.ply", "--cameras", world / "a"]
    assert_refused(keyss("render", *arguments, "-o", tmp_path / "images"), 5, "No space left")
    assert listing(tmp_path) == {}


class TestUnexpectedErrors:
    @pytest.fixture
    def failing(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
        def fail_with(error: BaseException) -> None:
            def info(path: Path) -> None:
                raise error

            monkeypatch.setattr("keyss.runs.describe.info", info)

        return fail_with

    def test_ours_are_a_line_that_asks_for_a_report(
        self, keyss: Callable[..., Said], failing: Callable[[BaseException], None]
    ) -> None:
        failing(ValueError("first\nsecond\x1b[31m"))
        said = keyss("info", "x")
        assert_refused(said, 70, "ValueError: first second [31m; please report")
        assert "KEYSS_DEBUG=1" in said.err

    def test_ours_come_through_for_whoever_debugs(
        self,
        keyss: Callable[..., Said],
        failing: Callable[[BaseException], None],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        failing(ValueError("boom"))
        monkeypatch.setenv("KEYSS_DEBUG", "1")
        with pytest.raises(ValueError, match="boom"):
            keyss("info", "x")

    @pytest.mark.parametrize(
        ("error", "status", "words"),
        [
            (MemoryError(), 5, "not enough memory"),
            (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), 5, "not enough memory"),
            (OSError(errno.ENOSPC, "No space left on device", "/x/y"), 5, "/x/y: No space left"),
            (KeyboardInterrupt(), 130, "interrupted"),
        ],
    )
    def test_the_machines_are_explained(
        self,
        keyss: Callable[..., Said],
        failing: Callable[[BaseException], None],
        error: BaseException,
        status: int,
        words: str,
    ) -> None:
        failing(error)
        assert_refused(keyss("info", "x"), status, words)


PROGRAM = [sys.executable, "-c", "import sys; from keyss.cli import main; sys.exit(main())"]


def test_a_reader_that_leaves_is_no_error() -> None:
    process = subprocess.Popen([*PROGRAM, "keygen"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (141, b"")


def test_ctrl_c_saves_and_resume_ends_in_the_same_files(
    keyss: Callable[..., Said], world: Path, tmp_path: Path
) -> None:
    def arguments(out: Path) -> list[object]:
        return ["fit", world / "b", "-o", out, "--iterations", 400, "--max-gaussians", 100, "--device", "cpu"]

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    command = [*PROGRAM, *map(str, arguments(parts))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        while line and not line.startswith("fit b: 400 steps"):
            line = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert out == ""
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith("keyss: interrupted at iteration ")
    assert err.splitlines()[-1].endswith("continue with the same command and --resume")
    assert [path.name for path in parts.iterdir()] == ["checkpoint"]

    assert_refused(keyss(*arguments(parts)), 5, "--resume")
    said = keyss(*arguments(parts), "--resume")
    assert said.status == 0, said.err
    assert "continuing at" in said.err
    assert keyss(*arguments(whole)).status == 0
    assert (parts / "model.ply").read_bytes() == (whole / "model.ply").read_bytes()
    assert sorted(path.name for path in parts.iterdir()) == ["config.json", "metrics.json", "model.ply"]
