"""Judging a model on clips it has not seen: pictures by reconstruction, movement by synthesis.

All intervals are 95 % over clips. Landmarks serve measuring only, where a folder of them is given.
"""

import os
from collections.abc import Mapping, Sequence
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
from mmmgpu.progress import progress
from mmmgpu.reconstruction import Analysed, analyse_clip
from mmmgpu.speaking import focused
from mmmgpu.statistics import (
    Interval,
    correlation,
    interval,
    paired_interval,
    rms_error,
    speech_frames,
    variance_ratio,
)
from mmmgpu.synthesis import Synthesizer, prepare_synthesis, synthesize_batch
from mmmgpu.tracks import crops
from mmmgpu.videos import read_frames

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


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
    pictures: bool = False,
    backend: str = "warp",
) -> dict[str, Any]:
    """Synthesis from the phones of `clips` against what was really said there.

    Args:
        model: A trained model; the clips should not be among those it was trained on.
        clips: Video files of the same person.
        alignments: Folder of alignments, or one file.
        sync: [s] as in training.
        landmarks: Folder of landmark files (see `mmmgpu.landmarks`), for distances in pixels.
        pictures: Whether to render every frame too, and compare it with the real one.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        JSON values: for alpha and beta the RMS error with pooled and trained phoneme models, over
        all and over speech frames, with the paired gain; correlations and variance ratios
        synthetic/real; with landmarks also the lips' distances, opening and jitter; with pictures
        the PSNR [dB] of speech frames under the mouth mask. A model with alternatives is compared
        with them too.

    Raises:
        InputError: A clip, an alignment or the landmarks cannot be used.
    """
    corpus = open_corpus([Path(c) for c in clips], Path(alignments), sync=sync)
    points = None if landmarks is None else _lip_points(model, corpus, Path(landmarks))
    with one_thread_each():
        spoken = [_speak(model, clip, backend) for clip in corpus]
    result: dict[str, Any] = {"clips": [clip.name for clip in corpus]}
    seen = sorted(set(result["clips"]) & set(model.notes.get("clips", [])))
    if seen:
        result["also_in_training"] = seen
    for stream in ("alpha", "beta"):
        result[stream] = _stream(spoken, stream)
    if points is not None:
        result["lips"] = _lips(model, spoken, *points)
    if pictures:
        with one_thread_each():
            result["mouth_psnr_db_speech"] = _pictures(model, spoken, backend)
    return result


def kinds_of(model: Model) -> list[str]:
    """The phoneme models that are compared: before and after training, and the alternatives."""
    return ["pooled", "trained", *model.alternatives]


def _speak(model: Model, clip: Clip, backend: str) -> _Spoken:
    if clip.info.fps != model.fps:
        raise InputError(
            f"{clip.path}: has {float(clip.info.fps):g} frames/s, the model {float(model.fps):g}; "
            "convert the clip"
        )
    analysed = analyse_clip(model, clip.path, backend=backend)
    labels = clip.labels
    made = {}
    for kind in kinds_of(model):
        alpha, beta = trajectories(model, labels, kind=kind)
        made[kind, "alpha"], made[kind, "beta"] = alpha, beta
    real = {"alpha": analysed.alpha, "beta": analysed.beta}
    return _Spoken(clip, analysed, speech_frames(labels), real, made)


def _stream(spoken: Sequence[_Spoken], stream: str) -> dict[str, Any]:
    """Errors of one stream over all and over speech frames."""
    result: dict[str, Any] = {}
    kinds = [kind for kind, name in spoken[0].made if name == stream]
    for part in ("all", "speech"):
        rms = {kind: [_rms(s, kind, stream, part) for s in spoken] for kind in kinds}
        real = _joined([s.real[stream] for s in spoken], spoken, part)
        entry: dict[str, Any] = {
            "rms": {kind: _interval(interval(rms[kind])) for kind in kinds},
            "rms_gain": _interval(paired_interval(rms["pooled"], rms["trained"])),
            **_gains_over("rms", rms),
        }
        for kind in kinds:
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


def _gains_over(name: str, values: Mapping[str, list[float]]) -> dict[str, Any]:
    """What the trained models gain over each alternative: paired differences, positive is good."""
    others = [kind for kind in values if kind not in ("analysed", "pooled", "trained")]
    gains = {k: _interval(paired_interval(values[k], values["trained"])) for k in others}
    return {f"{name}_gain_over": gains} if gains else {}


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
    real = [read_landmarks(folder, clip.path, clip.length)[:, LIPS] for clip in corpus]
    return origin[t, LIPS], real


def _lips(
    model: Model, spoken: Sequence[_Spoken], origin: Floats, points: Sequence[Floats]
) -> dict[str, Any]:
    """Distances [px of the frame], opening [px of the reference] and jitter of the lips."""
    kinds = kinds_of(model)
    series: dict[str, list[Floats]] = {k: [] for k in ("real", "analysed", *kinds)}
    distance: dict[str, list[float]] = {k: [] for k in ("analysed", *kinds)}
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
        **_gains_over("distance_px", distance),
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


def _pictures(model: Model, spoken: Sequence[_Spoken], backend: str) -> dict[str, Any]:
    """PSNR [dB] of rendered speech frames under w_t, from the mean squared error of each clip."""
    found: dict[str, list[float]] = {kind: [] for kind in kinds_of(model)}
    synthesizer = prepare_synthesis(model.basis, shown=model.basis.w_t > 0, backend=backend)
    for s in spoken:
        if not s.speech.any():
            continue
        for kind, error in _picture_errors(model, s, synthesizer).items():
            found[kind].append(float(-10 * np.log10(max(error, 1e-10))))
    gain = paired_interval(found["trained"], found["pooled"])
    return {
        **{kind: _interval(interval(values)) for kind, values in found.items()},
        "gain": _interval(gain),
        "gain_over": {
            kind: _interval(paired_interval(found["trained"], found[kind]))
            for kind in model.alternatives
        },
    }


def _picture_errors(model: Model, s: _Spoken, synthesizer: Synthesizer) -> dict[str, float]:
    """Mean squared error under w_t of the speech frames of one clip, for each kind."""
    basis, track = model.basis, s.analysed.track
    weight = basis.w_t[..., None] / (3 * basis.w_t.sum())
    kinds = kinds_of(model)
    alpha = np.stack([s.made[kind, "alpha"] for kind in kinds], axis=1)
    beta = np.stack([focused(project_on_simplex(s.made[kind, "beta"])) for kind in kinds], axis=1)
    errors = []
    label, total = f"render {s.clip.name}", int(s.speech.sum())
    seen = zip(s.speech, alpha, beta, crops(s.clip.path, track, basis.region), strict=False)
    frames = ((a, b, real) for spoken, a, b, real in seen if spoken)
    for a, b, real in progress(frames, label, total=total):
        made = synthesize_batch(synthesizer, a, b)
        errors.append((weight * (made - real) ** 2).sum(axis=(1, 2, 3)))
    return dict(zip(kinds, np.mean(errors, axis=0).tolist(), strict=True))


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
