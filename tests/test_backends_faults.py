"""Drivers and devices that fail: one clear line, or less at a time."""

import gc
import re
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
import warp as wp
from numpy.testing import assert_array_equal
from test_operations import CALLS, call, first

from mmmgpu.backends import get_backend, nvwarp, opencl
from mmmgpu.backends.planes import picture
from mmmgpu.errors import DeviceError, DeviceMemoryError, InputError
from mmmgpu.synthesis import prepare_synthesis, synthesize_batch


def driver_error(name, kind=cl.RuntimeError):
    """The error that pyopencl raises for a status code."""
    return kind(cl._cl._ErrorRecord("clRoutine failed", getattr(cl.status_code, name), "clRoutine"))


def raising(error):
    def fail(*_, **__):
        raise error

    return fail


def test_without_a_driver_opencl_says_what_to_install(monkeypatch):
    error = driver_error("PLATFORM_NOT_FOUND_KHR", cl.LogicError)
    monkeypatch.setattr(cl, "get_platforms", raising(error))
    with pytest.raises(InputError, match=r"no OpenCL driver; pip install 'pyopencl\[pocl\]'"):
        opencl.open_backend("", 1)
    with pytest.raises(InputError, match="no OpenCL driver"):
        opencl.list_devices()


def test_a_platform_without_devices_does_not_hide_the_others(monkeypatch):
    class Empty:
        get_devices = staticmethod(raising(driver_error("DEVICE_NOT_FOUND")))

    real = cl.get_platforms()
    monkeypatch.setattr(cl, "get_platforms", lambda: [Empty(), *real])
    assert opencl.open_backend("", 1).name == "opencl:1:0"
    with pytest.raises(InputError, match=r"no device 'opencl:0:0'; present: opencl:1:0 \("):
        opencl.open_backend("0:0", 1)


def test_a_kernel_that_cannot_be_built_is_one_line_with_the_driver_s_reason(monkeypatch, tmp_path):
    (tmp_path / "broken.cl").write_text("__kernel void f() { nonsense; }\n")
    monkeypatch.setattr(opencl, "files", lambda _: tmp_path)
    context = get_backend("opencl").queue.context
    with pytest.raises(DeviceError, match=r"cannot build broken\.cl \(.*'nonsense'") as raised:
        opencl._program(context, "broken")
    assert "\n" not in str(raised.value)


FAILED = [
    Exception("CPU kernel build failed with error code 1"),
    Exception("Failed to load CUDA module 'blend'\n(device='cuda:0')"),
    OSError("No space left on device"),
]


@pytest.mark.parametrize("error", FAILED)
def test_a_kernel_that_warp_cannot_build_or_load_is_one_line(monkeypatch, error):
    nvwarp._kernel.cache_clear()
    monkeypatch.setattr(nvwarp, "load", raising(error))
    said = re.escape(" ".join(str(error).split()))
    with pytest.raises(DeviceError, match=rf"^warp:cpu: cannot build blend\.py \({said}\); choose"):
        call("blend", "warp")


def test_a_kernel_of_ours_that_is_wrong_is_a_defect(monkeypatch):
    nvwarp._kernel.cache_clear()
    monkeypatch.setattr(nvwarp, "load", raising(wp.WarpCodegenError("no such function")))
    with pytest.raises(wp.WarpCodegenError, match="no such function"):
        call("blend", "warp")


@pytest.mark.parametrize("code", sorted(opencl.NO_MEMORY | opencl.GONE))
def test_a_failure_of_the_driver_names_the_device(monkeypatch, code):
    k = get_backend("opencl:0:0")
    array = k.empty(1, 2, 2, 1)
    name = cl.status_code.to_string(code)
    monkeypatch.setattr(cl, "enqueue_map_buffer", raising(driver_error(name)))
    kind = DeviceMemoryError if code in opencl.NO_MEMORY else DeviceError
    with pytest.raises(kind, match=rf"^opencl:0:0: .*{name}.* another (device )?with --backend$"):
        k.to_host(array)


def test_what_may_be_either_is_called_so_and_tried_with_less(monkeypatch):
    k = get_backend("opencl:0:0")
    array = k.empty(1, 2, 2, 1)
    monkeypatch.setattr(cl, "enqueue_map_buffer", raising(driver_error("OUT_OF_RESOURCES")))
    said = r"^opencl:0:0: not enough memory, or the device failed \(.*OUT_OF_RESOURCES"
    with pytest.raises(DeviceMemoryError, match=said):
        k.to_host(array)


