"""A monkey at the command line: random calls on random files, and what must hold after each of them.

It works in one folder, so that runs pile up and outputs collide; between calls it does what people do to
files: breaks, removes and copies them, and leaves notes of its own in folders of results. Most calls run in
this process, some in one of their own that is killed after a random time. Key derivation is made cheap.

    python tests/cli/monkey.py FOLDER [SEED] [CALLS]
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

from cli.monkey_calls import Call, Caller
from cli.monkey_checks import Checker, State, Violation, must, running
from cli.monkey_inputs import make_inputs
from keyss.cli import main
from keyss.keys import derivation

# README; 141 has a test of its own, and 70 is always a mistake.
STATUSES = {0, 2, 3, 4, 5, 6, 7, 130, 143}
SECONDS = 120  # for one call
MOST_BYTES = 300 << 20  # of the folder; beyond it the monkey clears runs away
NOTES = ("keyss: warning: ", "keyss: skipped ", "keyss: compiling ")  # on standard error, not errors
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


class Monkey(Caller, Checker):
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
