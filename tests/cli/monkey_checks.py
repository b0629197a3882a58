"""What must hold after every call of the monkey."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import stat
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from cli.monkey_calls import FOLDERS_OUT, Call
from keyss import api
from keyss.files.models import read_model
from keyss.measure.hiding import show
from keyss.runs.folder import read_manifest
from keyss.runs.opening import open_run

WORKING = ("checkpoint", "unfinished", "lock")  # in `private/`, while something runs


@dataclass(frozen=True)
class State:
    """What is at a path: a change of the content, of the mode, or of the kind makes it another one."""

    kind: str
    mode: int
    content: str


class Violation(AssertionError):
    """Something that must hold and does not."""


class Checker:
    """Looks at the working folder, and at what calls said; raises Violation."""

    foreign: dict[str, State]  # what the monkey wrote and no call may touch
    hashes: dict[tuple[int, ...], str]
    keys: dict[str, list[str]]  # key files of the hidings that are there

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
        if files and call.out in FOLDERS_OUT:
            self.keys[str(call.out)] = files
        mine = {Path(name).name for name in self.foreign if inside(name, str(out / "publish"))}
        must({path.name for path in (out / "publish").iterdir()} - mine == {"stego.ply"}, "publish/")
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
            fidelity = show(opened.reveal(run.stego), plain, scene).fidelity
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
