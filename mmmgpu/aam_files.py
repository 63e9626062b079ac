"""Active appearance models on disk: one safetensors file, checked before it is used.

Tensors are named after the fields of `Aam`; the pixels of the mesh are not kept, for they follow
from its vertices and triangles.
"""

import os
from pathlib import Path

import numpy as np

from mmmgpu.appearances import Aam
from mmmgpu.errors import InputError
from mmmgpu.meshes import Mesh, doubled_areas, rasterize
from mmmgpu.tensor_files import (
    Facts,
    FileKind,
    Tensors,
    check_tensors,
    read_tensors,
    write_tensors,
)

KIND = FileKind("mmmgpu-aam", 1, "appearance model", "mmmgpu aam", "make it again")
ARRAYS = (
    "steadiness",
    "shape_modes",
    "shape_variance",
    "texture_mean",
    "texture_modes",
    "texture_variance",
    "modes_of_shape",
    "modes_of_texture",
    "variance",
)


def save_aam(aam: Aam, path: str | os.PathLike[str]) -> None:
    """Write `aam` to `path`, whole or not at all."""
    facts = {
        "rows": None if aam.rows is None else list(aam.rows),
        "reduction": aam.reduction,
        "size": list(aam.mesh.shape),
        "weight": aam.weight,
        "share": aam.share,
        "notes": aam.notes,
    }
    tensors: Tensors = {name: getattr(aam, name) for name in ARRAYS}
    tensors |= {"vertices": aam.mesh.vertices, "triangles": aam.mesh.triangles}
    write_tensors(path, KIND, facts, tensors)


def load_aam(path: str | os.PathLike[str]) -> Aam:
    """Read the appearance model at `path`.

    Raises:
        InputError: No such file, not such a model, truncated, of a newer version, or with tensors
            that are missing, misshapen or not finite.
    """
    return read_tensors(path, KIND, _assemble)


def _assemble(path: Path, tensors: Tensors, facts: Facts) -> Aam:
    _check_facts(path, facts, len(tensors["vertices"]))
    mesh = _mesh(path, tensors, facts)
    number, pixels = len(mesh.vertices), len(mesh.pixels.index)
    k, m, n = (len(tensors[name]) for name in ("shape_variance", "texture_variance", "variance"))
    wanted = {
        "steadiness": ((number,), "f8"),
        "shape_modes": ((k, number, 2), "f8"),
        "shape_variance": ((k,), "f8"),
        "texture_mean": ((pixels, 3), "f4"),
        "texture_modes": ((m, pixels, 3), "f4"),
        "texture_variance": ((m,), "f8"),
        "modes_of_shape": ((n, number, 2), "f8"),
        "modes_of_texture": ((n, pixels, 3), "f4"),
        "variance": ((n,), "f8"),
    }
    check_tensors(path, KIND, tensors, wanted)
    for name in ("steadiness", "shape_variance", "texture_variance", "variance"):
        if not (len(tensors[name]) and (tensors[name] > 0).all()):
            raise InputError(f"{path}: tensor {name} must be above zero; {KIND.remedy}")
    rows = facts["rows"]
    return Aam(
        mesh=mesh,
        rows=None if rows is None else tuple(rows),
        reduction=facts["reduction"],
        weight=float(facts["weight"]),
        share=float(facts["share"]),
        notes=facts["notes"],
        **{name: tensors[name] for name in ARRAYS},
    )


def _check_facts(path: Path, facts: Facts, number: int) -> None:
    """What is no array is of the right kind and in its range."""
    rows, size = facts["rows"], facts["size"]
    good = {
        "rows": rows is None or ([type(r) for r in rows] == [int] * number and min(rows) >= 0),
        "reduction": type(facts["reduction"]) is int and facts["reduction"] >= 1,
        "size": [type(v) for v in size] == [int] * 2 and min(size) >= 2 and max(size) <= 10_000,
        "weight": bool(np.isfinite(facts["weight"])) and facts["weight"] > 0,
        "share": bool(np.isfinite(facts["share"])),
        "notes": isinstance(facts["notes"], dict),
    }
    for name, is_good in good.items():
        if not is_good:
            raise InputError(f"{path}: the appearance model misstates {name}; {KIND.remedy}")


def _mesh(path: Path, tensors: Tensors, facts: Facts) -> Mesh:
    vertices, triangles = tensors["vertices"], tensors["triangles"]
    shapes = {"vertices": ((len(vertices), 2), "f8"), "triangles": ((len(triangles), 3), "i4")}
    check_tensors(path, KIND, tensors, shapes)
    height, width = facts["size"]
    inside = (vertices >= 0).all() and (vertices <= (width - 1, height - 1)).all()
    known = len(triangles) and triangles.min() >= 0 and triangles.max() < len(vertices)
    if not (inside and known and (doubled_areas(vertices, triangles) > 0).all()):
        raise InputError(f"{path}: tensors vertices, triangles make no mesh; {KIND.remedy}")
    return Mesh(
        vertices, triangles, (height, width), rasterize(vertices, triangles, (height, width))
    )
