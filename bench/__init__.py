"""Benchmarks: validate against the reference, then time, and print the losses too.

Installed as `mmmgpu.bench`, for ``mmmgpu bench``; import it by that name. Not here: what the models
are worth, which is measured by ``mmmgpu evaluate`` and ``mmmgpu compare``.
"""
