"""The public names: complete, each where it says, and none loaded before it is used."""

import importlib
import pkgutil
import subprocess
import sys
from types import ModuleType

import pytest

import mmmgpu
from mmmgpu.bench.startup import FIRST_FRAME

SLOW = {
    *("av", "cv2", "daqp", "espeakng_loader", "matplotlib", "numba", "numpy", "pocketsphinx"),
    *("pyopencl", "rich", "safetensors", "scipy", "sklearn", "typer", "warp"),
}

PUBLIC = [name for name in mmmgpu.__all__ if name != "__version__"]


def loaded_by(statement):
    """Top-level modules that a fresh Python has loaded after `statement`."""
    program = f"import sys\n{statement}\nprint(*{{name.partition('.')[0] for name in sys.modules}})"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_importing_the_package_loads_no_library():
    assert loaded_by("import mmmgpu") & SLOW == set()


def test_the_list_of_slow_libraries_is_seen():
    assert loaded_by("import mmmgpu; mmmgpu.get_backend") & SLOW == {"numpy"}


def test_a_report_loads_what_draws_only_when_it_draws():
    assert "matplotlib" not in loaded_by("import mmmgpu.reports, mmmgpu.transfer_reports")


@pytest.mark.parametrize("runtime", ["warp", "opencl"])
def test_the_first_frame_waits_for_no_scipy(runtime):
    """SciPy takes as long to load as half of Warp."""
    loaded = loaded_by(f"import sys\nsys.argv[1:] = ['{runtime}']\n{FIRST_FRAME}")
    assert runtime.replace("opencl", "pyopencl") in loaded
    assert "scipy" not in loaded


@pytest.mark.parametrize("name", PUBLIC)
def test_name_is_there(name):
    assert getattr(mmmgpu, name) is not None


def test_every_name_has_a_home_and_only_one():
    homes = [name for names in mmmgpu._HOMES.values() for name in names]
    homes += [module for module, names in mmmgpu._HOMES.items() if not names]
    assert sorted(homes) == sorted(PUBLIC)


@pytest.mark.parametrize("module", mmmgpu._HOMES)
def test_name_is_the_one_of_its_home(module):
    home = importlib.import_module(f"mmmgpu.{module}")
    for name in mmmgpu._HOMES[module]:
        assert getattr(mmmgpu, name) is getattr(home, name)


def test_no_name_hides_a_module():
    """Importing a module sets its name in the package: a function of that name would vanish."""
    modules = {module.name for module in pkgutil.iter_modules(mmmgpu.__path__)}
    public_modules = {name for name in PUBLIC if isinstance(getattr(mmmgpu, name), ModuleType)}
    assert modules & set(PUBLIC) == public_modules


def test_dir_lists_the_public_names():
    assert dir(mmmgpu) == sorted(mmmgpu.__all__)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'unknown'"):
        _ = mmmgpu.unknown


def test_every_name_is_documented():
    undocumented = [name for name in PUBLIC if not (getattr(mmmgpu, name).__doc__ or "").strip()]
    assert undocumented == []
