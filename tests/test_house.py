"""The order of the house: what may lie in the repository, and who may import whom."""

import ast
import re
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

MEDIA = {
    *(".mp4", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".gif", ".bmp", ".tif", ".tiff", ".webp"),
    *(".wav", ".mp3", ".flac", ".ogg", ".m4a", ".npz", ".npy", ".mmm", ".safetensors", ".pkl"),
}
PICTURES = {".png", ".jpg", ".jpeg"}  # only of the drawn performer, only in docs/
LARGEST = 500_000  # bytes of a file
LONGEST = 400  # lines of a module

ELSEWHERE = re.compile(  # a folder of one machine, an address, a name in a private network
    r"(?<![\w./~-])/(?:home|root|work|workspace|users|opt|srv|mnt|tmp|data|private|volumes)/\w"
    r"|\b[a-z]:\\+users\b"
    r"|\b(?:10|127|172|192)\.\d{1,3}\.\d{1,3}\.\d{1,3}\b"
    r"|\w\.(?:internal|corp|lan|intranet)\b(?!\()",
    re.IGNORECASE,
)

# Tests that mirror no module: they hold for several, or for all.
TOPICS = {"api", "bad_input", "house", "kernel_twins", "no_vacuous_tests", "packaging", "real"}

# cli -> domain -> arrays, backends -> kernels: a module may import its own layer and those below.
LAYERS = {
    "mmmgpu.kernels": 0,
    "mmmgpu.errors": 1,
    "mmmgpu.arrays": 1,
    "mmmgpu.files": 1,
    "mmmgpu.backends": 1,
    "mmmgpu.bench.__main__": 3,
    "mmmgpu.cli": 3,
    "mmmgpu.commands": 3,
    "mmmgpu.__main__": 3,
}
DOMAIN = 2  # every other module
SHARED = {
    f"mmmgpu.kernels.{name}" for name in ("carrying", "lanes", "orientation", "pyramid", "rings")
}  # functions


def tracked_files():
    """The files of the repository; of a copy without git, those outside hidden and made folders."""
    listing = subprocess.run(
        ["git", "-C", ROOT, "ls-files", "-z"], capture_output=True, text=True, check=False
    )
    if listing.returncode == 0:
        return [ROOT / name for name in listing.stdout.split("\0") if (ROOT / name).is_file()]
    folders = [ROOT / name for name in (".ci", "bench", "docs", "kernels", "mmmgpu", "tests")]
    inside = [p for folder in folders for p in folder.rglob("*") if "__pycache__" not in p.parts]
    return [p for p in (*ROOT.iterdir(), *inside) if p.is_file()]


TRACKED = tracked_files()
OUTSIDE = ("bench", "kernels")  # folders that are installed as mmmgpu.NAME
MODULES = [p for name in (*OUTSIDE, "mmmgpu") for p in ROOT.glob(f"{name}/**/*.py")]


def module_name(path):
    """The name under which a source file is imported."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = ("mmmgpu", *parts) if parts[0] in OUTSIDE else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {module_name(path) for path in MODULES}


def imports(source, name):
    """Full names of all that the module `name` imports, those inside functions too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            above = name.split(".")[: -node.level] if node.level else []
            origin = ".".join([*above, *filter(None, [node.module])])
            inner = {f"{origin}.{alias.name}" for alias in node.names} & NAMES
            yield from inner or {origin}


def layer(name):
    return next((n for home, n in LAYERS.items() if f"{name}.".startswith(f"{home}.")), DOMAIN)


def upward(source, name):
    """What `name` imports from above its layer; for a kernel, all but Warp and shared functions."""
    for target in imports(source, name):
        if layer(name) == 0 and target not in {"warp", *SHARED}:
            yield target
        if target.partition(".")[0] == "mmmgpu" and layer(target) > layer(name):
            yield target


def cases(paths):
    return [pytest.param(path, id=str(path.relative_to(ROOT))) for path in sorted(paths)]


def test_there_are_files():
    assert ROOT / "pyproject.toml" in TRACKED
    assert {"mmmgpu", "mmmgpu.backends.opencl", "mmmgpu.kernels.blend"} <= NAMES


