"""What a model has learned, and how well, as one HTML file that needs no other file.

Pictures and small videos lie inside it. It reads well on a phone, in the light and in the dark, and
says in plain words what every picture shows.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.figures import (
    Panel,
    curves,
    enlarged,
    flow_arrows,
    learning_curve,
    outlined,
    seen_through,
)
from mmmgpu.files import write_text
from mmmgpu.models import Model, phonemes_of, project_on_simplex, trajectories
from mmmgpu.parallel import one_thread_each
from mmmgpu.phones import SIL, VISEMES, arpabet
from mmmgpu.report_parts import PAGE, figure, pair, small, tile, videos_section
from mmmgpu.report_tables import error_table, fact_table, lip_table, picture_table
from mmmgpu.synthesis import Synthesizer, prepare_synthesis, synthesize_batch
from mmmgpu.trajectory_files import Trajectory

Floats = NDArray[np.float64]

LARGEST_ARROWS = 360  # [px] width of a picture with arrows
FLOWS_SHOWN, CHANGES_SHOWN, STILLS_SHOWN = 6, 8, 12
OUTLINES = (("w_f", (255, 210, 60)), ("w_t", (90, 200, 255)), ("cover", (255, 255, 255)))


def write_report(
    model: Model,
    path: str | os.PathLike[str],
    *,
    evaluation: Mapping[str, Any] | None = None,
    held_out: Trajectory | None = None,
    spoken: Trajectory | None = None,
    videos: Mapping[str, Path] | None = None,
    backend: str = "warp",
) -> None:
    """Write the report on `model` to `path`, an HTML file.

    Args:
        model: Any model, of a real person too.
        path: ``.html``.
        evaluation: What `evaluation.evaluate` returned; under the key ``reconstruction`` it may
            also hold a list of what `evaluation.measure_reconstruction` returned.
        held_out: A real clip that the model was not trained on, analysed, with its phones.
        spoken: What `speaking.speak` returned.
        videos: Captions and the videos they describe.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: The file cannot be written.
    """
    with one_thread_each():
        synthesizer = prepare_synthesis(model.basis, backend=backend)
        sections = [
            _summary(model),
            videos_section(videos or {}, Path(path)),
            _reference(model),
            _prototypes(model),
            _flows(model),
            _visemes(model, synthesizer),
            _training(model, synthesizer),
            _movement(model, held_out) if held_out else "",
            _errors(evaluation) if evaluation else "",
            _stills(spoken, synthesizer) if spoken else "",
        ]
    body = "\n".join(section for section in sections if section)
    write_text(path, PAGE.format(title="A learned mouth: report", body=body))


def _summary(model: Model) -> str:
    notes, fps = model.notes, float(model.fps)
    skipped = notes.get("skipped", {})
    frames = notes.get("frames", 0)
    facts = {
        "clips learned from": str(len(notes.get("clips", []))),
        "frames": f"{frames} ({frames / fps:.0f} s at {fps:g} a second)",
        "size of the picture": "{} x {} pixels".format(*model.frame_size),
        "prototypes": str(len(model.basis.images)),
        "phones": str(len(model.alpha.trained.labels)),
        "frames without a head": str(notes.get("unregistered_frames", 0)),
        "unrest of the registration": f"{notes.get('registration_residual_px', 0):.2f} pixels",
        "sound moved by": f"{notes.get('sync_s', 0):+.3f} s",
        "clips skipped": str(len(skipped)),
    }
    text = (
        "<h1>A learned mouth</h1>\n"
        "<p>A mouth was learned from video: how it looks, and how it moves with each speech sound "
        "(phone). This page shows what was found, step by step, and how far the result is from "
        "the real thing.</p>\n" + fact_table(facts)
    )
    if skipped:
        rows = "".join(
            f"<li><b>{escape(name)}</b>: {escape(why)}</li>" for name, why in skipped.items()
        )
        text += f"<p>Skipped, and why:</p><ul>{rows}</ul>"
    return text + (
        "<p>The unrest of the registration is how far the measured head position jumps about from "
        "frame to frame; it is smoothed away before anything is learned. Below a pixel is good.</p>"
    )


def _reference(model: Model) -> str:
    basis = model.basis
    frame = model.prototype_frames[basis.reference]
    masks = [(getattr(basis, name), colour) for name, colour in OUTLINES]
    scale = 2 if frame.shape[0] <= 400 else 1
    drawn = outlined(frame, masks, basis.region.box[:2], scale=scale)
    image = basis.images[basis.reference]
    words = ("flows are compared here", "textures are compared here", "this much is put on a video")
    parts = [
        tile(seen_through(image, mask), f"{name}: {use}")
        for (mask, _), (name, _), use in zip(masks, OUTLINES, words, strict=True)
    ]
    name, t = model.sources[basis.reference]
    return (
        "<h2>The reference</h2><p>One calm frame is the reference "
        f"(frame {t} of {escape(name)}): every other mouth is described as this one moved. "
        "The masks say where.</p>"
        + figure(drawn, "The reference with the half-way lines of the lip mask w_f (yellow), "
                  "the mouth mask w_t (blue) and the cover (white).")
        + f'<div class="tiles middle">{"".join(parts)}</div>'
    )  # fmt: skip


def _prototypes(model: Model) -> str:
    tiles = "".join(
        tile(
            image,
            f"{i}" + (" (reference)" if i == model.basis.reference else ""),
            alt=f"prototype {i}: frame {t} of {name}",
            marked=i == model.basis.reference,
        )
        for i, (image, (name, t)) in enumerate(zip(model.basis.images, model.sources, strict=True))
    )
    return (
        "<h2>All prototypes</h2><p>Real frames chosen so that together they show all that this "
        f"mouth does. Everything the model shows is mixed from these.</p><div class='tiles'>{tiles}"
        "</div>"
    )


def _flows(model: Model) -> str:
    basis = model.basis
    moved = np.sqrt((basis.flows**2).sum(axis=-1) * basis.w_f).mean(axis=(1, 2))
    origin = basis.images[basis.reference]
    scale = max(1, round(LARGEST_ARROWS / origin.shape[1]))
    tiles = "".join(
        pair(
            flow_arrows(origin, basis.flows[i], scale=scale),
            enlarged(basis.images[i], scale),
            (f"arrows of flow {i} on the reference", f"prototype {i}"),
            f"to prototype {i}",
        )
        for i in np.argsort(-moved)[:FLOWS_SHOWN]
    )
    return (
        "<h2>Flows</h2><p>A flow says where each point of the reference has gone in a prototype: "
        "an arrow begins at the point in the reference and ends where it is in the prototype on "
        f"the right. Here are the largest.</p><div class='tiles wide'>{tiles}</div>"
    )


def _visemes(model: Model, synthesizer: Synthesizer) -> str:
    tiles = "".join(
        tile(
            image,
            f"{label} · {count}",
            alt=f"the mouth in the middle of {label}, learned from {count} frames",
        )
        for label, count, image in _means(model, synthesizer)
    )
    return (
        "<h2>The mouth of each phone</h2><p>The trained mean of every phone, as the model draws "
        "it, with the number of frames it was learned from; phones that look alike stand "
        f"together.</p><div class='tiles'>{tiles}</div>"
    )


def _means(
    model: Model, synthesizer: Synthesizer
) -> Iterator[tuple[str, int, NDArray[np.float32]]]:
    """Every phone with its frames and its mean as a picture, in order of viseme classes."""
    order = [label for labels in VISEMES.values() for label in labels]
    known = model.alpha.trained.labels
    labels = sorted(known, key=lambda p: _place(p, order))
    counts = [int(model.alpha.trained.count[known.index(label)]) for label in labels]
    yield from zip(labels, counts, mean_pictures(model, labels, synthesizer), strict=True)


def _place(label: str, order: Sequence[str]) -> tuple[int, str]:
    phone = arpabet(label)
    return (order.index(phone) if phone in order else len(order)), label


def mean_pictures(
    model: Model, labels: Sequence[str], synthesizer: Synthesizer, *, kind: str = "trained"
) -> NDArray[np.float32]:
    """The means of phones as pictures, (n, h, w, 3) in [0, 1]; for `kind` see `trajectories`."""
    alpha, beta = (
        m.mean[[m.labels.index(label) for label in labels]] for m in phonemes_of(model, kind)
    )
    return synthesize_batch(synthesizer, alpha, project_on_simplex(beta))


def _training(model: Model, synthesizer: Synthesizer) -> str:
    alpha = model.alpha
    change = np.linalg.norm(alpha.trained.mean - alpha.pooled.mean, axis=1)
    labels = [alpha.trained.labels[i] for i in np.argsort(-change)[:CHANGES_SHOWN]]
    before, after = (
        mean_pictures(model, labels, synthesizer, kind=kind) for kind in ("pooled", "trained")
    )
    pairs = "".join(
        pair(
            small(old),
            small(new),
            (f"{label} before training", f"{label} after training"),
            f"{label}: before, after",
        )
        for label, old, new in zip(labels, before, after, strict=True)
    )
    errors = {
        f"{name} (clips learned from)": stream.history.training.sum(axis=1)
        for name, stream in (("alpha, movement", alpha), ("beta, texture", model.beta))
        if len(stream.history.training)  # adaptation keeps other curves, in the notes
    }
    curve = learning_curve(errors) if errors else ""
    constants = "; ".join(
        f"{name}: smoothness {c.smoothness:g}, order {c.order}, ridge {c.ridge:g}, "
        f"{c.iterations} iterations"
        for name, c in (("alpha", alpha.constants), ("beta", model.beta.constants))
    )
    return (
        "<h2>What training changed</h2><p>Plain averages over the frames of a phone make a lazy "
        "mouth: while one phone is said, the mouth is on its way to the next. Training moves the "
        "means until the whole movement fits. These phones were moved most.</p>"
        f"<div class='tiles wide'>{pairs}</div>"
        f'<figure class="small">{curve}<figcaption>The squared error of the '
        "movement made from the phones, on the clips learned from, as training goes on. Constants "
        f"chosen by cross-validation inside these clips: {constants}.</figcaption></figure>"
    )


def _movement(model: Model, held_out: Trajectory) -> str:
    made = {
        name: trajectories(model, held_out.labels, kind=kind)
        for name, kind in (("before training", "pooled"), ("after training", "trained"))
    }
    panels = coefficient_panels(model, held_out, made, most=2)
    alphas = {"real": held_out.alpha, **{kind: y[0] for kind, y in made.items()}}
    opening = {kind: _opening(model, alpha) for kind, alpha in alphas.items()}
    panels.insert(0, Panel("lips apart [px]", opening))
    drawing = curves(panels, held_out.labels, float(held_out.fps))
    return (
        "<h2>Movement of a sentence that was not learned</h2><p>Grey: what the mouth really did, "
        "in the model's coordinates. Dashed orange: made from the phones before training. Blue: "
        "after training. Alpha says how far the mouth is moved towards a prototype, beta how much "
        "of its texture is mixed in; the two that move most of each are shown. Silence is shaded."
        f'</p><figure class="scroll">{drawing}<figcaption>Top: how much further the lips are '
        "apart than in the reference, by the model's own flow.</figcaption></figure>"
    )


def coefficient_panels(
    model: Model, real: Trajectory, made: Mapping[str, tuple[Floats, Floats]], *, most: int
) -> list[Panel]:
    """The coefficients of each stream that move most: real, and `made`, (alpha, beta) by name."""
    panels = []
    for stream, (name, z) in enumerate((("alpha", real.alpha), ("beta", real.beta))):
        numbers = model.basis.moving if name == "alpha" else np.arange(z.shape[1])
        for j in np.argsort(-z.var(axis=0))[:most]:
            shown = {"real": z[:, j], **{kind: y[stream][:, j] for kind, y in made.items()}}
            panels.append(Panel(f"{name} of prototype {numbers[j]}", shown))
    return panels


def _opening(model: Model, alpha: Floats) -> Floats:
    """How much further apart than in the reference the lips are [px], (T, M - 1) -> (T,).

    Measured below each other in the middle of the mouth, at the row that the prototypes move most
    and at the row within a mouth's width above it that they move most the other way.
    """
    basis = model.basis
    x, _, width = basis.region.mouth
    column = np.clip(round(x - basis.region.box[0]), 0, basis.region.shape[1] - 1)
    down = basis.flows[basis.moving][:, :, column, 1].astype(np.float64) * basis.w_f[:, column]
    lower = int(np.argmax((down**2).mean(axis=0)))
    above = slice(max(0, lower - round(width)), lower + 1)
    apart = ((down[:, lower : lower + 1] - down[:, above]) ** 2).mean(axis=0)
    upper = above.start + int(np.argmax(apart))
    return np.asarray(alpha @ (down[:, lower] - down[:, upper]))


def _errors(evaluation: Mapping[str, Any]) -> str:
    text = (
        "<h2>Errors</h2><p>The model against clips that it was not trained on: "
        f"{escape(', '.join(evaluation['clips']))}. Intervals are 95 % over clips.</p>"
        + error_table(evaluation)
    )
    if "lips" in evaluation:
        text += lip_table(evaluation["lips"])
    if evaluation.get("reconstruction"):
        text += picture_table(evaluation["reconstruction"])
    return text


def _stills(spoken: Trajectory, synthesizer: Synthesizer) -> str:
    """Frames in the middle of phones of what was spoken, evenly chosen."""
    middles = _middles(spoken.labels)
    chosen = [
        middles[i] for i in np.unique(np.linspace(0, len(middles) - 1, STILLS_SHOWN, dtype=int))
    ]
    images = synthesize_batch(synthesizer, spoken.alpha[chosen], spoken.beta[chosen])
    tiles = "".join(
        tile(image, f"{spoken.labels[t]} {float(t / spoken.fps):.2f} s")
        for t, image in zip(chosen, images, strict=True)
    )
    return (
        "<h2>Speaking</h2><p>The mouth of the new sentence in the middle of some of its phones."
        f"</p><div class='tiles'>{tiles}</div>"
    )


def _middles(labels: Sequence[str]) -> list[int]:
    """The middle frame of every run of one phone that is no silence; all runs, if all are."""
    starts = [t for t, label in enumerate(labels) if t == 0 or label != labels[t - 1]]
    runs = list(zip(starts, [*starts[1:], len(labels)], strict=True))
    said = [(a, b) for a, b in runs if labels[a] != SIL] or runs
    return [(a + b) // 2 for a, b in said]
