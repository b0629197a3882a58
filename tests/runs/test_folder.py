"""Run folders: all files or none, foreign files stay."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from keyss.core import KeyssWarning, OutputError, UsageError
from keyss.files import lock, write_bytes
from keyss.runs import MANIFEST, Manifest, RunFolder, read_manifest, write_again


def read_files(folder: Path) -> dict[str, bytes]:
    """All files except the manifest."""
    files = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    return {name: data for name, data in files.items() if not name.endswith(MANIFEST)}


def write_run(path: Path, stage: str = "hide", files: dict[str, bytes] | None = None, **how: object) -> None:
    folder = RunFolder(path, stage, **how)  # type: ignore[arg-type]
    with folder.work():
        names = {"publish/model.ply": b"1", "private/cover.ply": b"2"} if files is None else files
        folder.write(names)


def interrupt(path: Path, arguments: dict[str, object], stage: str = "hide", **how: bool) -> None:
    """Interrupt a run after its checkpoint."""
    folder = RunFolder(path, stage, arguments, **how)
    with pytest.raises(KeyboardInterrupt), folder.work():  # noqa: PT012
        write_bytes(folder.checkpoints / "fit", b"state")
        folder.write({"publish/model.ply": b"half"})
        raise KeyboardInterrupt


def test_files_and_permissions(tmp_path: Path, umask: None) -> None:
    folder = RunFolder(tmp_path / "a" / "run", "hide")
    assert list(tmp_path.iterdir()) == []
    with folder.work():
        (folder.checkpoints / "fit").touch()
        folder.write({"publish/model.ply": b"1", "private/cover.ply": b"2"})
        assert read_files(tmp_path).keys().isdisjoint({"a/run/publish/model.ply"})
    assert read_files(folder.path) == {"publish/model.ply": b"1", "private/cover.ply": b"2"}
    modes = {str(p.relative_to(folder.path)): p.stat().st_mode & 0o777 for p in folder.path.rglob("*")}
    assert modes == {
        "publish": 0o755,
        "publish/model.ply": 0o644,
        "private": 0o700,
        "private/cover.ply": 0o600,
        MANIFEST: 0o600,
    }


@pytest.mark.parametrize("there", [True, False])
def test_failed_write_leaves_nothing(tmp_path: Path, there: bool) -> None:
    path = tmp_path / "run"
    if there:
        write_run(path)
    before = read_files(tmp_path), read_manifest(path)
    folder = RunFolder(path, "hide", overwrite=there)
    with pytest.raises(OutputError, match="cannot write"), folder.work():
        folder.write({"publish/model.ply": b"new", "publish/model.ply/y": b"in a file"})
    with pytest.raises(KeyboardInterrupt), folder.work():  # noqa: PT012
        folder.write({"publish/model.ply": b"new"})
        raise KeyboardInterrupt
    assert (read_files(tmp_path), read_manifest(path)) == before
    assert path.exists() == there


def test_overwrite(tmp_path: Path) -> None:
    write_run(tmp_path, files={"publish/model.ply": b"1", "publish/model.spz": b"2", "private/old/x": b"3"})
    write_run(tmp_path, "audit", {"private/report.md": b"4"}, onto=("hide",))
    foreign = {
        "notes.txt": b"mine",
        "checkpoint/x": b"my own",
        "private/old/mine": b"!",
        "publish/readme": b"?",
    }
    for name, data in foreign.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    write_run(tmp_path, files={"publish/model.ply": b"new"}, overwrite=True)
    assert read_files(tmp_path) == foreign | {"publish/model.ply": b"new"}
    assert read_manifest(tmp_path).files == {"hide": ("publish/model.ply",)}


def test_foreign_files_are_kept(tmp_path: Path) -> None:
    (tmp_path / "publish").mkdir()
    (tmp_path / "publish" / "model.ply").write_bytes(b"mine")
    with pytest.raises(OutputError, match="in the way"):
        RunFolder(tmp_path, "hide", writes=("publish/model.ply",), overwrite=True)
    with pytest.raises(OutputError, match="in the way"):
        write_run(tmp_path, overwrite=True)
    assert read_files(tmp_path) == {"publish/model.ply": b"mine"}


def test_existing_folder(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(OutputError, match="exists: choose another folder"):
        RunFolder(tmp_path, "hide")
    with pytest.raises(OutputError, match="no interrupted run"):
        RunFolder(tmp_path, "hide", resume=True)
    with pytest.raises(OutputError, match="is not a folder"):
        RunFolder(tmp_path / "notes.txt", "hide")
    with pytest.raises(UsageError, match="give one of them"):
        RunFolder(tmp_path, "hide", overwrite=True, resume=True)
    write_run(tmp_path, overwrite=True)
    with pytest.raises(OutputError, match=r"holds a finished run \(hide\)"):
        RunFolder(tmp_path, "hide", resume=True)


def test_resume(tmp_path: Path) -> None:
    options = {"seed": 0, "iterations": 10, "fit": {"iterations": 10}}
    arguments: dict[str, object] = {"width": 200, "options": options}
    interrupt(tmp_path, arguments)
    assert read_files(tmp_path) == {"private/checkpoint/fit": b"state"}
    with pytest.raises(OutputError, match=r"interrupted run.*`resume=True`"):
        RunFolder(tmp_path, "hide", arguments)
    other = {"width": 160, "options": {"seed": 0, "iterations": 20, "fit": {"iterations": 20}}}
    with pytest.raises(OutputError, match=r"\(iterations: 10 then, 20 now; width: 200 then, 160 now\)"):
        RunFolder(tmp_path, "hide", other, resume=True)
    with pytest.raises(OutputError, match="of another kind"):
        RunFolder(tmp_path, "fit", arguments, resume=True)
    first = RunFolder(tmp_path, "hide", arguments, resume=True).earlier_seconds
    interrupt(tmp_path, arguments, resume=True)
    folder = RunFolder(tmp_path, "hide", arguments, resume=True)
    assert 0 < first < folder.earlier_seconds
    with folder.work():
        assert (folder.checkpoints / "fit").read_bytes() == b"state"
        folder.write({"publish/model.ply": b"whole"})
    assert read_files(tmp_path) == {"publish/model.ply": b"whole"}


def test_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused before any work."""
    asked: list[Path] = []
    monkeypatch.setattr("os.access", lambda path, mode: bool(asked.append(path)))
    with pytest.raises(OutputError, match="is not writable"):
        RunFolder(tmp_path / "a" / "b", "render")
    assert asked == [tmp_path.resolve()]


