"""The report on a transferred and adapted model, after the figures of CE05: one HTML file.

Fig. 2: the points on both references. Fig. 3: prototypes and the frames chosen for them. Fig. 4: a
flow and a texture coefficient, real and synthetic. Fig. 5: five vowels of both persons.
"""

import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.adaptation import OTHER_STEP
from mmmgpu.figures import curves, learning_curve, to_bytes
from mmmgpu.files import write_text
from mmmgpu.models import Model, trajectories
from mmmgpu.parallel import one_thread_each
from mmmgpu.points import PointPair, read_points
from mmmgpu.report_parts import PAGE, figure, small, tile, videos_section
from mmmgpu.report_tables import fact_table, table
from mmmgpu.reports import coefficient_panels, mean_pictures
from mmmgpu.synthesis import prepare_synthesis
from mmmgpu.tracks import frame_at
from mmmgpu.trajectory_files import Trajectory

Bytes = NDArray[np.uint8]

VOWELS = ("AA", "IY", "UH", "EH", "AO")  # of the paper's Fig. 5
UNITS = {"alpha": 1, "beta": 255}  # of validation errors: px, and grey levels in place of [0, 1]
SHOWN_HEIGHT = 420  # [px] of a reference with its points
METHOD_NAMES = {
    "none": "no adaptation",
    "shift": "mean shift",
    "map": "MAP",
    "mllr": "MLLR",
    "gdlr": "GDLR",
}


def write_transfer_report(
    path: str | os.PathLike[str],
    *,
    before: Model,
    source: Model | None = None,
    after: Model | None = None,
    points: tuple[tuple[PointPair, Bytes], ...] = (),
    real: Trajectory | None = None,
    videos: Mapping[str, Path] | None = None,
    backend: str = "warp",
) -> None:
    """Write the report on a transferred model to `path`, an HTML file.

    Args:
        path: ``.html``.
        before: The transferred model.
        source: The model it was transferred from.
        after: The adapted model.
        points: The marked pairs, each with B's frame, (H, W, 3).
        real: A real clip of the new person in the coordinates of `after`, with its phones.
        videos: Captions and the videos they describe.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: The file cannot be written.
    """
    with one_thread_each():
        sections = [
            _introduction(before),
            videos_section(videos or {}, Path(path)),
            _marked(points, source) if source else "",
            _matched(source, before) if source else "",
            _history(before),
            _vowels(source, before, after, backend),
            _adaptation(after) if after else "",
            _movement(after, real) if after and real else "",
        ]
    body = "\n".join(section for section in sections if section)
    write_text(path, PAGE.format(title="A second face: report", body=body))


def points_in_clips(
    path: str | os.PathLike[str], clips: Sequence[Path]
) -> tuple[tuple[PointPair, Bytes], ...]:
    """The marked pairs in the file at `path`, each with the second person's frame, from `clips`."""
    by_name = {clip.name: clip for clip in clips}
    return tuple((p, frame_at(by_name[p.b.clip], p.b.frame)) for p in read_points(path))


def _introduction(model: Model) -> str:
    notes, fps = model.notes, float(model.fps)
    frames = notes["frames"]
    facts = {
        "clips of the second person": str(len(notes["clips"])),
        "frames": f"{frames} ({frames / fps:.0f} s)",
        "clips of the first person": str(len(notes["transferred_from"]["clips"])),
        "prototypes": str(len(model.sources)),
        "different frames chosen for them": str(notes["matching"]["different_frames"]),
        "clips skipped": ", ".join(notes["skipped"]) or "none",
    }
    return (
        "<h1>A second face</h1>\n<p>A mouth that was learned from one person's long video is given "
        "to a second person, of whom there are only seconds.</p>" + fact_table(facts)
    )


def _marked(points: tuple[tuple[PointPair, Bytes], ...], source: Model) -> str:
    if not points:
        return ""
    shown = []
    for marks, picture in points:
        k = source.sources.index((marks.a.clip, marks.a.frame))
        left = _with_points(source.prototype_frames[k], marks.points_a)
        right = _with_points(picture, marks.points_b)
        caption = f"{marks.kind}: {len(marks.names)} points, first and second person"
        shown.append(figure(np.hstack([left, right]), caption))
    return (
        "<h2>Corresponding points</h2><p>A smooth map through these points carries every place of "
        "the first face to the second (the paper's Fig. 2).</p>" + "".join(shown)
    )


