"""How well an appearance model shows, and finds, faces in clips that it was not made of.

Reconstruction: every frame's texture, at the pixels of the mean shape, against the one that the
features give, in the frame's own light. Fitting: from a start some pixels away, against the
landmarks, which have a jitter of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.aam import Fitter, Match, complete_clip, match, prepare_fitting
from mmmgpu.appearances import (
    Aam,
    aligned,
    enlarge_points,
    put_light_on,
    read_texture,
    reduce_picture,
    reduce_points,
    see,
    synthesize_shape,
    synthesize_texture,
)
from mmmgpu.backends import Backend, default_threads, get_backend
from mmmgpu.errors import InputError
from mmmgpu.labelled_clips import LabelledClip
from mmmgpu.parallel import Cancelled, map_ordered, one_thread_each
from mmmgpu.progress import progress
from mmmgpu.shapes import place
from mmmgpu.statistics import interval
from mmmgpu.videos import read_frames

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

CONVERGED = 1.0  # [px] from the landmarks, beyond their jitter
BEST = 99.0  # [dB] of a texture that is met exactly


@dataclass(frozen=True)
class Judged:
    """One clip: of each frame its texture's PSNR [dB], and how far the points of the features, and
    those of a fit, are from the landmarks [px], root mean square over the points, (T,) each; of
    each frame but the first how far its landmarks are from those before.
    """

    psnr: Floats
    shown: Floats
    found: Floats
    jitter: Floats


def evaluate_aam(
    aam: Aam,
    clips: Sequence[Path],
    landmarks: Path,
    *,
    away: float = 5.0,
    seed: int = 0,
    backend: str = "warp",
) -> dict[str, Any]:
    """Judge `aam` by clips that it was not made of.

    Args:
        aam: The model.
        clips: Video files.
        landmarks: Folder with their landmarks in every frame.
        away: Of the start of a fit [px]: the mean shape where the head is, moved so far.
        seed: Of the directions in which starts are moved.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        JSON values. ``converged`` is the share of fits that end within `CONVERGED` and the
        landmarks' own jitter (the median of what they move by from frame to frame).

    Raises:
        InputError: A clip or its landmarks cannot be used.
    """
    labelled = [complete_clip(aam, Path(clip), Path(landmarks)) for clip in clips]
    if not labelled:
        raise InputError("no clip given; name at least one video file")
    fitter, rng = prepare_fitting(aam), np.random.default_rng(seed)
    with one_thread_each():
        judged = [
            _judge(fitter, clip, _directions(len(clip.frames), away, rng), get_backend(backend, 1))
            for clip in progress(labelled, "judge clips")
        ]
    return {"clips": [c.path.name for c in labelled], "away_px": away} | _results(judged)


def _directions(count: int, away: float, rng: np.random.Generator) -> Floats:
    """Steps of the length `away`, each in some direction, (T, 2)."""
    angle = rng.uniform(0, 2 * np.pi, count)
    return away * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _judge(fitter: Fitter, clip: LabelledClip, moved: Floats, kernels: Backend) -> Judged:
    aam = fitter.aam
    _, poses = aligned(aam, reduce_points(clip.points, aam.reduction))
    heads = enlarge_points(place(poses, aam.mesh.vertices), aam.reduction)
    starts = heads + moved[:, None]

    def one(item: tuple[int, Picture], _: Cancelled) -> tuple[float, float, float]:
        t, frame = item
        score, shape = _shown(aam, frame, clip.points[t], kernels, f"{clip.path}, frame {t}")
        fit: Match = match(fitter, frame, starts[t], kernels)
        truth = clip.points[t]
        return score, _distance(shape, truth), _distance(fit.shape, truth)

    rows = map_ordered(one, enumerate(read_frames(clip.path)), threads=default_threads())
    psnr, shown, found = np.array(list(rows)).T
    jitter = [_distance(a, b) for a, b in zip(clip.points, clip.points[1:], strict=False)]
    return Judged(psnr, shown, found, np.array(jitter))


def _shown(
    aam: Aam, frame: Picture, points: Floats, kernels: Backend, where: str
) -> tuple[float, Floats]:
    """PSNR [dB] of the texture that a frame's features give, and their points (N, 2) [px]."""
    seen = see(aam, [frame], points[None], kernels, where=where)
    picture = reduce_picture(frame, aam.reduction)
    texture = read_texture(aam.mesh, picture, reduce_points(points, aam.reduction), kernels)
    made = put_light_on(synthesize_texture(aam, seen.features[0]), seen.lights[0])
    error = float(np.mean((np.clip(made, 0, 1) - texture).astype(np.float64) ** 2))
    psnr = BEST if error == 0 else min(BEST, -10 * float(np.log10(error)))
    shape = place(seen.poses[0], synthesize_shape(aam, seen.features[0]))
    return psnr, enlarge_points(shape, aam.reduction)


def _distance(a: Floats, b: Floats) -> float:
    """Root mean square distance of points (N, 2)."""
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def _results(judged: Sequence[Judged]) -> dict[str, Any]:
    psnr, shown, found, jitter = (
        np.concatenate([getattr(j, name) for j in judged])
        for name in ("psnr", "shown", "found", "jitter")
    )
    unrest = float(np.median(jitter)) if len(jitter) else 0.0
    of_clips = interval([j.psnr.mean() for j in judged])
    half = of_clips.half_width if len(judged) > 1 else None
    return {
        "frames": len(psnr),
        "psnr_db": {"mean": of_clips.mean, "half_width_95": half},
        "psnr_of_worst_frame_db": float(psnr.min()),
        "points_of_features_px": float(shown.mean()),
        "landmark_jitter_px": unrest,
        "fit_px": {
            "median": float(np.median(found)),
            "95_percent_within": float(np.quantile(found, 0.95)),
            "worst": float(found.max()),
        },
        "within_1_px": float(np.mean(found <= CONVERGED)),
        "converged": float(np.mean(found <= CONVERGED + unrest)),
    }
