"""Models on disk: one safetensors file, checked before it is used. No pickle anywhere.

Tensors are flat and named after the fields of `Model`; how such files are written and read is in
`mmmgpu.tensor_files`.
"""

from __future__ import annotations

import os
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from mmmgpu.basis import Basis
from mmmgpu.dynamics import Dynamics, facts_of, model_of
from mmmgpu.errors import InputError
from mmmgpu.flat_records import tensors_of
from mmmgpu.models import Calm, Model
from mmmgpu.phonemes import PhonemeModels
from mmmgpu.regions import Region
from mmmgpu.registration import Head
from mmmgpu.tensor_files import FileKind, Tensors, check_tensors, read_tensors, write_tensors
from mmmgpu.tracked_clips import TrackedClip
from mmmgpu.tracks import Reference, Track
from mmmgpu.trajectory_training import Constants, History, TrainedStream

FORMAT = "mmmgpu-model"
VERSION = 1
STREAMS = ("alpha", "beta")
OF_TRACKS = ("poses", "registered", "correlation", "gain", "offset")
KIND = FileKind(FORMAT, VERSION, "model", "mmmgpu train", "train it again")


def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write `model` to `path`, whole or not at all."""
    write_tensors(path, KIND, _facts(model), _tensors(model))


def load(path: str | os.PathLike[str]) -> Model:
    """Read the model at `path`.

    Raises:
        InputError: No such file, not a model, truncated, of a newer version, or with tensors that
            are missing, misshapen or not finite.
    """
    return read_tensors(path, KIND, _checked)


def _checked(path: Path, tensors: Tensors, facts: dict[str, Any]) -> Model:
    _check_facts(path, facts)
    _check_tensors(path, tensors, facts)
    return _assemble(tensors, facts)


def _check_facts(path: Path, facts: dict[str, Any]) -> None:
    """What is no array is of the right kind and in its range."""
    m, region, fps = len(facts["sources"]), facts["region"], facts["fps"]
    good = {
        "reference": type(facts["reference"]) is int and 0 <= facts["reference"] < m and m >= 2,
        "region": [type(v) for v in region["box"]] == [int] * 4
        and min(region["box"][2:]) > 0
        and np.isfinite(region["mouth"]).tolist() == [True] * 3
        and region["mouth"][2] > 0,
        "fps": [type(v) for v in fps] == [int] * 2 and min(fps) > 0,
        "calm.suffix": re.fullmatch(r"(\.[^./\\\0]+)?", facts["calm"]["suffix"]) is not None,
        "calm.residual": bool(np.isfinite(facts["calm"]["residual"])),
        "tracked": all(
            {"clip": str, "sha256": str, "residual": float} == {n: type(v) for n, v in one.items()}
            and np.isfinite(one["residual"])
            for one in _tracked_facts(facts)
        ),
    }
    for name, is_good in good.items():
        if not is_good:
            raise InputError(f"{path}: the model misstates {name}; train it again")


def _check_tensors(path: Path, tensors: Tensors, facts: dict[str, Any]) -> None:
    """Every tensor has the shape and type that the others imply, and is finite."""
    calm = tensors["calm.data"].size
    m, (h, w) = len(facts["sources"]), facts["region"]["box"][:1:-1]
    points = len(tensors["reference.colours"])
    patch = tensors["head.patch"].shape
    wanted: dict[str, tuple[tuple[int, ...], str]] = {
        "images": ((m, h, w, 3), "f4"),
        "flows": ((m, h, w, 2), "f4"),
        **dict.fromkeys(("w_f", "w_t", "cover"), ((h, w), "f4")),
        "head.patch": (patch, "u1"),
        "head.mask": (patch, "f4"),
        "head.to_frame": ((3, 3), "f8"),
        "reference.colours": ((points, 3), "f4"),
        "reference.colour_points": ((points, 2), "f8"),
        "prototype_frames": ((m, facts["frame_size"][1], facts["frame_size"][0], 3), "u1"),
        "calm.data": ((calm,), "u1"),
    }
    tracks = ["calm", *(_tracked_name(i) for i, _ in enumerate(_tracked_facts(facts)))]
    for name in tracks:
        wanted |= _track_shapes(name, tensors)
    for name, d in (("alpha", m - 1), ("beta", m)):
        phones = len(facts[name]["labels"])
        wanted |= {
            f"{name}.{kind}.{part}": ((phones, d), "f8")
            for kind in ("pooled", "trained")
            for part in ("mean", "variance")
        }
        wanted[f"{name}.count"] = ((phones,), "i8")
        wanted[f"{name}.smoothness"] = ((d,), "f8")
        wanted[f"{name}.training"] = ((len(tensors[f"{name}.training"]), d), "f8")
        wanted[f"{name}.validation"] = (tensors[f"{name}.validation"].shape, "f8")
        if facts[name]["full_covariance"]:
            wanted[f"{name}.covariance"] = ((phones, d, d), "f8")
        for other in facts["alternatives"]:
            wanted[f"{name}.{other}.mean"] = ((phones, d), "f8")
    check_tensors(path, KIND, tensors, wanted)
    for name in wanted:
        tensor = tensors[name]
        if name.endswith(".covariance") and not (np.linalg.eigvalsh(tensor) > 0).all():
            raise InputError(
                f"{path}: tensor {name} must be positive definite; train the model again"
            )
        if name.endswith(".variance") and not (tensor > 0).all():
            raise InputError(f"{path}: tensor {name} must be above zero; train the model again")
        if name.endswith((".poses", ".to_frame")) and not np.linalg.det(tensor).all():
            raise InputError(f"{path}: tensor {name} cannot be inverted; train the model again")
    for name in tracks:
        if not len(tensors[f"{name}.poses"]):
            raise InputError(f"{path}: tensor {name}.poses has no frames; train the model again")


def _tracked_facts(facts: dict[str, Any]) -> list[dict[str, Any]]:
    """What is said of the tracked clips; nothing in files from before there were any."""
    found: list[dict[str, Any]] = facts.get("tracked", [])
    return found


def _tracked_name(i: int) -> str:
    return f"tracked.{i}"


def _track_shapes(name: str, tensors: Tensors) -> dict[str, tuple[tuple[int, ...], str]]:
    frames = len(tensors[f"{name}.poses"])
    shapes = (((frames, 3, 3), "f8"), ((frames,), "b1"), ((frames,), "f8"), ((3,), "f8"))
    return {f"{name}.{n}": s for n, s in zip(OF_TRACKS, (*shapes, shapes[-1]), strict=True)}


def _track_tensors(name: str, track: Track) -> Tensors:
    return {f"{name}.{n}": getattr(track, n) for n in OF_TRACKS}


def _track(name: str, t: Tensors, residual: float) -> Track:
    return Track(**{n: t[f"{name}.{n}"] for n in OF_TRACKS}, residual=residual)


def _facts(model: Model) -> dict[str, Any]:
    return {
        "reference": model.basis.reference,
        "region": {"box": model.basis.region.box, "mouth": model.basis.region.mouth},
        "frame_size": model.frame_size,
        "fps": [model.fps.numerator, model.fps.denominator],
        "sources": [list(source) for source in model.sources],
        "calm": {"suffix": model.calm.suffix, "residual": model.calm.track.residual},
        "alpha": _stream_facts(model.alpha),
        "beta": _stream_facts(model.beta),
        "alternatives": sorted(model.alternatives),
        "dynamics": {
            name: [facts_of(one) for one in pair] for name, pair in model.dynamics.items()
        },
        "tracked": [
            {"clip": name, "sha256": clip.sha256, "residual": clip.track.residual}
            for name, clip in model.tracked.items()
        ],
        "notes": model.notes,
    }


def _stream_facts(stream: TrainedStream) -> dict[str, Any]:
    return {
        "labels": list(stream.trained.labels),
        "constants": vars(stream.constants),
        "full_covariance": stream.trained.covariance is not None,
    }


def _tensors(model: Model) -> Tensors:
    basis, head, calm = model.basis, model.reference.head, model.calm
    tensors: Tensors = {
        "images": basis.images,
        "flows": basis.flows,
        "w_f": basis.w_f,
        "w_t": basis.w_t,
        "cover": basis.cover,
        "head.patch": head.patch,
        "head.mask": head.mask,
        "head.to_frame": head.to_frame,
        "reference.colours": model.reference.colours,
        "reference.colour_points": model.reference.colour_points,
        "prototype_frames": model.prototype_frames,
        "calm.data": calm.data,
        **_track_tensors("calm", calm.track),
    }
    for i, clip in enumerate(model.tracked.values()):
        tensors |= _track_tensors(_tracked_name(i), clip.track)
    for name, stream in (("alpha", model.alpha), ("beta", model.beta)):
        for kind, models in (("pooled", stream.pooled), ("trained", stream.trained)):
            tensors[f"{name}.{kind}.mean"] = models.mean
            tensors[f"{name}.{kind}.variance"] = models.variance
        tensors[f"{name}.count"] = stream.trained.count
        tensors[f"{name}.smoothness"] = stream.smoothness
        tensors[f"{name}.training"] = stream.history.training
        tensors[f"{name}.validation"] = stream.validation
        if stream.trained.covariance is not None:
            tensors[f"{name}.covariance"] = stream.trained.covariance
    for other, (alpha, beta) in model.alternatives.items():
        tensors[f"alpha.{other}.mean"], tensors[f"beta.{other}.mean"] = alpha, beta
    for movement, pair in model.dynamics.items():
        for which, one in zip(STREAMS, pair, strict=True):
            for part, tensor in tensors_of(one).items():
                tensors[f"dynamics.{movement}.{which}.{part}"] = tensor
    return tensors


def _assemble(t: Tensors, facts: dict[str, Any]) -> Model:
    x, y, w, h = facts["region"]["box"]
    mouth_x, mouth_y, mouth_width = facts["region"]["mouth"]
    region = Region((x, y, w, h), (mouth_x, mouth_y, mouth_width))
    basis = Basis(
        t["images"], t["flows"], facts["reference"], region, t["w_f"], t["w_t"], t["cover"]
    )
    head = Head(t["head.patch"], t["head.mask"], t["head.to_frame"])
    calm, tracked = facts["calm"], _tracked_facts(facts)
    return Model(
        basis=basis,
        reference=Reference(head, t["reference.colours"], t["reference.colour_points"], region),
        alpha=_stream("alpha", t, facts),
        beta=_stream("beta", t, facts),
        fps=Fraction(*facts["fps"]),
        prototype_frames=t["prototype_frames"],
        sources=tuple((str(clip), int(frame)) for clip, frame in facts["sources"]),
        calm=Calm(t["calm.data"], calm["suffix"], _track("calm", t, calm["residual"])),
        notes=facts["notes"],
        alternatives={
            other: (t[f"alpha.{other}.mean"], t[f"beta.{other}.mean"])
            for other in facts["alternatives"]
        },
        dynamics=_dynamics(t, facts),
        tracked={
            one["clip"]: TrackedClip(one["sha256"], _track(_tracked_name(i), t, one["residual"]))
            for i, one in enumerate(tracked)
        },
    )


def _dynamics(t: Tensors, facts: dict[str, Any]) -> dict[str, tuple[Dynamics, Dynamics]]:
    """The other models of movement; none in files from before there were any."""
    found = {}
    for name, pair in facts.get("dynamics", {}).items():
        models = []
        for stream, said in zip(STREAMS, pair, strict=True):
            start = f"dynamics.{name}.{stream}."
            own = {n.removeprefix(start): x for n, x in t.items() if n.startswith(start)}
            try:
                one = model_of(said, own)
            except InputError as e:
                raise ValueError(f"{start[:-1]}: {e}") from e  # `load` knows of which file
            d = len(next(iter(one.generate(one.labels[:1]))))
            if d != t[f"{stream}.smoothness"].size or said["model"] != name:
                raise ValueError(start[:-1])
            models.append(one)
        found[name] = (models[0], models[1])
    return found


def _stream(name: str, t: Tensors, facts: dict[str, Any]) -> TrainedStream:
    labels, count = tuple(facts[name]["labels"]), t[f"{name}.count"]
    pooled, trained = (
        PhonemeModels(
            labels,
            t[f"{name}.{kind}.mean"],
            t[f"{name}.{kind}.variance"],
            count,
            t.get(f"{name}.covariance"),
        )
        for kind in ("pooled", "trained")
    )
    return TrainedStream(
        pooled,
        trained,
        t[f"{name}.smoothness"],
        Constants(**facts[name]["constants"]),
        History(t[f"{name}.training"]),
        t[f"{name}.validation"],
    )