def _with_points(picture: Bytes, points: NDArray[np.float64]) -> Bytes:
    """`picture`, `SHOWN_HEIGHT` high, with a ring at each point."""
    scale = SHOWN_HEIGHT / picture.shape[0]
    size = (round(picture.shape[1] * scale), SHOWN_HEIGHT)
    drawn = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    for x, y in points:
        at = (round((x + 0.5) * scale - 0.5), round((y + 0.5) * scale - 0.5))
        cv2.circle(drawn, at, 4, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.circle(drawn, at, 4, (255, 230, 60), 1, cv2.LINE_AA)
    return np.asarray(drawn, np.uint8)


def _matched(source: Model, model: Model) -> str:
    tiles = "".join(
        tile(_above(a, b), str(k), alt=f"prototype {k}, and what was chosen for it")
        for k, (a, b) in enumerate(zip(source.basis.images, model.basis.images, strict=True))
    )
    return (
        "<h2>Prototypes and their counterparts</h2><p>Above the mouths of the first person, below "
        "the frames of the second that were chosen for them (the paper's Fig. 3).</p>"
        f"<div class='tiles'>{tiles}</div>"
    )


def _above(a: NDArray[Any], b: NDArray[Any]) -> Bytes:
    upper = small(a)
    lower = cv2.resize(to_bytes(b), upper.shape[1::-1], interpolation=cv2.INTER_AREA)
    return np.vstack([upper, lower])


def _history(model: Model) -> str:
    found = model.notes["matching"]
    by_flow, by_both = np.array(found["flow_history"]), np.array(found["history"])
    rows = [
        ["flow, calibrated" if i else "flow", *_counts(by_flow, i), "", ""]
        for i in range(len(by_flow))
    ]
    rows += [
        [
            f"flow and texture, iteration {i}" if i else "of these, at the start",
            *_counts(by_both, i),
            f"{np.mean(found['flow_distance'][i]):.3f}",
            f"{np.mean(found['texture_distance'][i]):.3f}",
        ]
        for i in range(len(by_both))
    ]
    head = ("candidates", "changed", "different frames", "flow distance", "texture distance")
    used = found["reference"]
    said = ", ".join(f"{kind}: {used.count(kind)}" for kind in dict.fromkeys(used))
    return (
        "<h2>How they were found</h2><p>Distances are means over the prototypes, in units of the "
        f"median over all frames. The search ended in a {escape(found['outcome'])}. Prototypes by "
        f"the reference they were compared from: {escape(said)}.</p>" + table(head, rows)
    )


def _counts(history: NDArray[np.int64], i: int) -> tuple[str, str]:
    """How many candidates changed in step i, and how many frames are among them."""
    changed = (history[i] != history[i - 1]).sum() if i else history.shape[1]
    return str(int(changed)), str(len(set(history[i].tolist())))


def _vowels(source: Model | None, before: Model, after: Model | None, backend: str) -> str:
    models = {"first person": source, "second, before": before, "second, after": after}
    rows = []
    for name, model in models.items():
        if model is None:
            continue
        known = [v for v in VOWELS if v in model.alpha.trained.labels]
        images = mean_pictures(model, known, prepare_synthesis(model.basis, backend=backend))
        tiles = "".join(tile(image, f"{v}, {name}") for v, image in zip(known, images, strict=True))
        rows.append(f"<div class='tiles middle'>{tiles}</div>")
    return (
        "<h2>Vowels</h2><p>The mean mouth of five vowels: the first person, the second before "
        "adaptation, and after it (the paper's Fig. 5). Vowels that the model does not know are "
        "left out.</p>" + "".join(rows)
    )


def _adaptation(model: Model) -> str:
    found = model.notes["adaptation"]
    coverage = found["coverage"]
    facts = {
        "frames a phone": f"{coverage['frames_per_phone']:.2f}",
        "without silence": f"{coverage['frames_per_phone_without_silence']:.2f}",
        "phones not seen": f"{len(coverage['phones_not_seen'])} of {len(coverage['frames'])}: "
        + ", ".join(coverage["phones_not_seen"]),
        "classes of phones": "; ".join(" ".join(members) for members in found["classes"]),
    }
    rows = []
    for method, name in METHOD_NAMES.items():
        cells = [name + (" (speaks)" if method == found["method"] else "")]
        for stream in ("alpha", "beta"):
            curve = found["curves"][stream][method]
            best = curve["candidates"].index(curve["chosen"])
            seen = UNITS[stream] * np.sqrt(curve["validation"][best])
            cells += [f"{np.sqrt(curve['training'][best]):.4f}", f"{seen:.2f}"]
        rows.append(cells)
    head = ("RMS error", "alpha, used", "left out [px]", "beta, used", "left out [grey levels]")
    drawings = "".join(
        f'<figure class="small">{_descent(found["curves"][s][kind])}<figcaption>GDLR of {s} with '
        f"the {step} step, on the clips used and, by folds inside them, on those left out."
        "</figcaption></figure>"
        for s in ("alpha", "beta")
        for kind, step in (("gdlr", found["step"]), (OTHER_STEP, "other"))
    )
    return (
        "<h2>Adaptation</h2><p>How the phoneme models were moved to the second person's own "
        "movements. Phones that were not seen move with their class. Errors on the clips used are "
        "in model coordinates, those on clips left out in what is seen: the flow of the lips and "
        "the grey levels of the mouth.</p>" + fact_table(facts) + table(head, rows) + drawings
    )


def _descent(curve: Mapping[str, Any]) -> str:
    parts = {"used": curve["training"], "left out": curve["validation"]}
    return learning_curve({name: np.array(e)[curve["path"]] for name, e in parts.items()})


def _movement(model: Model, real: Trajectory) -> str:
    kinds = (("before adaptation", "pooled"), ("after adaptation", "trained"))
    made = {name: trajectories(model, real.labels, kind=kind) for name, kind in kinds}
    panels = coefficient_panels(model, real, made, most=1)
    drawing = curves(panels, real.labels, float(real.fps))
    return (
        "<h2>Movement</h2><p>The flow and the texture coefficient that move most in a clip of the "
        "second person: real, and made from its phones before and after adaptation (the paper's "
        f'Fig. 4).</p><figure class="scroll">{drawing}</figure>'
    )