@pytest.mark.parametrize("function", ["Context", "CommandQueue"])
def test_a_device_that_cannot_be_opened_is_one_line(monkeypatch, function):
    monkeypatch.setattr(cl, function, raising(driver_error("DEVICE_NOT_AVAILABLE")))
    with pytest.raises(DeviceError, match=r"^opencl:0:0: the device failed \(.*NOT_AVAILABLE"):
        opencl.open_backend("0:0", 1)


def test_a_defect_of_ours_is_not_blamed_on_the_driver(monkeypatch):
    k = get_backend("opencl")
    array = k.empty(1, 2, 2, 1)
    monkeypatch.setattr(cl, "enqueue_map_buffer", raising(driver_error("INVALID_KERNEL_ARGS")))
    with pytest.raises(cl.RuntimeError, match="INVALID_KERNEL_ARGS"):
        k.to_host(array)
    monkeypatch.setattr(wp, "launch", raising(RuntimeError("an argument is missing")))
    with pytest.raises(RuntimeError, match="argument is missing") as raised:
        call("blend", "warp")
    assert not isinstance(raised.value, InputError)


@pytest.mark.parametrize("pooled", [True, False])
def test_a_cuda_device_keeps_memory_for_the_next_frame(monkeypatch, pooled):
    """Its pool, where it has one, gives back what is free whenever the host waits for it."""
    device = SimpleNamespace(is_cpu=False, alias="cuda:0", is_mempool_enabled=pooled)
    held = []
    monkeypatch.setattr(wp, "get_device", lambda _: device)
    monkeypatch.setattr(wp, "set_mempool_release_threshold", lambda *given: held.append(given))
    assert nvwarp.open_backend("cuda:0", 2).device == "cuda:0"
    assert held == [(device, 0.5)] * pooled


@pytest.mark.parametrize("function", ["launch", "synchronize_device"])
def test_a_cuda_device_that_disappears_is_one_line(monkeypatch, function):
    gone = RuntimeError("CUDA error 719 detected on device cpu: unspecified\nlaunch failure")
    monkeypatch.setattr(wp, function, raising(gone))
    with pytest.raises(DeviceError, match=r"^warp:cpu: the device failed \(CUDA error") as raised:
        call("blend", "warp")
    assert "\n" not in str(raised.value)
    assert isinstance(raised.value, InputError)  # so that commands end with this line


def test_an_array_that_is_too_large_for_the_device_is_said(backend, family):
    with pytest.raises(DeviceMemoryError, match=rf"^{family}:\S+: not enough memory \("):
        get_backend(backend).empty(1 << 30, 1 << 14)


def limit_memory(monkeypatch, family, most):
    """Let that device hold arrays of at most `most` items each; returns the sizes asked for."""
    runtime = {"opencl": opencl.OpenCL, "warp": nvwarp.Warp}[family]
    asked, real = [], (runtime.empty, runtime.to_device)

    def check(size):
        asked.append(int(size))
        if size > most:
            raise DeviceMemoryError("not enough memory")

    def empty(self, *shape, **options):
        check(np.prod(shape))
        return real[0](self, *shape, **options)

    def to_device(self, array):
        check(array.size)
        return real[1](self, array)

    monkeypatch.setattr(runtime, "empty", empty)
    monkeypatch.setattr(runtime, "to_device", to_device)
    return asked


RNG = np.random.default_rng(0)
MANY = {  # what is long along the axis that can be cut
    "forward_warp": {
        "field": RNG.random((7, 9, 8, 3), np.float32),
        "flow": RNG.random((9, 8, 2), np.float32),
    },
    "fill_holes": {
        "field": RNG.random((7, 9, 8, 3), np.float32),
        "weight": RNG.random((7, 9, 8), np.float32),
        "threshold": 0.2,
    },
    "blend": {"weights": RNG.random((40, 2), np.float32)},
    "normal_equations": {  # sums of whole numbers are exact in any order
        "images": RNG.integers(0, 9, (3, 40, 30, 3)),
        "wanted": RNG.integers(0, 9, (40, 30, 3)),
    },
    "sample": {"field": RNG.random((7, 9, 8, 3), np.float32), "points": np.ones((7, 4, 2))},
    "distance_scan": {
        "queries": RNG.random((2, 20, 2), np.float32),
        "corpus": RNG.random((17, 20, 2), np.float32),
        "weights": np.ones(20, np.float32),
    },
    "evaluate_rbf": {"points": RNG.random((300, 2), np.float32)},
    "piecewise_warp": {
        "field": RNG.random((7, 9, 8, 3), np.float32),
        "vertices": np.ones((7, 7, 2)),
    },
}


