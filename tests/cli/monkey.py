"""A monkey at the command line: random calls on random files, and what must hold after each of them.

It works in one folder, so that runs pile up and outputs collide; between calls it does what people do to
files: breaks, removes and copies them, and leaves notes of its own in folders of results. Most calls run in
this process, some in one of their own that is killed after a random time. Key derivation is made cheap.

    python tests/cli/monkey.py FOLDER [SEED] [CALLS]
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import random
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from files.scene_files import photo, save, write_blender, write_colmap, write_nerfstudio
from keyss import api
from keyss.cli import main
from keyss.core.gaussians import Gaussians
from keyss.files.models import read_model
from keyss.files.ply import write_ply
from keyss.keys import derivation
from keyss.measure.hiding import render_fidelity
from keyss.runs.folder import read_manifest
from keyss.runs.opening import open_run
from tiny_scenes import random_gaussians

# README; 141 has a test of its own, and 70 is always a mistake.
STATUSES = {0, 2, 3, 4, 5, 6, 7, 130, 143}
SECONDS = 120  # for one call
MOST_BYTES = 300 << 20  # of the folder; beyond it the monkey clears runs away
KEYS = ("q7Rv2LxT9bWm4KzD", "fedcba9876543210", "Zm3nB8vC1xK5jH7g")
SMALL = ("--iterations", "5", "--max-gaussians", "100", "--width", "16", "--device", "cpu")
NOTES = ("keyss: warning: ", "keyss: skipped ", "keyss: compiling ")  # on standard error, not errors
WORKING = ("checkpoint", "unfinished", "lock")  # in `private/`, while something runs
# Costs as they are not meant to be, in this process and in those that are killed.
CHEAP = {"time_cost": 1, "memory_cost": 8, "parallelism": 1}
PROGRAM = f"""
import argon2.low_level
real = argon2.low_level.hash_secret_raw
argon2.low_level.hash_secret_raw = lambda *given, **named: real(*given, **(named | {CHEAP}))
from keyss.cli.process import main
print("ready", flush=True)
main()
"""


@dataclass(frozen=True)
class State:
    """What is at a path: a change of the content, of the mode, or of the kind makes it another one."""

    kind: str
    mode: int
    content: str


@dataclass
class Call:
    """One call and what it may touch; paths are relative to the monkey's folder."""

    arguments: list[str]
    out: str | None = None  # file or folder that it writes
    into_folder: bool = False
    run: str | None = None  # folder of a run that it measures
    secrets: list[str] = field(default_factory=list)  # keys of a hiding, in order
    environment: str | None = None  # KEYSS_KEY
    stdin: bytes = b""

    @property
    def verb(self) -> str:
        return self.arguments[0]

    def has(self, flag: str) -> bool:
        return flag in self.arguments

    def value(self, flag: str) -> str | None:
        return self.arguments[self.arguments.index(flag) + 1] if flag in self.arguments else None

    def __str__(self) -> str:
        key = f"KEYSS_KEY={shlex.quote(self.environment)} " if self.environment is not None else ""
        return f"{key}keyss {shlex.join(self.arguments)}"


class Violation(AssertionError):
    """Something that must hold and does not."""


