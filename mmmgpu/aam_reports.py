"""The report on an active appearance model, after Fig. 2 of ECR07: one HTML file.

The landmarks on a frame with their triangles, the frame rebuilt from its features, and what each
of the first features does.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.aam import labelled_clip
from mmmgpu.aam_rendering import draw_face, render_face
from mmmgpu.appearances import Aam, see
from mmmgpu.backends import Backend, get_backend
from mmmgpu.files import write_text
from mmmgpu.labelled_clips import LabelledClip
from mmmgpu.parallel import one_thread_each
from mmmgpu.report_parts import PAGE, figure, tile
from mmmgpu.report_tables import fact_table
from mmmgpu.tracks import frame_at

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

MODES_SHOWN = 6
FRAMES_SHOWN = 5
FAR = 2.0  # standard deviations of a feature that is shown
WIDTH = 480  # [px] of a face with its landmarks
MARGIN = 0.4  # of the width of the landmarks, shown about them
LINE, POINT = (90, 200, 255), (255, 230, 60)


def write_aam_report(
    aam: Aam,
    path: str | os.PathLike[str],
    *,
    clip: Path,
    landmarks: Path,
    test: Mapping[str, Any] | None = None,
    backend: str = "warp",
) -> None:
    """Write the report on `aam` to `path`, an HTML file.

    Args:
        aam: The model.
        path: ``.html``.
        clip: A video file that is shown, better one that the model was not made of.
        landmarks: Folder with its landmarks.
        test: What `aam_evaluation.evaluate_aam` returned.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: The clip or its landmarks cannot be used, or the file cannot be written.
    """
    labelled, kernels = labelled_clip(aam, clip, landmarks), get_backend(backend, 1)
    with one_thread_each():
        sections = [
            _summary(aam),
            _landmarks(aam, labelled),
            _rebuilt(aam, labelled, kernels),
            _modes(aam, kernels),
            _test(test) if test else "",
        ]
    body = "\n".join(section for section in sections if section)
    write_text(path, PAGE.format(title="An appearance model: report", body=body))


def _summary(aam: Aam) -> str:
    facts = {
        "clips learned from": str(len(aam.notes.get("clips", []))),
        "frames learned from": str(aam.notes.get("frames", 0)),
        "points": str(len(aam.mesh.vertices)),
        "pixels of the texture": str(len(aam.mesh.pixels.index)),
        "features of a frame": str(len(aam.variance)),
        "share of the variance": f"{100 * aam.share:.1f} %",
    }
    return (
        "<h1>An appearance model</h1>\n<p>How the lower face varies, in shape and in texture, was "
        "learned from frames with landmarks. A frame becomes a few numbers, its features; features "
        "become a picture.</p>\n" + fact_table(facts)
    )


def _landmarks(aam: Aam, clip: LabelledClip) -> str:
    i = len(clip.frames) // 2
    t, points = int(clip.frames[i]), clip.points[i]
    frame = frame_at(clip.path, t)
    plain, drawn = _face(frame, points), _face(frame, points, aam)
    return (
        "<h2>Landmarks</h2><p>Where the points are known in a frame, and the triangles between "
        "them (the paper's Fig. 2). The colours inside the triangles, carried to the mean shape, "
        "are the texture.</p>"
        + figure(np.hstack([plain, drawn]), f"Frame {t} of {clip.path.name} and its landmarks.")
    )


def _face(frame: Bytes, points: Floats, aam: Aam | None = None) -> Bytes:
    """The face about `points`, `WIDTH` wide, with the points and triangles of `aam`, if given."""
    reach = MARGIN * float(np.ptp(points[:, 0]))
    low = np.maximum(np.floor(points.min(axis=0) - reach), 0).astype(int)
    high = np.minimum(np.ceil(points.max(axis=0) + reach), frame.shape[1::-1]).astype(int)
    part = frame[low[1] : high[1], low[0] : high[0]]
    scale = WIDTH / part.shape[1]
    size = (WIDTH, round(part.shape[0] * scale))
    large = cv2.resize(part, size, interpolation=cv2.INTER_CUBIC)
    picture: Bytes = np.ascontiguousarray(large, np.uint8)
    if aam is None:
        return picture
    at = np.rint((points - low + 0.5) * scale - 0.5).astype(int)
    for triangle in aam.mesh.triangles:
        cv2.polylines(picture, [at[triangle].astype(np.int32)], True, LINE, 1, cv2.LINE_AA)
    for x, y in at:
        cv2.circle(picture, (int(x), int(y)), 3, POINT, -1, cv2.LINE_AA)
    return picture


def _rebuilt(aam: Aam, clip: LabelledClip, kernels: Backend) -> str:
    tiles = []
    shown = np.linspace(0, len(clip.frames) - 1, min(FRAMES_SHOWN, len(clip.frames))).astype(int)
    for i in shown:
        t, points = int(clip.frames[i]), clip.points[i]
        frame = frame_at(clip.path, t)
        where = f"{clip.path}, frame {t}"
        c = see(aam, [frame], points[None], kernels, where=where).features[0]
        made = render_face(aam, frame, points, c, kernels, where=where)
        both = np.vstack([_face(frame, points), _face(made, points)])
        tiles.append(tile(both, f"frame {t}", alt=f"frame {t}, real above, rebuilt below"))
    return (
        f"<h2>Frames rebuilt from their features</h2><p>Above frames of {clip.path.name}, below "
        f"the same with the face that {len(aam.variance)} numbers give.</p>"
        f"<div class='tiles middle'>{''.join(tiles)}</div>"
    )


def _modes(aam: Aam, kernels: Backend) -> str:
    rows = []
    total = aam.variance.sum() / aam.share
    for i in range(min(MODES_SHOWN, len(aam.variance))):
        faces = []
        for far in (-FAR, 0.0, FAR):
            c = np.zeros(len(aam.variance))
            c[i] = far * np.sqrt(aam.variance[i])
            faces.append(draw_face(aam, c, kernels))
        share = 100 * aam.variance[i] / total
        rows.append(figure(np.hstack(faces), f"Feature {i + 1}: {share:.0f} % of the variance."))
    return (
        "<h2>What the features do</h2><p>The mean face in the middle; to the left and right one "
        f"feature, {FAR:g} standard deviations below and above its mean, all others at theirs.</p>"
        f"<div class='tiles wide'>{''.join(rows)}</div>"
    )


def _test(test: Mapping[str, Any]) -> str:
    fit, psnr = test["fit_px"], test["psnr_db"]
    facts = {
        "clips, frames": f"{len(test['clips'])}, {test['frames']}",
        "texture from features, PSNR": f"{psnr['mean']:.1f} dB",
        "worst frame": f"{test['psnr_of_worst_frame_db']:.1f} dB",
        "points from features, distance": f"{test['points_of_features_px']:.2f} px",
        "landmarks from frame to frame": f"{test['landmark_jitter_px']:.2f} px",
        f"fitted from {test['away_px']:g} px away, distance": f"{fit['median']:.2f} px (median)",
        "converged": f"{100 * test['converged']:.1f} %",
    }
    return (
        "<h2>On clips that were not learned from</h2><p>A fit has converged if its points end "
        "within a pixel of the landmarks, and what these move by from frame to frame, root mean "
        "square.</p>" + fact_table(facts)
    )
