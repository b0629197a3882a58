"""Only the commands of the laboratory need the extra `audit`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cheap_keys
from channels.lsb.trained_like import trained_like
from cli.harness import write_workspace
from keyss.files import write_model

WITHOUT = f"""
import json, sys
for name in ("ot", "sklearn"):
    sys.modules[name] = None
sys.path.append({str(Path(cheap_keys.__file__).parent)!r})
import argon2.low_level, cheap_keys
argon2.low_level.hash_secret_raw = cheap_keys.hash_secret_raw
from keyss.cli import main
statuses = {{line: main(line.split()) for line in sys.argv[1:]}}
print(json.dumps(statuses))
"""
WORKING = (
    "hide --method carry --cover cover.ply --secret secret.ply --width 16 -o run",
    "reveal run/publish/model.ply -o revealed.ply",
    "evaluate run",
    "view run/publish/model.ply -o page.html",
)
REFUSED = (
    "audit run",
    "compare --cover a --secret b -o out",
    "reproduce masks a b -o out",
)


def test_without_audit_extra(tmp_path: Path) -> None:
    write_workspace(tmp_path)
    write_model(tmp_path / "cover.ply", trained_like(1500))
    write_model(tmp_path / "secret.ply", trained_like(500, 1))
    command = [sys.executable, "-c", WITHOUT, *WORKING, *REFUSED]
    environment = {**os.environ, "KEYSS_KEY": "q7Rv2LxT9bWm4KzD"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, timeout=120)
    assert done.returncode == 0, done.stderr
    statuses = json.loads(done.stdout.splitlines()[-1])
    assert not (tmp_path / "out").exists()
    assert statuses == dict.fromkeys(WORKING, 0) | dict.fromkeys(REFUSED, 6), done.stderr
    for line in done.stderr.splitlines()[-len(REFUSED) :]:
        assert line.startswith("keyss: error: to ")
        assert "pip install 'keyss[audit]'" in line
