"""The commands of ``mmmgpu``, one a module; mmmgpu.cli puts them together.

A command checks what it was given, calls one function of the library and shows what came of it.
Slow libraries are imported inside the commands, so that each starts quickly.
"""
