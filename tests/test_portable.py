"""keyss uses no API that only Unix has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cheap_keys
from cli.harness import SMALL

# Dependencies use some of these on Linux: psutil is imported first, the others keep what they need.
WITHOUT = """
import os, psutil, signal, sys
for name in "fcntl resource pwd grp termios tty pty syslog".split():
    sys.modules[name] = None
for name in (
    "fork forkpty getuid geteuid getgid getegid getpgid setsid killpg fchmod fchown chown mkfifo wait4 "
    "sched_getaffinity sysconf getloadavg O_NOFOLLOW O_CLOEXEC O_NONBLOCK"
).split():
    if hasattr(os, name):
        delattr(os, name)
for name in (
    "SIGHUP SIGKILL SIGALRM SIGCHLD SIGPIPE SIGQUIT SIGUSR1 SIGUSR2 alarm setitimer pthread_sigmask"
).split():
    delattr(signal, name)
"""


def test_hide_and_reveal_without_unix_only_apis(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "key.txt").write_text("q7Rv2LxT9bWm4KzD\n")

    def keyss(*arguments: object) -> None:
        program = [sys.executable, "-c", WITHOUT + cheap_keys.PROGRAM, *map(str, arguments)]
        done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    cover, secret = folders
    scenes = ("--cover", cover, "--secret", secret, "--publish", "converted", "--min-psnr", 0)
    keyss("hide", *scenes, "--key-file", "key.txt", "-o", "out", *SMALL)
    stego = tmp_path / "out" / "publish" / "model.ply"
    keyss("reveal", stego, "--key-file", "key.txt", "-o", "secret.ply", "--device", "cpu")
    assert (tmp_path / "secret.ply").stat().st_size > 1000
    assert not list(tmp_path.rglob("*.lock"))