class Monkey:
    """`calls` random calls in `folder`; raises Violation with the seed and all that was done so far."""

    def __init__(self, folder: Path, seed: int, kills: float = 0.03) -> None:
        self.folder, self.seed, self.kills = folder, seed, kills
        self.random = random.Random(seed)
        self.history: list[str] = []
        self.statuses: dict[int, int] = {}
        self.foreign: dict[str, State] = {}  # what the monkey wrote and no call may touch
        self.hashes: dict[tuple[int, ...], str] = {}
        self.keys: dict[str, list[str]] = {}  # key files of the hidings that are there
        self.notes = 0

    def play(self, calls: int, keep_going: bool = False) -> None:
        with self._at_home():
            make_inputs(Path())
            self.foreign = {
                name: state for name, state in self.snapshot().items() if state.kind in ("file", "link")
            }
            for number in range(calls):
                self.fiddle()
                call = self.next_call()
                killed = self.random.random() < self.kills
                self.history.append(str(call))
                try:
                    self.perform(call, killed)
                except Violation as violation:
                    if keep_going:
                        self.history.append(f"^^^ {violation}")
                        print(f"call {number + 1}: {self.history[-2]}\n    {violation}", flush=True)
                        continue
                    done = "\n".join(self.history)
                    raise Violation(
                        f"seed {self.seed}, call {number + 1}: {violation}\n{done}\n^ {violation}"
                    ) from violation.__cause__

    @contextlib.contextmanager
    def _at_home(self) -> Iterator[None]:
        self.folder.mkdir(parents=True, exist_ok=True)
        before, umask = Path.cwd(), os.umask(0o022)
        real = derivation.hash_secret_raw
        cheap = lambda *given, **named: real(*given, **(named | CHEAP))  # noqa: E731
        os.chdir(self.folder)
        try:
            with mock.patch.object(derivation, "hash_secret_raw", cheap), mock.patch.dict(os.environ):
                for name in ("KEYSS_KEY", "KEYSS_DEBUG"):
                    os.environ.pop(name, None)
                os.environ["COLUMNS"] = "120"
                yield
        finally:
            os.chdir(before)
            os.umask(umask)

    # What is called

    def next_call(self) -> Call:
        verbs: list[tuple[int, Callable[[], Call]]] = [
            (22, self.hide),
            (6, self.fit),
            (16, self.reveal),
            (10, self.verify),
            (6, self.render),
            (8, self.evaluate),
            (6, self.audit),
            (5, self.report),
            (4, self.steganalyze),
            (8, self.info),
            (3, self.keygen),
            (1, self.demo),
            (1, self.nonsense),
        ]
        weights, makers = zip(*verbs, strict=True)
        call = self.random.choices(makers, weights)[0]()
        if "KEYSS_KEY" not in call.arguments and self.random.random() < 0.03:
            call.environment = self.pick([*KEYS, "", " ", "\udcff", "x" * 5000])
        if self.random.random() < 0.3:
            with contextlib.suppress(OSError):
                call.stdin = (
                    Path(self.pick(self.models())).read_bytes() if self.random.random() < 0.8 else b"x"
                )
        return call

    def pick(self, options: Sequence[str]) -> str:
        return self.random.choice(options)

    def mostly(self, good: Sequence[str], other: Sequence[str], share: float = 0.85) -> str:
        return self.pick(good if good and self.random.random() < share else other)

    def maybe(self, share: float, *words: str) -> list[str]:
        return list(words) if self.random.random() < share else []

    def absurd(self, share: float, *flags: str) -> list[str]:
        """Now and then one of the flags with a value that it cannot mean."""
        if self.random.random() >= share:
            return []
        flag = self.pick(flags)
        values = ["0", "-1", "1", "nan", "inf", "-inf", "1e30", "", "x", str(2**31), str(2**64), "0x10", "\n"]
        if flag == "--background":
            return [flag, *(self.pick(["0", "1", "0.5", "nan", "inf", "-1", "9"]) for _ in range(3))]
        return [f"{flag}={self.pick(values)}"]

    def models(self) -> list[str]:
        made = [str(path) for path in Path().glob("out-*/publish/stego.ply")]
        made += [str(path) for path in Path().glob("out-*/**/*.ply")] + list(
            map(str, Path().glob("made-*.ply"))
        )
        return ["in/cover.ply", "in/secret.ply", *made]

    def anything(self) -> list[str]:
        return [*INPUTS, *self.models(), *self.runs(), "nowhere", "nowhere/x.ply", "", ".", "-", "/dev/null"]

    def runs(self) -> list[str]:
        return [str(path) for path in sorted(Path().glob("out-*"))]

    def folder_out(self) -> list[str]:
        return [f"out-{number}" for number in range(8)]

    def odd_out(self) -> list[str]:
        return [*ODD_OUTS, *(f"{run}/{each}" for run in self.runs() for each in ("private", "publish", "x"))]

    def device(self) -> list[str]:
        return (
            ["--device", "cpu"] if self.random.random() < 0.97 else ["--device", self.pick(["cuda", "gpu"])]
        )

    def again(self) -> list[str]:
        flags = [[], ["--overwrite"], ["--resume"], ["--overwrite", "--resume"]]
        return self.random.choices(flags, [12, 12, 3, 1])[0]

    def hide(self) -> Call:
        method = self.pick(["learned", "carry"])
        scenes = self.random.random() < 0.35
        good = ["in/a", "in/b", "in/c"] if scenes else ["in/cover.ply", "in/large.ply", "in/secret.ply"]
        cover = self.mostly(["in/a"] if scenes else ["in/large.ply", "in/cover.ply"], self.anything(), 0.87)
        count = 2 if self.random.random() < 0.15 else 1
        secrets = [self.mostly(good[1:], self.anything(), 0.87) for _ in range(count)]
        keys = [self.random.randrange(len(KEYS)) for _ in range(count)]
        files = [f"in/key-{key}.txt" for key in keys]
        out = self.mostly(self.folder_out(), self.odd_out(), 0.9)
        arguments = ["hide", "--cover", cover, "--method", method, "--out", out]
        for secret, file in zip(secrets, files, strict=True):
            arguments += ["--secret", secret, "--key-file", self.mostly([file], KEY_FILES, 0.95)]
        trained = method == "learned" or not all(each.endswith(".ply") for each in (cover, *secrets))
        arguments += ["--width", "16", *self.device(), *self.again()]
        if trained or self.random.random() < 0.05:
            most = [] if not scenes and self.random.random() < 0.7 else ["--max-gaussians", "100"]
            arguments += ["--iterations", "5", *most]
        if method == "learned":
            arguments += self.maybe(0.75 if scenes else 0.3, "--sidecar")
            arguments += self.maybe(0.15, "--sh-degree", self.pick(["0", "1", "2", "3", "4", "-1"]))
            arguments += self.maybe(0.05, "--mask", self.pick(["op", "op,sh", "xyz,ro", "", "x", "op,op"]))
            arguments += self.maybe(0.03, "--start", "points") + self.maybe(0.02, "--key-encoder", "clip")
        else:
            arguments += self.maybe(0.3, "--thin") + self.maybe(0.2, "--dither")
        arguments += self.maybe(0.6 if scenes else 0.1, f"--min-psnr={self.pick(['0', '5', '60', '-3'])}")
        arguments += self.maybe(0.06, "--dry-run") + self.maybe(0.05, "--skip-missing")
        arguments += self.maybe(0.04, "--cover-model", self.pick(self.anything()))
        arguments += self.maybe(0.04, "--preset", self.pick(["best", "quick", "none"]))
        absurd = ("--iterations", "--max-gaussians", "--width", "--seed", "--min-psnr", "--background")
        arguments += self.absurd(0.1, *absurd)
        return Call(arguments, out, into_folder=True, secrets=[KEYS[key] for key in keys])

    def fit(self) -> Call:
        scene = self.mostly(["in/a", "in/b", "in/c"], self.anything(), 0.7)
        out = self.mostly(self.folder_out(), self.odd_out(), 0.8)
        absurd = self.absurd(0.25, "--iterations", "--max-gaussians", "--width", "--seed", "--background")
        extra = self.maybe(0.2, "--skip-missing")
        return Call(["fit", scene, "-o", out, *SMALL, *self.again(), *extra, *absurd], out, into_folder=True)

    def key_file(self, run: str, share: float, every: bool = False) -> list[str]:
        """Mostly the key of a run, or all of its keys."""
        count = self.random.choices([0, 1, 2], [1, 20, 1])[0]
        good = self.keys.get(run, []) or [f"in/key-{number}.txt" for number in range(len(KEYS))]
        if every and run in self.keys and self.random.random() < share:
            return [word for file in good for word in ("--key-file", file)]
        return [each for _ in range(count) for each in ("--key-file", self.mostly(good, KEY_FILES, share))]

    def stego(self) -> str:
        made = [str(path) for path in Path().glob("out-*/publish/*.ply")]
        return self.mostly(made, [*self.models(), *self.anything()], 0.75)

    def sidecars(self) -> list[str]:
        return [str(path) for path in Path().glob("out-*/publish/decoder.sealed")]

    def reveal(self) -> Call:
        stego = self.stego()
        overwrite = self.random.random() < 0.4
        others = [stego, "x.spz", "x.txt", "nowhere/x.ply", "-", "", ".", "x.compressed.ply", *self.runs()]
        others += [] if overwrite else INPUTS
        out = self.mostly([f"made-{number}.ply" for number in range(4)], others, 0.8)
        arguments = [
            "reveal",
            stego,
            *self.key_file(stego.partition("/")[0], 0.95),
            "-o",
            out,
            *self.device(),
        ]
        arguments += ["--overwrite"] * overwrite + self.maybe(0.1, "--decoy") + self.maybe(0.15, "--force")
        arguments += self.maybe(0.15, "--decoder", self.mostly(self.sidecars(), self.anything(), 0.6))
        arguments += self.maybe(0.1, "--frame", self.pick(["secret", "cover", "none"]))
        return Call(arguments, out)

    def verify(self) -> Call:
        stego = self.stego()
        key = self.key_file(stego.partition("/")[0], 0.9) if self.random.random() < 0.7 else []
        arguments = ["verify", stego, *key, *self.maybe(0.3, "--json"), *self.device()]
        arguments += self.maybe(0.15, "--decoder", self.mostly(self.sidecars(), self.anything(), 0.6))
        return Call(arguments)

    def render(self) -> Call:
        cameras = self.mostly(["in/a", "in/b", "in/c"], self.anything(), 0.8)
        out = self.mostly([*self.folder_out(), "out-images"], self.odd_out(), 0.8)
        arguments = ["render", self.mostly(self.models(), self.anything(), 0.8), "--cameras", cameras]
        arguments += [
            "-o",
            out,
            *self.device(),
            *self.maybe(0.4, "--overwrite"),
            *self.maybe(0.3, "--width", "9"),
        ]
        arguments += self.maybe(0.2, "--split", self.pick(["all", "train", "none"]))
        return Call([*arguments, *self.absurd(0.2, "--width", "--background")], out, into_folder=True)

    def evaluate(self) -> Call:
        run = self.mostly(sorted(self.keys), [*self.runs(), *self.anything()], 0.8)
        wrong = self.maybe(0.5, "--wrong-keys", self.pick(["2", "1", "0", "-1", "x"]))
        arguments = [
            "evaluate",
            run,
            *self.key_file(run, 0.93, every=True),
            *wrong,
            *self.device(),
            *self.absurd(0.1, "--seed"),
        ]
        return Call(arguments, run=run)

    def audit(self) -> Call:
        run = self.mostly(sorted(self.keys), [*self.runs(), *self.anything()], 0.85)
        arguments = [
            "audit",
            run,
            *self.key_file(run, 0.95, every=True),
            "--controls",
            self.mostly(["2"], ["0", "1", "-1", "x"]),
        ]
        parts = ["parameters"] if self.random.random() < 0.9 else [self.pick(["images", "leaks", "none"])]
        arguments += [word for part in parts for word in ("--only", part)] + self.device() + self.again()
        arguments += self.maybe(0.1, "--original", self.pick(self.anything())) + self.absurd(0.1, "--seed")
        return Call(arguments, run=run)

    def report(self) -> Call:
        audited = [str(path.parents[2]) for path in Path().glob("out-*/private/audit/audit.json")]
        run = self.mostly(audited or self.runs(), self.anything(), 0.85)
        return Call(["report", run], run=run)

    def steganalyze(self) -> Call:
        folders = ["in/a/train", "in/b/images", "out-images", "in/not-images"]
        overwrite = self.random.random() < 0.5
        csv = self.mostly(["made-0.csv", "made-1.csv"], ["", ".", "nowhere/x.csv"] + [] * overwrite, 0.8)
        arguments = ["steganalyze", self.mostly(folders, self.anything(), 0.8), "--csv", csv]
        arguments += ["--overwrite"] * overwrite + self.maybe(0.2, "--fast") + self.absurd(0.2, "--threshold")
        return Call(arguments, csv)

    def info(self) -> Call:
        return Call(
            [
                "info",
                self.pick([*self.anything(), *self.runs(), *self.sidecars()]),
                *self.maybe(0.4, "--json"),
            ]
        )

    def keygen(self) -> Call:
        out = self.pick(["made-key-0.txt", "made-key-1.txt", "nowhere/k", ".", "", "in/key-0.txt"])
        flags = self.maybe(0.6, "-o", out)
        return Call(["keygen", *flags, *self.absurd(0.5, "--length", "--bits")], out if flags else None)

    def demo(self) -> Call:
        """Only where it must be refused: it takes a minute."""
        return Call(["demo", "-o", self.pick(["in", "in/cover.ply", "in/a"]), *self.maybe(0.2, "--seed=-1")])

    def nonsense(self) -> Call:
        words = [
            "hide",
            "fit",
            "info",
            "reveal",
            "--nonsense",
            "-o",
            "--method",
            "carry",
            "\x00x",
            "--help",
            "-",
        ]
        words += ["--thin", "--sidecar", "--key-file", "--cover"]
        return Call([self.pick(words[:4]), *(self.pick(words) for _ in range(self.random.randrange(4)))])

    # What happens to files between calls

    def fiddle(self) -> None:
        self.tidy()
        if self.random.random() < 0.35 and self.runs():
            self.leave_a_note(self.pick(self.runs()))
        if self.random.random() < 0.08 and self.runs():
            files = [
                path
                for path in sorted(Path().glob("out-*/**/*"))
                if path.is_file() and not path.is_symlink() and str(path) not in self.foreign
            ]
            if files:
                self.harm(self.random.choice(files))
        if self.random.random() < 0.06 and self.runs():
            self.remove(self.pick(self.runs()))

    def leave_a_note(self, run: str) -> None:
        self.notes += 1
        place = Path(run, self.pick(["", "checkpoint", "private", "publish", "unfinished", "private/audit"]))
        if place.is_symlink() or (place.exists() and not place.is_dir()):
            return
        place.mkdir(parents=True, exist_ok=True)
        name = place / f"note-{self.notes}.txt"
        if not Path(run).is_dir() or name.exists():
            return
        name.write_text(f"mine, number {self.notes}")
        self.foreign[str(name)] = self.state(name)
        self.history.append(f"# note {name}")

    def harm(self, path: Path) -> None:
        data = path.read_bytes()
        how = self.pick(["cut", "flip", "empty", "remove", "text"])
        self.history.append(f"# {how} {path}")
        if how == "remove":
            path.unlink()
            return
        changed = bytearray(data)
        if how == "cut":
            changed = changed[: self.random.randrange(len(data) + 1)]
        elif how == "flip" and data:
            changed[self.random.randrange(len(data))] ^= 1 << self.random.randrange(8)
        elif how == "empty":
            changed = bytearray()
        elif how == "text":
            changed = bytearray(data.replace(b"1", self.pick(["-1", "9e99", "NaN", "null"]).encode(), 3))
        path.write_bytes(changed)

    def tidy(self) -> None:
        """Bounds the disk that is used."""
        total = sum(path.lstat().st_size for path in Path().rglob("*"))
        for run in self.runs() if total > MOST_BYTES else []:
            self.remove(run)

    def remove(self, run: str) -> None:
        self.history.append(f"# remove {run}")
        self.keys.pop(run, None)
        if Path(run).is_symlink() or not Path(run).is_dir():
            Path(run).unlink()
        else:
            shutil.rmtree(run)
        self.foreign = {name: state for name, state in self.foreign.items() if not name.startswith(f"{run}/")}

    # What must hold

    def perform(self, call: Call, killed: bool) -> None:
        before = self.snapshot()
        interrupted = call.out is not None and running(call.out)
        interrupted |= call.run is not None and running(call.run)
        status, out, err, usage = self.killed(call) if killed else self.called(call)
        self.statuses[status] = self.statuses.get(status, 0) + 1
        self.history[-1] += f"  -> {status}"
        said = f"{out}\n{err}"
        allowed = STATUSES | ({-signal.SIGKILL} if killed else set())
        must(status in allowed, f"exit status {status}: {err[-2000:]}")
        must("Traceback" not in said and "internal error" not in said, err[-2000:])
        must(not re.search(r"\b[A-Z]\w*Warning: ", err), err[-2000:])
        lines = [line for line in err.splitlines() if line.startswith("keyss: ")]
        lines = [line for line in lines if not line.startswith(NOTES)]
        if status > 0 and not usage:
            must(len(lines) == 1, f"expected one line of error, got {err!r}")
        elif status == 0:
            must(not lines, f"an error with exit status 0: {err!r}")
        elif usage and status > 0:
            must(bool(err), "nothing said")
        after = self.snapshot()
        trained = " steps\n" in err
        self.check_changes(call, status, before, after, interrupted or trained)
        if status == 0:
            self.check_result(call, out)

    def called(self, call: Call) -> tuple[int, str, str, bool]:
        """Status, output and errors of a call in this process, and whether it could not even be parsed."""
        out, err, stdin = (io.TextIOWrapper(io.BytesIO(data), "utf-8") for data in (b"", b"", call.stdin))
        usage = False

        def too_long(signum: int, frame: object) -> None:
            raise Violation(f"took more than {SECONDS} s")

        with contextlib.ExitStack() as stack:
            for name, stream in (("stdout", out), ("stderr", err), ("stdin", stdin)):
                stack.enter_context(mock.patch.object(sys, name, stream))
            if call.environment is not None:
                stack.enter_context(mock.patch.dict(os.environ, {"KEYSS_KEY": call.environment}))
            old = signal.signal(signal.SIGALRM, too_long)
            signal.alarm(SECONDS)
            try:
                status = main(call.arguments)
            except SystemExit as end:
                usage, status = True, end.code if isinstance(end.code, int) else int(bool(end.code))
            except Exception as error:
                raise Violation(f"{type(error).__name__}: {error}") from error
            finally:
                signal.alarm(0)
                signal.signal(signal.SIGALRM, old)
            for stream in (out, err):
                stream.flush()
        texts = [stream.buffer.getvalue().decode(errors="replace") for stream in (out, err)]  # type: ignore[attr-defined]
        return status, texts[0], texts[1], usage

    def killed(self, call: Call) -> tuple[int, str, str, bool]:
        """The same of a process of its own that is sent a signal after a random time."""
        signum = self.random.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
        environment = dict(os.environ)
        if call.environment is not None:
            environment["KEYSS_KEY"] = call.environment
        if any("\0" in word for word in call.arguments):
            return self.called(call)
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *call.arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
        )
        assert process.stdout is not None
        with process:
            process.stdout.readline()
            delay = self.random.uniform(0, 8)
            try:
                out, err = process.communicate(timeout=delay)
            except subprocess.TimeoutExpired:
                self.history[-1] += f"  # {signum.name} after {delay:.2f} s"
                process.send_signal(signum)
                try:
                    out, err = process.communicate(timeout=SECONDS)
                except subprocess.TimeoutExpired:
                    process.kill()
                    raise Violation(f"did not end on {signum.name}") from None
        said = err.decode(errors="replace")
        return process.returncode, out.decode(errors="replace"), said, "keyss: " not in said

    def check_changes(
        self,
        call: Call,
        status: int,
        before: dict[str, State],
        after: dict[str, State],
        resumable: bool,  # there was an interrupted run, or something was trained
    ) -> None:
        overwrite, resume = call.has("--overwrite"), call.has("--resume")
        signalled = status in (130, 143, -signal.SIGKILL)
        changed = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
        named = overwrite and call.out is not None and not call.into_folder
        for name in sorted(changed):
            if name in self.foreign and not (named and same(call.out, name)):
                raise Violation(f"the foreign {name} was {before.get(name)}, is {after.get(name)}")
            if after.get(name) and after[name].kind == "folder" and before.get(name) == after[name]:
                continue
            what = f"{name}: {before.get(name)} -> {after.get(name)}"
            place = call.out if call.out is not None else call.run
            must(place is not None, f"a call that writes nothing changed {what}")
            inner = inside(name, place)
            must(inner is not None, f"changed outside of its output: {what}")
            working = inner in ("private", "private/manifest.json", "") or any(
                inner == f"private/{each}" or inner.startswith(f"private/{each}/") for each in WORKING
            )
            if status == -signal.SIGKILL:
                continue
            if status != 0:
                kept = status == 7 or signalled or resumable
                kept |= call.verb == "audit" and (working or inner.startswith("private/controls"))
                must(
                    kept and (working or call.verb == "audit" or (signalled and overwrite)),
                    f"status {status} changed {what}",
                )
            elif call.has("--dry-run"):
                raise Violation(f"a dry run changed {what}")
            elif name in before and before[name].kind == "file" and not overwrite:
                measured = {
                    "evaluate": ("private/metrics.json",),
                    "audit": ("private/report.html",),
                    "report": ("private/report.html",),
                }.get(call.verb, ())
                must(
                    working or inner in measured or (resume and working),
                    f"changed without --overwrite: {what}",
                )
            if name in after and not signalled:
                self.check_mode(call, name, after[name])
        for name in () if signalled else self.temporary(after):
            must(name in before, f"left behind: {name}")

    def temporary(self, files: dict[str, State]) -> list[str]:
        """What nothing that ended by itself leaves."""
        names = [
            name
            for name in files
            if re.search(r"\.unfinished$|(^|/)private/(unfinished|lock)(/|$)", name)
            and name not in self.foreign
        ]
        ours = [name for name in names if not any(mine.startswith(f"{name}/") for mine in self.foreign)]
        for name in files:
            run = name.removesuffix("/private/checkpoint")
            if run != name and not running(run):
                ours.append(name)
        return ours

    def check_mode(self, call: Call, name: str, state: State) -> None:
        if state.kind == "file" and call.verb == "hide" and Path(name).parent.name == "publish":
            must(state.mode == 0o644, f"{name} has mode {state.mode:o}")
        elif state.kind == "file":
            must(state.mode == 0o600, f"{name} has mode {state.mode:o}")
        elif state.kind == "folder" and Path(name).name == "private":
            must(state.mode == 0o700, f"{name} has mode {state.mode:o}")

    def check_result(self, call: Call, said: str) -> None:
        out = Path(call.out or ".")
        if call.has("--help") or call.has("-h") or call.has("--dry-run"):
            return
        if call.verb == "hide":
            self.check_hiding(call, out)
        elif call.verb == "reveal" and call.out != "-":
            found = re.search(r": ([\d,]+)(?: of ([\d,]+))? Gaussians", said)
            must(found is not None, f"no number of Gaussians: {said!r}")
            model = read_model(out)
            must(len(model) == int(found[1].replace(",", "")), f"{len(model)} Gaussians, but {said!r}")
        elif call.verb == "fit":
            must(1 <= len(read_model(out / "model.ply")) <= 2**31, "no model")
            must(not running(str(out)), "still running")
        elif call.verb == "render":
            count = int(re.search(r": (\d+) image", said)[1])  # type: ignore[index]
            there = read_manifest(out).files["render"]
            must(len(there) == count and all((out / name).is_file() for name in there), f"{count} images")
        elif call.verb in ("evaluate", "audit", "report"):
            run = Path(call.run or ".")
            made = {"evaluate": "metrics.json", "audit": "audit/audit.json", "report": "report.html"}[
                call.verb
            ]
            must((run / "private" / made).stat().st_size > 0, f"no {made}")
        elif call.verb == "keygen" and call.out is not None:
            must(bool(Path(call.out).read_text().strip()), "no key")

    def check_hiding(self, call: Call, out: Path) -> None:
        """The published file opens with its keys, and shows what was hidden."""
        words = call.arguments
        files = [path for flag, path in pairwise(words) if flag == "--key-file"]
        if files and call.out in self.folder_out():
            self.keys[str(call.out)] = files
        mine = {Path(name).name for name in self.foreign if inside(name, str(out / "publish"))}
        sidecar = {"decoder.sealed"} if call.has("--sidecar") else set()
        must(
            {path.name for path in (out / "publish").iterdir()} - mine == {"stego.ply"} | sidecar, "publish/"
        )
        limit = re.search(r"--min-psnr[= ](\S+)", " ".join(call.arguments))
        least = 20.0 if limit is None else float(limit[1])
        keys = [key_in(path) for path in files] or [call.environment or ""]
        run = open_run(out, keys)
        for key in keys:
            found = api.verify(out / "publish" / "stego.ply", key, device="cpu")
            must(not found.problems, f"verify: {found.problems}")
        for opened, scene, plain in zip(
            run.opened, run.scenes(train_pictures=False)[1:], run.plain_models()[1:], strict=True
        ):
            must(plain is not None, "no plain model")
            fidelity = render_fidelity(opened.reveal(run.stego), plain, scene)
            must(fidelity.psnr >= least, f"exit status 0 and {fidelity.psnr} dB, at least {least} expected")
            dark = min(fidelity.nothing + 3, 40)
            must(
                least <= 0 or fidelity.psnr >= dark, f"{fidelity.psnr} dB, empty pictures {fidelity.nothing}"
            )

    def snapshot(self) -> dict[str, State]:
        return {str(path): self.state(path) for path in sorted(Path().rglob("*"))}

    def state(self, path: Path) -> State:
        found = path.lstat()
        mode = stat.S_IMODE(found.st_mode)
        if stat.S_ISLNK(found.st_mode):
            return State("link", 0, os.readlink(path))
        if stat.S_ISDIR(found.st_mode):
            return State("folder", mode, "")
        if not stat.S_ISREG(found.st_mode):
            return State("other", mode, "")
        known = (found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size)
        if known not in self.hashes:
            self.hashes[known] = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        return State("file", mode, self.hashes[known])


