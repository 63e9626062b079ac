"""PoCL from the wheel on CPUs that are newer than it.

PoCL asks LLVM for the name of the CPU and compiles for that name. The wheel's LLVM 14 (2022) calls
an AMD CPU of a later family (Zen 5) "generic", which its own Clang refuses: "unknown target CPU
'generic'", so that nothing can be built (pocl/pocl issue 1049, open). No option overrides it. The
one function that answers is exported, though, and can be made to return the name of an older CPU.
Where PoCL knows the CPU, or is not the wheel's, nothing is touched.
"""

import ctypes
import importlib.util
import mmap
import platform
import struct
from pathlib import Path
from typing import Any

READ, WRITE, EXECUTE = mmap.PROT_READ, mmap.PROT_WRITE, mmap.PROT_EXEC


def name_unknown_cpu() -> None:
    """Let PoCL compile for a CPU it knows. To be called before the driver is first used."""
    spec = importlib.util.find_spec("pyopencl")
    if spec is None or not spec.origin or platform.machine() != "x86_64":
        return
    for path in Path(spec.origin).parent.glob(".libs/libpocl*.so*"):
        asked = ctypes.CDLL(str(path)).pocl_get_llvm_cpu_name
        asked.restype = ctypes.c_char_p
        if asked() == b"generic":
            _return_copies_of(asked, _nearest_known_cpu())


def _nearest_known_cpu() -> bytes:
    """A CPU that LLVM 14 knows and whose instructions this one has."""
    flags = Path("/proc/cpuinfo").read_text().split()
    return b"haswell" if {"avx2", "fma", "bmi2", "movbe", "abm"} <= set(flags) else b"x86-64"


def _return_copies_of(function: Any, text: bytes) -> None:
    """Overwrite an x86-64 function by strdup(text): mov rdi, text; mov rax, strdup; jmp rax."""
    libc = ctypes.CDLL(None)
    address, strdup = (ctypes.cast(f, ctypes.c_void_p).value or 0 for f in (function, libc.strdup))
    libc.strdup.restype = ctypes.c_void_p
    forever = libc.strdup(text)
    code = b"\x48\xbf" + struct.pack("<Q", forever)
    code += b"\x48\xb8" + struct.pack("<Q", strdup) + b"\xff\xe0"
    start = address - address % mmap.PAGESIZE
    span = ctypes.c_void_p(start), ctypes.c_size_t(address + len(code) - start)
    if libc.mprotect(*span, READ | WRITE | EXECUTE) == 0:  # refused: PoCL will say what it lacks
        ctypes.memmove(address, code, len(code))
        libc.mprotect(*span, READ | EXECUTE)
