"""The operations one by one, on device arrays, beside the same work by other libraries.

A plain copy that reads and writes as many bytes takes turns with them: one pass over the bytes.
"""

from functools import partial

import numpy as np

from mmmgpu.backends import default_threads, get_backend
from mmmgpu.bench.cases import CASES
from mmmgpu.bench.machine import copy_of
from mmmgpu.bench.peers import find_peers
from mmmgpu.bench.timing import COPY, Contender, Work

EQUAL = 1e-5  # of the scale of an output: the contract of docs/kernels.md


def kernel_works(backends, peers):
    """Makers of the `Work` of every case, by name; `peers`: names of libraries."""
    return {f.__name__: partial(kernel_work, f, backends, peers) for f in CASES}


def kernel_work(make, backends, peers):
    """One case on every backend and by every peer that has its operation."""
    case = make(np.random.default_rng(0))
    contenders = {name: on_backend(case, name) for name in backends}
    for library, peer in find_peers(case.operation, peers).items():
        run = partial(peer, *case.arrays, *case.scalars)
        contenders[library] = Contender(lambda run=run: run)
    first, second, *others = case.arrays
    some = second[:: case.every]
    k = get_backend("numpy")
    return Work(
        case.name,
        lambda: getattr(k, case.operation)(first, some, *others, *case.scalars),
        contenders,
        beside={COPY: copy_of(case.bytes, default_threads())},
        bytes=case.bytes,
        operations=case.operations,
        part=len(some) / len(second),
        checked=np.s_[..., :: case.every],
    )


def on_backend(case, name):
    """The case on one of our backends; the arrays stay on the device, which is waited for."""

    def load():
        k = get_backend(name)
        arrays = [k.to_device(a) for a in case.arrays]

        def run():
            answer = getattr(k, case.operation)(*arrays, *case.scalars)
            k.wait()
            return answer

        return run

    def fetch(answer):
        k = get_backend(name)
        return tuple(map(k.to_host, answer)) if isinstance(answer, tuple) else k.to_host(answer)

    return Contender(load, fetch, EQUAL)
