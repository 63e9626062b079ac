"""Kernels that Warp keeps for the next process: whole, or compiled again."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import warp as wp
from test_backends import ONE_OPERATION, WARP_CACHE, run

from mmmgpu.backends import warp_cache
from mmmgpu.backends.warp_cache import load


def flipped(content):
    quarter = len(content) // 4
    middle = bytes(byte ^ 255 for byte in content[quarter:-quarter])
    return content[:quarter] + middle + content[-quarter:]


DAMAGES = {
    "other bytes": lambda content: b"\xff" * 50,
    "filled with NULs": lambda content: bytes(len(content)),
    "bytes flipped in the middle": flipped,
    "truncated": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
}


def damage(path, how):
    path.write_bytes(DAMAGES[how](path.read_bytes()))


@pytest.fixture(scope="module")
def real_cache(tmp_path_factory):
    """A folder with the kernels of one operation, and what that operation gives."""
    folder = tmp_path_factory.mktemp("cache")
    return folder, run(WARP_CACHE + ONE_OPERATION, "warp", folder)


@pytest.mark.parametrize("how", DAMAGES)
def test_a_process_survives_a_damaged_object_file(real_cache, how):
    folder, whole = real_cache
    objects = list(folder.rglob("*.o"))
    assert objects
    for path in objects:
        damage(path, how)
    assert run(WARP_CACHE + ONE_OPERATION, "warp", folder) == whole


CONTENT = {"wp_m.cpp": b"source", "wp_m.cpu.o": bytes(range(200)), "wp_m.meta": b"{} " * 50}


class Module:
    """A module of Warp whose compiler and loader are not real: what it loads is what is there."""

    def __init__(self):
        self.compiled = 0

    def get_module_identifier(self, block):
        return "wp_m"

    def load(self, device, block):
        entry = Path(wp.config.kernel_cache_dir, "wp_m")
        if not all((entry / name).exists() for name in CONTENT):
            entry.mkdir(exist_ok=True)
            for name, content in CONTENT.items():
                time.sleep(0.01)
                (entry / name).write_bytes(content)
            self.compiled += 1
        return {name: (entry / name).read_bytes() for name in CONTENT}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A folder with the entry of a `Module`."""
    for name in ("cache", "own"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "cache"))
    monkeypatch.setattr(warp_cache, "own_folder", lambda: str(tmp_path / "own"))
    load(Module(), "cpu", 1)
    return tmp_path / "cache"


def loaded(compiled):
    """Load a new `Module`, which must be right and be compiled so many times."""
    module = Module()
    assert load(module, "cpu", 1) == CONTENT
    assert module.compiled == compiled


FILES = ["wp_m/wp_m.cpu.o", "wp_m/wp_m.meta", "wp_m.sha256"]


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize("name", FILES)
def test_what_is_damaged_is_compiled_again_and_kept(cache, name, how):
    loaded(compiled=0)
    damage(cache / name, how)
    loaded(compiled=1)
    loaded(compiled=0)


@pytest.mark.parametrize("name", FILES)
def test_what_is_missing_is_compiled_again_and_kept(cache, name):
    (cache / name).unlink()
    loaded(compiled=1)
    loaded(compiled=0)


def test_what_another_machine_has_added_without_its_checksum_is_not_trusted(cache):
    (cache / "wp_m" / "wp_m.sm90.cubin").write_bytes(b"half")
    loaded(compiled=1)
    assert not (cache / "wp_m" / "wp_m.sm90.cubin").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
def test_what_several_compile_at_once_is_compiled_once(cache):
    (cache / "wp_m.sha256").unlink()
    modules = [Module() for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda module: load(module, "cpu", 1), modules):
            assert found == CONTENT
    assert sum(module.compiled for module in modules) == 1


def refusing(monkeypatch):
    """Let nothing be written or removed, which chmod does not do for root."""
    opened = Path.open

    def open_to_read(self, mode="r", *given, **options):
        if mode.startswith("a"):
            raise PermissionError(13, "Permission denied")
        return opened(self, mode, *given, **options)

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", open_to_read)
    monkeypatch.setattr(warp_cache, "rmtree", refuse)


def test_a_cache_that_can_only_be_read_is_used(cache, monkeypatch):
    refusing(monkeypatch)
    loaded(compiled=0)


@pytest.mark.parametrize("name", FILES)
def test_what_cannot_be_repaired_is_compiled_elsewhere(cache, monkeypatch, name):
    refusing(monkeypatch)
    damage(cache / name, "filled with NULs")
    damaged = (cache / name).read_bytes()
    loaded(compiled=1)
    assert (cache / name).read_bytes() == damaged
    assert wp.config.kernel_cache_dir == str(cache)


def test_without_a_place_for_a_cache_every_process_compiles(tmp_path):
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "scratch").mkdir()
    places = {"WARP_CACHE_PATH": str(tmp_path / "file"), "TMPDIR": str(tmp_path / "scratch")}
    assert run(ONE_OPERATION, "warp", **places)
    assert list((tmp_path / "scratch").iterdir()) == []