@pytest.mark.parametrize("name", CALLS)
def test_what_does_not_fit_is_done_in_parts(monkeypatch, backend, family, name):
    asked = limit_memory(monkeypatch, family, np.inf)
    whole = call(name, backend, **MANY[name])
    most = max(asked) - 1
    asked = limit_memory(monkeypatch, family, most)
    parts = call(name, backend, **MANY[name])
    assert max(asked) > most  # it was tried
    assert_array_equal(first(parts), first(whole))


def test_frames_that_do_not_fit_are_made_by_several_launches(monkeypatch, backend, family, basis):
    """As many as fit, however much was kept for more of them."""
    given = np.zeros((9, 4)), RNG.dirichlet(np.ones(5), 9)
    asked = limit_memory(monkeypatch, family, np.inf)
    synthesizer = prepare_synthesis(basis, backend=backend)
    asked.clear()
    whole = synthesize_batch(synthesizer, *given)
    most = max(asked) // 2
    asked = limit_memory(monkeypatch, family, most)
    parts = synthesize_batch(synthesizer, *given)
    assert max(asked) > most  # it was tried
    assert_array_equal(parts, whole)
    limit_memory(monkeypatch, family, 4)
    with pytest.raises(DeviceMemoryError, match="not enough memory"):
        synthesize_batch(synthesizer, *given)


def refuse_memory(monkeypatch, family, is_short):
    """Let the driver have no memory as long as `is_short()`."""
    home, name, error = {
        "opencl": (cl, "Buffer", driver_error("MEM_OBJECT_ALLOCATION_FAILURE")),
        "warp": (wp, "empty", RuntimeError("Failed to allocate 9 bytes on device 'cpu'")),
    }[family]
    allocate = getattr(home, name)

    def allocated(*given, **options):
        if is_short():
            raise error
        return allocate(*given, **options)

    monkeypatch.setattr(home, name, allocated)


@pytest.fixture
def synthesizer(backend, basis):
    """With a backend of its own, whose scratch is that of this test alone."""
    made = prepare_synthesis(basis, backend=backend)
    return replace(made, kernels=replace(made.kernels))


def some_frames(synthesizer):
    return synthesize_batch(synthesizer, np.zeros((9, 4)), np.full((9, 5), 0.2))


def kept_by_this_thread(k):
    """Whether it is there, for how long: the scratch itself, not where it was kept."""
    first = weakref.ref(k.scratch.of_this_thread().arrays["mixtures"][2][0])
    assert first() is not None
    return lambda: first() is not None


def test_scratch_is_given_up_where_memory_is_short(monkeypatch, family, synthesizer):
    """Before anything is said to be too large, be it of a thread that does nothing at present."""
    k = synthesizer.kernels
    with ThreadPoolExecutor(1) as other:
        other.submit(some_frames, synthesizer).result()
        some_frames(synthesizer)
        kept = kept_by_this_thread(k), other.submit(kept_by_this_thread, k).result()
        refuse_memory(monkeypatch, family, lambda: any(is_there() for is_there in kept))
        assert k.empty(3, 4).shape == (3, 4)


def test_scratch_is_given_up_for_the_pictures_it_is_needed_for(monkeypatch, family, synthesizer):
    whole = some_frames(synthesizer)
    s, k = synthesizer, synthesizer.kernels
    flows = k.blend(s.flows, k.to_device(np.zeros((9, 4), np.float32)))
    refuse_memory(monkeypatch, family, kept_by_this_thread(k))
    weights = np.full((9, 5), 0.2, np.float32)
    mixed = k.to_host(k.mix_prototypes(s.held, flows, weights, s.scale))
    width = whole.shape[2]
    assert_array_equal(np.minimum([picture(one, width) for one in mixed], 1), whole)


def test_scratch_goes_with_its_thread(synthesizer):
    with ThreadPoolExecutor(1) as other:
        other.submit(some_frames, synthesizer).result()
        is_there = other.submit(kept_by_this_thread, synthesizer.kernels).result()
        assert is_there()
    gc.collect()
    assert not is_there()


@pytest.mark.parametrize("name", CALLS)
def test_one_item_that_does_not_fit_is_an_error(monkeypatch, backend, family, name):
    limit_memory(monkeypatch, family, 1)
    with pytest.raises(DeviceMemoryError, match="not enough memory"):
        call(name, backend, **MANY[name])