def must(holds: object, otherwise: str) -> None:
    if not holds:
        raise Violation(otherwise)


def inside(name: str, folder: str) -> str | None:
    """`name` from `folder` on, "" for itself and None for what is not in it, whatever links lead there."""
    try:
        inner = Path(name).parent.resolve() / Path(name).name
        place = Path(folder).resolve()
        if place == inner or place.is_relative_to(inner):  # itself, and folders that were made on the way
            return ""
        if place.parent == inner.parent and inner.name == f".{place.name}.unfinished":
            return ""
        return str(inner.relative_to(place))
    except (ValueError, OSError):
        return None


def same(one: str | None, other: str) -> bool:
    return one is not None and Path(one).resolve() == Path(other).resolve()


def running(folder: str) -> bool:
    """Whether there is an interrupted run, as far as one can see."""
    path = Path(folder, "private", "manifest.json")
    try:
        return json.loads(path.read_bytes())["running"] is not None
    except FileNotFoundError:
        return False
    except (OSError, ValueError, KeyError, TypeError):
        return True  # harmed: nobody can know


def key_in(path: str) -> str:
    return Path(path).read_text("utf-8-sig").removesuffix("\n").removesuffix("\r")


# Inputs, all of them the monkey's own.

SCENES = [
    "in/a",
    "in/b",
    "in/c",
    "in/one-missing",
    "in/broken-json",
    "in/no-points",
    "in/empty",
    "in/not-images",
]
MODELS = [
    *("in/cover.ply", "in/large.ply", "in/secret.ply", "in/sh0.ply", "in/half.ply", "in/one.ply"),
    *("in/huge.ply", "in/outlier.ply", "in/nan.ply", "in/inf.ply", "in/transparent.ply", "in/zero-quats.ply"),
    *("in/cut.ply", "in/head.ply", "in/flipped.ply", "in/flipped-2.ply", "in/none.ply", "in/many.ply"),
    *("in/same.ply", "in/model.spz", "in/text.ply", "in/folder.ply", "in/link.ply", "in/dangling.ply"),
    *("in/loop.ply", "in/fifo.ply", "in/ascii.ply", "in/zero-bytes.ply", "in/decoder.sealed"),
]
KEY_FILES = [
    *("in/key-0.txt", "in/spaced.txt", "in/blank.txt", "in/binary.txt", "in/long.txt", "in/open.txt"),
    *("in/a", "nowhere.txt", "in/cover.ply", ""),
]
INPUTS = [*SCENES, *MODELS, *KEY_FILES[:-3]]
ODD_OUTS = [
    *("in", "in/a", "in/cover.ply", "in/empty", "nowhere/deep/out", "", ".", "/dev/null", "in/link-out"),
    *("in/dangling.ply", "in/mine", "out-odd\nname", "-", "-x", "out-link"),
]


