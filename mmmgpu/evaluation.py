"""Judging a model on clips it has not seen: pictures by reconstruction, movement by synthesis.

All intervals are 95 % over clips. Landmarks serve measuring only, where a folder of them is given.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.corpora import Clip, open_corpus
from mmmgpu.errors import InputError
from mmmgpu.landmarks import (
    LIPS,
    carried,
    lip_opening,
    mouth_hull,
    moved_landmarks,
    read_landmarks,
)
from mmmgpu.models import Model, project_on_simplex, trajectories
from mmmgpu.parallel import one_thread_each
from mmmgpu.pictures import psnr, ssim
from mmmgpu.reconstruction import Analysed, analyse_clip
from mmmgpu.statistics import (
    Interval,
    correlation,
    interval,
    paired_interval,
    rms_error,
    speech_frames,
    variance_ratio,
)
from mmmgpu.videos import read_frames

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

KINDS = ("pooled", "trained")


@dataclass(frozen=True)
class _Spoken:
    """One clip analysed and synthesised from its phones; streams by name.

    real: alpha, beta (T, d). made: the same by (kind, stream); beta before the simplex.
    """

    clip: Clip
    analysed: Analysed
    speech: Mask
    real: dict[str, Floats]
    made: dict[tuple[str, str], Floats]


def evaluate(
    model: Model,
    clips: Sequence[str | os.PathLike[str]],
    alignments: str | os.PathLike[str],
    *,
    sync: float = 0.0,
    landmarks: str | os.PathLike[str] | None = None,
    backend: str = "warp",
) -> dict[str, Any]:
    """Synthesis from the phones of `clips` against what was really said there.

    Args:
        model: A trained model; the clips should not be among those it was trained on.
        clips: Video files of the same person.
        alignments: Folder of alignments, or one file.
        sync: [s] as in training.
        landmarks: Folder of landmark files (see `mmmgpu.landmarks`), for distances in pixels.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        JSON values: for alpha and beta the RMS error with pooled and trained phoneme models, over
        all and over speech frames, with the paired gain; correlations and variance ratios
        synthetic/real; with landmarks also the lips' distances, opening and jitter.

    Raises:
        InputError: A clip, an alignment or the landmarks cannot be used.
    """
    corpus = open_corpus([Path(c) for c in clips], Path(alignments), sync=sync)
    points = None if landmarks is None else _lip_points(model, corpus, Path(landmarks))
    with one_thread_each():
        spoken = [_speak(model, clip, backend) for clip in corpus]
    result: dict[str, Any] = {"clips": [clip.path.name for clip in corpus]}
    seen = sorted(set(result["clips"]) & set(model.notes.get("clips", [])))
    if seen:
        result["also_in_training"] = seen
    for stream in ("alpha", "beta"):
        result[stream] = _stream(spoken, stream)
    if points is not None:
        result["lips"] = _lips(model, spoken, *points)
    return result


def _speak(model: Model, clip: Clip, backend: str) -> _Spoken:
    if clip.info.fps != model.fps:
        raise InputError(
            f"{clip.path}: has {float(clip.info.fps):g} frames/s, the model {float(model.fps):g}; "
            "convert the clip"
        )
    analysed = analyse_clip(model, clip.path, backend=backend)
    labels = clip.labels
    made = {}
    for kind in KINDS:
        alpha, beta = trajectories(model, labels, trained=kind == "trained")
        made[kind, "alpha"], made[kind, "beta"] = alpha, beta
    real = {"alpha": analysed.alpha, "beta": analysed.beta}
    return _Spoken(clip, analysed, speech_frames(labels), real, made)


def _stream(spoken: Sequence[_Spoken], stream: str) -> dict[str, Any]:
    """Errors of one stream over all and over speech frames."""
    result: dict[str, Any] = {}
    for part in ("all", "speech"):
        rms = {kind: [_rms(s, kind, stream, part) for s in spoken] for kind in KINDS}
        real = _joined([s.real[stream] for s in spoken], spoken, part)
        entry: dict[str, Any] = {
            "rms": {kind: _interval(interval(rms[kind])) for kind in KINDS},
            "rms_gain": _interval(paired_interval(rms["pooled"], rms["trained"])),
        }
        for kind in KINDS:
            y = _joined([s.made[kind, stream] for s in spoken], spoken, part)
            entry[f"correlation_{kind}"] = _typical(correlation(y, real), real)
            entry[f"variance_ratio_{kind}"] = float(y.var(axis=0).sum() / real.var(axis=0).sum())
        if stream == "beta":
            projected = [
                float(np.sqrt(np.mean((project_on_simplex(y) - z) ** 2)))
                for s in spoken
                for y, z in [_part(s, "trained", stream, part)]
                if len(z)
            ]
            entry["rms_trained_on_simplex"] = _interval(interval(projected))
        result[part] = entry
    return result


def _part(s: _Spoken, kind: str, stream: str, part: str) -> tuple[Floats, Floats]:
    chosen = s.speech if part == "speech" else np.ones_like(s.speech)
    return s.made[kind, stream][chosen], s.real[stream][chosen]


def _rms(s: _Spoken, kind: str, stream: str, part: str) -> float:
    y, z = _part(s, kind, stream, part)
    return float(np.sqrt(np.mean(rms_error(y, z) ** 2)))


def _joined(series: Sequence[Floats], spoken: Sequence[_Spoken], part: str) -> Floats:
    chosen = [z[s.speech] if part == "speech" else z for z, s in zip(series, spoken, strict=True)]
    return np.concatenate(chosen)


def _typical(values: Floats, real: Floats) -> float:
    """Mean over dimensions, each weighted by the variance of the real one."""
    weight = np.where(np.isfinite(values), real.var(axis=0), 0)
    return float((np.nan_to_num(values) * weight).sum() / max(weight.sum(), 1e-30))


def _interval(found: Interval) -> dict[str, Any]:
    half = None if np.isnan(found.half_width) else found.half_width
    return {"mean": found.mean, "half_width_95": half, "clips": found.n}


def _lip_points(model: Model, corpus: Sequence[Clip], folder: Path) -> tuple[Floats, list[Floats]]:
    """Lips of the reference frame, (n, 2) [px], and of every frame of every clip, (T, n, 2)."""
    name, t = model.sources[model.basis.reference]
    origin = read_landmarks(folder, Path(name))
    if t >= len(origin):
        raise InputError(
            f"{folder}: the landmarks of {name} end before frame {t}, the model's reference; "
            "give those of the clips that the model was trained on"
        )
    real = [read_landmarks(folder, clip.path, clip.info.frames)[:, LIPS] for clip in corpus]
    return origin[t, LIPS], real


def _lips(
    model: Model, spoken: Sequence[_Spoken], origin: Floats, points: Sequence[Floats]
) -> dict[str, Any]:
    """Distances [px of the frame], opening [px of the reference] and jitter of the lips."""
    series: dict[str, list[Floats]] = {k: [] for k in ("real", "analysed", *KINDS)}
    distance: dict[str, list[float]] = {k: [] for k in ("analysed", *KINDS)}
    for s, real in zip(spoken, points, strict=True):
        poses = s.analysed.track.poses
        series["real"].append(carried(np.asarray(np.linalg.inv(poses), np.float64), real))
        for kind, distances in distance.items():
            alpha = s.analysed.alpha if kind == "analysed" else s.made[kind, "alpha"]
            made = moved_landmarks(model.basis, alpha, origin)
            series[kind].append(made)
            miss = np.linalg.norm(carried(poses, made) - real, axis=-1)
            distances.append(float(miss[s.speech].mean()))
    result: dict[str, Any] = {
        "distance_px_speech": {k: _interval(interval(v)) for k, v in distance.items()},
        "distance_gain_px": _interval(paired_interval(distance["pooled"], distance["trained"])),
        "jitter_px_silence": {k: _jitter(v, spoken) for k, v in series.items()},
    }
    opening = {k: [lip_opening(p)[:, None] for p in v] for k, v in series.items()}
    for part in ("all", "speech"):
        joined = {k: _joined(v, spoken, part) for k, v in opening.items()}
        result[f"opening_{part}"] = {
            kind: {
                "variance_ratio": float(variance_ratio(joined[kind], joined["real"])[0]),
                "variance_ratio_to_analysed": float(
                    variance_ratio(joined[kind], joined["analysed"])[0]
                ),
                "correlation": float(correlation(joined[kind], joined["real"])[0]),
            }
            for kind in distance
        }
    result["opening_px_silence"] = {
        k: float(np.mean(np.concatenate([o[~s.speech] for o, s in zip(v, spoken, strict=True)])))
        for k, v in opening.items()
    }
    return result


def _jitter(series: Sequence[Floats], spoken: Sequence[_Spoken]) -> float:
    """RMS second difference [px] of lip points (T, n, 2) within silence."""
    steps = []
    for points, s in zip(series, spoken, strict=True):
        silent = ~s.speech
        middle = silent[:-2] & silent[1:-1] & silent[2:]
        steps.append(np.diff(points, 2, axis=0)[middle])
    joined = np.concatenate(steps)
    return float(np.sqrt(np.mean(joined**2))) if joined.size else 0.0


def measure_reconstruction(
    model: Model,
    clip: str | os.PathLike[str],
    reconstruction: str | os.PathLike[str],
    analysed: Analysed,
    *,
    labels: Sequence[str],
    landmarks: str | os.PathLike[str],
) -> dict[str, Any]:
    """A lossless reconstruction against its clip, inside the hull of the lips scaled by 1.5.

    Args:
        model: The model that made it.
        clip: The real clip.
        reconstruction: What `reconstruct` wrote with `lossless`.
        analysed: What `reconstruct` returned.
        labels: The phone of every frame.
        landmarks: Folder of landmark files.

    Returns:
        JSON values: PSNR [dB] (mean over frames, and of the mean error) and SSIM over speech and
        over silent frames, the least cover inside the hull, and how many pixels outside the cover
        differ from the clip.
    """
    clip = Path(clip)
    points = read_landmarks(Path(landmarks), clip, len(analysed.track))
    speech = speech_frames(labels)
    basis = model.basis
    psnrs, ssims, least, changed = [], [], 1.0, 0
    pairs = zip(read_frames(clip), read_frames(reconstruction), strict=True)
    for t, (real, made) in enumerate(pairs):
        hull = mouth_hull(points[t], real.shape)
        matrix = analysed.track.poses[t] @ basis.region.to_frame
        cover = cv2.warpPerspective(basis.cover, matrix, real.shape[1::-1])
        least = min(least, float(cover[hull].min()))
        changed += int((real != made).any(axis=-1)[cover == 0].sum())
        psnrs.append(psnr(real, made, hull))
        ssims.append(ssim(real, made, hull))
    result: dict[str, Any] = {"clip": clip.name, "frames": len(psnrs)}
    for part, chosen in (("speech", speech), ("silence", ~speech)):
        if chosen.any():
            values = np.array(psnrs)[chosen]
            result[part] = {
                "psnr_db": float(values.mean()),
                "psnr_of_mean_error_db": float(-10 * np.log10(np.mean(10 ** (-values / 10)))),
                "worst_frame_db": float(values.min()),
                "ssim": float(np.array(ssims)[chosen].mean()),
            }
    result["least_cover_in_hull"] = least
    result["pixels_changed_outside_cover"] = changed
    return result
