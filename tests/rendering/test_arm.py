"""Kernels compile for another architecture: nothing in them assumes an x86 processor."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import numba
import torch
from llvmlite import binding as llvm

from keyss.rendering import render
from keyss.rendering.cpu import blending, projection
from rendering import child_process
from tiny_scenes import random_gaussians, tiny_scene

TARGET = "aarch64-unknown-linux-gnu"
# numba's reference counting, compiled for this processor.
RUNTIME = re.compile(r"^define [^\n]*@(NRT_\w+|nrt_\w+)\([^\n]*\{\n.*?^\}\n", re.MULTILINE | re.DOTALL)
NATIVE = re.compile(r'"target-(?:cpu|features)"="[^"]*"|^target (?:triple|datalayout) = .*$', re.MULTILINE)
VECTOR_ARITHMETIC = re.compile(r"\bf(?:mla|mul|add)\tv\d+\.4s")


def count_vector_instructions() -> list[int]:
    """Vector instructions of each kernel, compiled for TARGET; LLVM aborts on what the target lacks."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    model = random_gaussians(50)
    model.means.requires_grad_(True)
    render(model, tiny_scene(0).train[0].camera, torch.zeros(3)).sum().backward()
    machine = llvm.Target.from_triple(TARGET).create_target_machine(opt=2)
    found = []
    for kernel in (projection.project, blending.blend_backward):
        compiled = numba.njit(**kernel.targetoptions)(kernel.py_func)  # code from the cache has no IR
        compiled.compile(kernel.signatures[0])
        (overload,) = compiled.overloads.values()
        code = RUNTIME.sub("", str(overload.library._get_module_for_linking()))
        called = {name for name in ("NRT_incref", "NRT_decref") if f"@{name}(" in code}
        code = NATIVE.sub("", code) + "".join(f"declare void @{name}(i8*)\n" for name in sorted(called))
        module = llvm.parse_assembly(code)
        module.triple, module.data_layout = TARGET, str(machine.target_data)
        found.append(len(VECTOR_ARITHMETIC.findall(machine.emit_assembly(module))))
    return found


def test_kernels_compile_for_arm() -> None:
    program = "import rendering.test_arm as t; print(*t.count_vector_instructions())"
    tests = str(Path(__file__).parents[1])
    done = child_process.python(program, PYTHONPATH=os.pathsep.join([tests, *sys.path]))
    assert done.returncode == 0, done.stderr[-3000:]
    assert all(int(count) > 50 for count in done.stdout.split()[-2:]), done.stdout
