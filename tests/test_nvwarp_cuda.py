"""Kernels compile for CUDA, which takes the compiler in Warp's wheel and no GPU."""

import importlib
from pathlib import Path

import pytest
import warp as wp

import mmmgpu.kernels
from mmmgpu.backends import get_backend

ROOT = Path(mmmgpu.kernels.__file__).parent
STEMS = sorted(p.stem for p in ROOT.glob("*.py") if "@wp.kernel" in p.read_text())


@pytest.mark.parametrize("stem", STEMS)
def test_kernels_compile_for_cuda(stem, tmp_path):
    get_backend("warp")
    module = importlib.import_module(f"mmmgpu.kernels.{stem}")
    wp.compile_aot_module(module, arch=80, use_ptx=True, module_dir=tmp_path)
    (code,) = tmp_path.rglob("*.ptx")
    entries = [line for line in code.read_text().splitlines() if ".entry" in line]
    wanted = [name for name, value in vars(module).items() if isinstance(value, wp.Kernel)]
    assert wanted
    for name in wanted:
        assert any(f" {name}_" in line for line in entries), name
