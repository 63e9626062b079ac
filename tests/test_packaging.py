"""The wheel ships every kernel and the benchmarks; their bare names are not installed."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_wheel_has_every_kernel(tmp_path):
    source = tmp_path / "source"  # a clean copy: setuptools would reuse a stale build/lib
    for folder in ("bench", "kernels", "mmmgpu"):
        shutil.copytree(ROOT / folder, source / folder)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "-q"]
    subprocess.run([*pip, "-w", tmp_path, source], check=True, capture_output=True)

    (wheel,) = tmp_path.glob("*.whl")
    shipped = set(zipfile.ZipFile(wheel).namelist())
    sources = [f for f in (ROOT / "kernels").iterdir() if f.suffix in {".py", ".cl"}]
    assert {f"mmmgpu/kernels/{f.name}" for f in sources} <= shipped
    assert {f"mmmgpu/bench/{f.name}" for f in (ROOT / "bench").glob("*.py")} <= shipped
    for page, stem in (("marking_page", "mark"), ("study_page", "study")):
        files = (ROOT / "mmmgpu" / page).iterdir()
        shown = {f.name for f in files if f.suffix in {".css", ".html", ".js"}}
        assert {f"{stem}.html", f"{stem}.css", f"{stem}.js"} <= shown
        assert {f"mmmgpu/{page}/{name}" for name in shown} <= shipped
    assert not any(name.startswith(("bench/", "kernels/")) for name in shipped)
