"""The processor time and the memory of reading hostile files, and the work that grows with them."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import torch

from files import hostile
from files.formats.false_sizes import FALSE_SIZES
from keyss.core import Camera
from keyss.files.images import png_names
from keyss.files.model_formats import FORMATS


def test_hostile_files_stay_within_limits() -> None:
    command = [sys.executable, hostile.__file__, "--json"]
    output = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False).stdout
    costs = [hostile.Cost(**json.loads(line)) for line in output.splitlines()]
    assert [cost.name for cost in costs] == list(hostile.HOSTILE)
    assert not [cost for cost in costs if not cost.bounded]


def test_every_format_has_hostile_files() -> None:
    names = {f"a{suffix}" for model_format in FORMATS for suffix in model_format.suffixes}
    files = {file for name in hostile.HOSTILE for file in hostile.HOSTILE[name](10_000)}
    assert names - {"a.compressed.ply"} <= files
    assert names - {"a.splat"} <= FALSE_SIZES.keys()  # which declares none


def test_picture_names_take_linear_time() -> None:
    camera = Camera(torch.eye(4), torch.eye(3), 1, 1, "a/b.jpg")
    cameras = [replace(camera, name=f"a{'/' * (index % 2)}_b.jpg") for index in range(20_000)]
    names = png_names([camera, *cameras])
    assert names[:3] == ["a_b.png", "a_b-2.png", "a__b.png"]
    assert len(set(names)) == len(cameras) + 1