def test_resume_without_a_checkpoint(tmp_path: Path) -> None:
    with pytest.warns(KeyssWarning, match="holds no checkpoint: starting anew"):
        RunFolder(tmp_path / "new", "hide", resume=True)
    interrupt(tmp_path, {})
    RunFolder(tmp_path, "hide", {}, resume=True)  # warnings are errors


def test_killed_before_first_checkpoint(tmp_path: Path) -> None:
    interrupt(tmp_path, {"width": 1})
    (tmp_path / "private" / "checkpoint" / "fit").unlink()
    write_run(tmp_path)
    assert read_files(tmp_path)["publish/model.ply"] == b"1"
    assert read_manifest(tmp_path).running is None


@pytest.mark.filterwarnings("ignore:.*starting anew")
@pytest.mark.parametrize("resume", [False, True])
def test_killed_before_the_manifest(tmp_path: Path, resume: bool) -> None:
    (tmp_path / "private").mkdir()
    for name in ("lock", ".manifest.json.lock", ".manifest.json.unfinished"):
        (tmp_path / "private" / name).touch()
    write_run(tmp_path, resume=resume)
    assert read_files(tmp_path)["publish/model.ply"] == b"1"


def test_lock(tmp_path: Path) -> None:
    write_run(tmp_path)
    with lock(tmp_path / "private" / "lock", tmp_path):
        with pytest.raises(OutputError, match="another process is writing it"):
            RunFolder(tmp_path, "hide", overwrite=True)
        with pytest.raises(OutputError, match="another process is writing it"):
            write_again(tmp_path, "hide", "private/metrics.json", b"1")
    assert (tmp_path / MANIFEST).exists()


@pytest.mark.parametrize("name", ["../victim", "/etc/passwd", "a/../../victim", "", MANIFEST])
def test_forged_manifest(tmp_path: Path, name: str) -> None:
    (tmp_path / "victim").write_bytes(b"mine")
    run = tmp_path / "run"
    write_run(run)
    (run / MANIFEST).write_bytes(msgspec.json.encode(Manifest(files={"hide": (name,)})))
    with pytest.raises(OutputError, match="is not a file in this folder"):
        RunFolder(run, "hide", overwrite=True)


def test_symlinks_are_not_followed(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "model.ply").write_bytes(b"mine")
    run = tmp_path / "run"
    write_run(run)
    (run / "publish" / "model.ply").unlink()
    (run / "publish").rmdir()
    (run / "publish").symlink_to(elsewhere)
    with pytest.raises(OutputError, match="leads out of"):
        write_run(run, overwrite=True)
    assert (elsewhere / "model.ply").read_bytes() == b"mine"