def make_inputs(folder: Path) -> None:
    """Scenes, models and keys, sound and broken, in `in/`."""
    here = folder / "in"
    write_blender(here / "a", count=3, channels=3)
    write_nerfstudio(here / "b", count=4)
    write_colmap(here / "c", count=4)
    write_colmap(here / "one-missing", count=5)
    (here / "one-missing" / "images" / "02.png").unlink()
    write_colmap(here / "no-points", count=4)
    (here / "no-points" / "sparse" / "0" / "points3D.bin").unlink()
    (here / "broken-json").mkdir()
    (here / "broken-json" / "transforms.json").write_text('{"frames": [{"file_path": 3}], "w": 1e999}')
    (here / "empty").mkdir()
    save(here / "not-images" / "one.png", photo(1))
    (here / "not-images" / "two.png").write_bytes((here / "not-images" / "one.png").read_bytes()[:60])
    (here / "not-images" / "three.png").write_text("no image")
    (here / "mine" / "publish").mkdir(parents=True)
    for name in ("publish/stego.ply", "model.ply", "000.png"):
        (here / "mine" / name).write_text("mine")

    sound = random_gaussians(1200, seed=1)
    models: dict[str, Gaussians] = {
        "cover": random_gaussians(400, seed=2),
        "large": sound,
        "secret": random_gaussians(150, seed=3),
        "sh0": random_gaussians(300, seed=4, sh_degree=0),
        "one": random_gaussians(1, seed=5),
        "transparent": changed(sound[:200], "opacity_logits", slice(None), -30.0),
        "zero-quats": changed(sound[:200], "quats", slice(None), 0.0),
        "huge": changed(sound[:200], "means", slice(0, 3), 1e30),
        "outlier": changed(sound[:300], "log_scales", slice(0, 1), 60.0),
        "half": sound[:300].map(lambda values: values.half().float()),
        "same": Gaussians.cat([sound[:1]] * 200),
    }
    for name, model in models.items():
        write_ply(here / f"{name}.ply", model)
    data = (here / "cover.ply").read_bytes()
    at = data.index(b"end_header\n") + len(b"end_header\n")
    for name, number in (("nan", np.nan), ("inf", np.inf)):
        bytes_of = np.float32(number).tobytes()
        (here / f"{name}.ply").write_bytes(data[: at + 400] + bytes_of + data[at + 404 :])
    (here / "cut.ply").write_bytes(data[:-100])
    (here / "head.ply").write_bytes(data[:100])
    (here / "none.ply").write_bytes(data[:at].replace(b"vertex 400", b"vertex 0"))
    (here / "many.ply").write_bytes(data.replace(b"vertex 400", b"vertex 99999999999"))
    rng = random.Random(7)
    for name in ("flipped", "flipped-2"):
        flipped = bytearray(data)
        for _ in range(40):
            flipped[rng.randrange(at, len(data))] ^= 1 << rng.randrange(8)
        (here / f"{name}.ply").write_bytes(flipped)
    (here / "model.spz").write_bytes(b"\x1f\x8b" + bytes(50))
    (here / "text.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\nx\n"
    )
    (here / "ascii.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
    (here / "zero-bytes.ply").write_bytes(b"")
    (here / "folder.ply").mkdir()
    (here / "link.ply").symlink_to("cover.ply")
    (here / "dangling.ply").symlink_to("nothing.ply")
    (here / "loop.ply").symlink_to("loop.ply")
    (here / "link-out").symlink_to("mine")
    os.mkfifo(here / "fifo.ply")
    (here / "decoder.sealed").write_bytes(b"KEYSS" + bytes(100))
    keys = {f"key-{number}.txt": f"{key}\n".encode() for number, key in enumerate(KEYS)}
    keys |= {"spaced.txt": f" {KEYS[0]} \n".encode(), "blank.txt": b"\n", "binary.txt": b"\xff\xfe\0x"}
    keys |= {"long.txt": b"x" * 5000, "open.txt": KEYS[1].encode()}
    for name, key in keys.items():
        (here / name).write_bytes(key)
        (here / name).chmod(0o644 if name == "open.txt" else 0o600)


def changed(model: Gaussians, name: str, where: slice, value: float) -> Gaussians:
    """`model` with a number in some rows of one of its tensors."""
    tensors = {each: tensor.clone() for each, tensor in vars(model).items()}
    tensors[name][where] = torch.tensor(value)
    return Gaussians(**tensors)


if __name__ == "__main__":
    place, *numbers = sys.argv[1:]
    chosen, count = (*map(int, numbers), *(0, 1000)[len(numbers) :])
    monkey, started = Monkey(Path(place).absolute(), chosen), time.monotonic()
    try:
        monkey.play(count, keep_going=True)
    finally:
        (Path(place) / "history.txt").write_text("\n".join(monkey.history), errors="surrogateescape")
        print(f"seed {chosen}: {sum(monkey.statuses.values())} calls in {time.monotonic() - started:.0f} s")
        print("exit statuses:", dict(sorted(monkey.statuses.items())))
