"""The second half of the demo: another performer, of whom there are seconds, gets the model.

Transfer and adaptation as on real video; the corresponding points are the performers' true ones.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mmmgpu.adaptation import AdaptOptions, adapt
from mmmgpu.corpora import open_corpus
from mmmgpu.evaluation import evaluate
from mmmgpu.landmark_points import points_from_landmarks
from mmmgpu.models import Model
from mmmgpu.performances import Stage, make_corpus
from mmmgpu.points import write_points
from mmmgpu.reconstruction import analyse_clip
from mmmgpu.reference_pairs import choose_references, source_references
from mmmgpu.speaking import speak
from mmmgpu.trajectory_files import Trajectory
from mmmgpu.transfer_reports import points_in_clips, write_transfer_report
from mmmgpu.transferring import transfer
from mmmgpu.voices import Speech

Step = Callable[[str], AbstractContextManager[None]]

ADAPTED: Final = (  # about 15 s
    "One, two, three, four, five.",
    "Six, seven, eight, nine, ten.",
    "We paint the barn red in May.",
    "Please leave the key with Bob.",
    "How do you know the way home?",
)
JUDGED: Final = (
    "My shoes are under the brown table.",
    "They found five small birds.",
    "Bring me a cup of cold water.",
)


@dataclass(frozen=True)
class Second:
    """The second performer.

    seed: which one. adapted: what is said in the clips to adapt to. judged: in clips held out.
    """

    seed: int = 8
    adapted: Sequence[str] = ADAPTED
    judged: Sequence[str] = JUDGED


SECOND: Final = Second()


def add_second_person(
    out: Path,
    model: Model,
    corpus: Path,
    speech: Speech,
    *,
    second: Second,
    stage: Stage,
    step: Step,
    threads: int,
    backend: str,
) -> tuple[dict[str, Any], dict[str, Path]]:
    """Film the second performer, transfer `model`, adapt it, and let both say `speech`.

    There will be ``second/`` with the clips, ``points.json``, ``transferred.mmm``, ``adapted.mmm``
    ``second-before.mp4``, ``second-after.mp4`` and ``transfer-report.html`` in `out`.

    Args:
        out: An existing folder.
        model: The first performer's.
        corpus: Folder with the first performer's landmarks.
        speech: What is said.
        second: Who the second performer is.
        stage: Size and rate of the pictures, and the voice.
        step: Announces a step of the demo and takes its time.
        threads: Clips filmed at a time.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        What was measured, as JSON values, and the videos before and after adaptation, by caption.
    """
    with step("film a second performer"):
        clips, held_out = (
            make_corpus(
                out / "second",
                seed=second.seed,
                sentences=said,
                name=name,
                stage=stage,
                threads=threads,
            )
            for said, name in ((second.adapted, "adapt"), (second.judged, "judge"))
        )
    folder = clips[0].parent
    with step("transfer the model to the second face"):
        shown = source_references(model), choose_references(clips)
        write_points(out / "points.json", points_from_landmarks(*shown, corpus, folder))
        points = out / "points.json"
        before = transfer(model, clips, folder, points, out / "transferred.mmm", backend=backend)
    with step("adapt it to the second person's style"):
        options = AdaptOptions(seed=second.seed)
        after = adapt(before, clips, folder, out / "adapted.mmm", options=options, backend=backend)
    with step("let the second person speak"):
        videos = {
            "before adaptation": out / "second-before.mp4",
            "after adaptation": out / "second-after.mp4",
        }
        for person, video in zip((before, after), videos.values(), strict=True):
            speak(person, speech, video, backend=backend)
    with step("judge the second person"):
        judged = evaluate(after, held_out, folder, landmarks=folder, backend=backend)
        real = _analysed(after, held_out[0], folder, backend)
    write_transfer_report(
        out / "transfer-report.html",
        source=model,
        before=before,
        after=after,
        points=points_in_clips(points, clips),
        real=real,
        videos={f"The second person, {name}.": video for name, video in videos.items()},
        backend=backend,
    )
    adaptation = {k: v for k, v in after.notes["adaptation"].items() if k != "curves"}
    return {"adaptation": adaptation, "evaluation": judged}, videos


def _analysed(model: Model, clip: Path, alignments: Path, backend: str) -> Trajectory:
    """A real clip in the coordinates of `model`, with its phones."""
    opened = open_corpus([clip], alignments)[0]
    found = analyse_clip(model, clip, backend=backend)
    return Trajectory(tuple(opened.labels), found.alpha, found.beta, opened.info.fps)
