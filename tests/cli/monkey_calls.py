"""What the monkey calls: random arguments, most of them with a meaning."""

from __future__ import annotations

import contextlib
import random
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cli.monkey_inputs import INPUTS, KEY_FILES, KEYS, ODD_OUTS

SMALL = ("--iterations", "5", "--max-gaussians", "100", "--width", "16", "--device", "cpu")
FOLDERS_OUT = [f"out-{number}" for number in range(8)]


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


class Caller:
    """Makes calls up; its folder is the working folder."""

    random: random.Random
    keys: dict[str, list[str]]  # key files of the hidings that are there

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
        patterns = ("out-*/publish/stego.ply", "out-*/**/*.ply", "made-*.ply")
        made = [str(path) for pattern in patterns for path in sorted(Path().glob(pattern))]
        return ["in/cover.ply", "in/secret.ply", *made]

    def anything(self) -> list[str]:
        return [*INPUTS, *self.models(), *self.runs(), "nowhere", "nowhere/x.ply", "", ".", "-", "/dev/null"]

    def runs(self) -> list[str]:
        return [str(path) for path in sorted(Path().glob("out-*"))]

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
        out = self.mostly(FOLDERS_OUT, self.odd_out(), 0.9)
        arguments = ["hide", "--cover", cover, "--method", method, "--out", out]
        for secret, file in zip(secrets, files, strict=True):
            arguments += ["--secret", secret, "--key-file", self.mostly([file], KEY_FILES, 0.95)]
        trained = method == "learned" or not all(each.endswith(".ply") for each in (cover, *secrets))
        arguments += ["--width", "16", *self.device(), *self.again()]
        if trained or self.random.random() < 0.05:
            most = [] if not scenes and self.random.random() < 0.7 else ["--max-gaussians", "100"]
            arguments += ["--iterations", "5", *most]
        if method == "learned":
            arguments += self.maybe(0.15, "--sh-degree", self.pick(["0", "1", "2", "3", "4", "-1"]))
            arguments += self.maybe(0.05, "--mask", self.pick(["op", "op,sh", "xyz,ro", "", "x", "op,op"]))
            arguments += self.maybe(0.03, "--start", "points") + self.maybe(0.02, "--key-encoder", "clip")
        else:
            arguments += self.maybe(0.3, "--thin") + self.maybe(0.2, "--dither")
        arguments += self.maybe(0.75 if scenes else 0.3, "--publish", "any")
        arguments += self.maybe(0.6 if scenes else 0.1, f"--min-psnr={self.pick(['0', '5', '60', '-3'])}")
        arguments += self.maybe(0.06, "--dry-run") + self.maybe(0.05, "--skip-missing")
        arguments += self.maybe(0.04, "--cover-model", self.pick(self.anything()))
        arguments += self.maybe(0.04, "--preset", self.pick(["best", "quick", "none"]))
        absurd = ("--iterations", "--max-gaussians", "--width", "--seed", "--min-psnr", "--background")
        arguments += self.absurd(0.1, *absurd)
        return Call(arguments, out, into_folder=True, secrets=[KEYS[key] for key in keys])

    def fit(self) -> Call:
        scene = self.mostly(["in/a", "in/b", "in/c"], self.anything(), 0.7)
        out = self.mostly(FOLDERS_OUT, self.odd_out(), 0.8)
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
        made = [str(path) for path in sorted(Path().glob("out-*/publish/*.ply"))]
        return self.mostly(made, [*self.models(), *self.anything()], 0.75)

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
        arguments += self.maybe(0.1, "--frame", self.pick(["secret", "cover", "none"]))
        return Call(arguments, out)

    def verify(self) -> Call:
        stego = self.stego()
        key = self.key_file(stego.partition("/")[0], 0.9) if self.random.random() < 0.7 else []
        arguments = ["verify", stego, *key, *self.maybe(0.3, "--json"), *self.device()]
        return Call(arguments)

    def render(self) -> Call:
        cameras = self.mostly(["in/a", "in/b", "in/c"], self.anything(), 0.8)
        out = self.mostly([*FOLDERS_OUT, "out-images"], self.odd_out(), 0.8)
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
        audited = [str(path.parents[2]) for path in sorted(Path().glob("out-*/private/audit/audit.json"))]
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
                self.pick([*self.anything(), *self.runs()]),
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
        words += ["--thin", "--publish", "--key-file", "--cover"]
        return Call([self.pick(words[:4]), *(self.pick(words) for _ in range(self.random.randrange(4)))])