def test_nothing_speaks_of_a_machine():
    found = [
        f"{path.relative_to(ROOT)}: {match.group()}"
        for path in TRACKED
        if path.suffix not in PICTURES
        for match in ELSEWHERE.finditer(path.read_text(encoding="utf-8"))
    ]
    assert found == []


SPELT_OUT = ["/ho_me/ann/x.py", "'/t_mp/x'", "C:\\Us_ers\\ann", "http://host.int_ernal"]


@pytest.mark.parametrize("text", SPELT_OUT)
def test_a_machine_is_seen(text):
    assert ELSEWHERE.search(text.replace("_", ""))


@pytest.mark.parametrize("text", ["../shared/data", "docs/data/x", "a / tmp", "np.random/home"])
def test_other_paths_are_no_machine(text):
    assert not ELSEWHERE.search(text)


def test_no_media_and_nothing_large():
    media = [p for p in TRACKED if p.suffix.lower() in MEDIA]
    media += [p for p in TRACKED if p.suffix.lower() in PICTURES and p.parent != ROOT / "docs"]
    assert media == []
    assert [p for p in TRACKED if p.stat().st_size > LARGEST] == []


@pytest.mark.parametrize("path", cases(MODULES))
def test_module_is_documented_and_short(path):
    source = path.read_text()
    tree = ast.parse(source)
    assert ast.get_docstring(tree)
    assert len(source.splitlines()) <= LONGEST
    kernels = path.parent.name == "kernels"  # the module says what they do
    public = [n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    public = [n for n in public if not n.name.startswith("_") and not kernels]
    assert [n.name for n in public if not ast.get_docstring(n)] == []


@pytest.mark.parametrize("path", cases(MODULES))
def test_nothing_imports_upward(path):
    assert list(upward(path.read_text(), module_name(path))) == []


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("mmmgpu.kernels.blend", "import numpy"),
        ("mmmgpu.kernels.blend", "from mmmgpu.kernels import sample"),
        ("mmmgpu.arrays", "from mmmgpu import flows"),
        ("mmmgpu.backends.opencl", "def f():\n    from ..flows import pull"),
        ("mmmgpu.flows", "from .cli import main"),
        ("mmmgpu.flows", "import mmmgpu.cli"),
    ],
)
def test_an_import_upward_is_seen(name, source, monkeypatch):
    monkeypatch.setitem(globals(), "NAMES", {*NAMES, "mmmgpu.cli"})
    assert list(upward(source, name))


@pytest.mark.parametrize("path", cases([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]))
def test_documents_name_files_that_exist(path):
    text = path.read_text()
    links = [path.parent / link for link in re.findall(r"\]\((?!https?:)([^)#]+)", text)]
    own = r"`((?:bench|docs|kernels|mmmgpu|tests)/(?![^`]*NAME)[\w/]+\.\w+)`"
    files = [ROOT / name for name in re.findall(own, text)]
    assert [str(file) for file in (*links, *files) if not file.exists()] == []


def test_every_package_is_installed():
    project = (ROOT / "pyproject.toml").read_text()
    listed = re.search(r"^packages = \[(.*)\]$", project, re.MULTILINE).group(1)
    packages = {module_name(path) for path in MODULES if path.name == "__init__.py"}
    assert set(re.findall(r"[\w.]+", listed)) == packages


def test_every_library_is_a_stated_dependency():
    project = (ROOT / "pyproject.toml").read_text()
    stated = set(re.findall(r'^    "([\w-]+).*>=', project, re.MULTILINE))
    distributions = packages_distributions()
    used = {
        target.partition(".")[0]
        for path in MODULES
        for target in imports(path.read_text(), module_name(path))
    }
    strange = used - sys.stdlib_module_names - {"mmmgpu"}
    assert strange
    unstated = [
        name
        for name in strange
        if not stated & {d.lower().replace("_", "-") for d in distributions.get(name, [name])}
    ]
    assert unstated == []


@pytest.mark.parametrize("path", cases(ROOT.glob("tests/test_*.py")))
def test_tests_mirror_modules(path):
    stem = path.stem.removeprefix("test_")
    modules = {name.rpartition(".")[2] for name in NAMES}
    assert stem in TOPICS | modules or any(stem.startswith(f"{m}_") for m in modules)
