"""``mmmgpu reconstruct``: a real clip analysed and synthesised back."""

from pathlib import Path
from typing import Annotated

import typer

from mmmgpu.commands.options import (
    Backend,
    Clip,
    Json,
    Landmarks,
    Lossless,
    ModelFile,
    Sync,
    VideoOut,
)
from mmmgpu.commands.places import require_output, require_video_output, write_results
from mmmgpu.commands.summaries import flat, show_table

EXAMPLE = "Example: mmmgpu reconstruct ann.mmm clips/a.mp4 --out back.mkv --lossless"


def reconstruct(
    model: ModelFile,
    clip: Clip,
    *,
    out: VideoOut,
    lossless: Lossless = False,
    landmarks: Landmarks = None,
    alignments: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="With --landmarks: alignments, to know silence by."),
    ] = None,
    sync: Sync,
    backend: Backend,
    json: Json = None,
) -> None:
    """Analyse a real CLIP and synthesise it back.

    Size, length and sound stay the same. This is the best that the model can render of this person.
    With --lossless, --landmarks and --alignments it is also compared with the clip at the lips.
    """
    if (landmarks is None) != (alignments is None) or (landmarks and not lossless):
        raise typer.BadParameter("to compare give all of --lossless, --landmarks, --alignments")
    require_video_output(out, [model, clip])
    require_output(json, [model, clip])
    from mmmgpu.backends import get_backend
    from mmmgpu.corpora import open_corpus
    from mmmgpu.evaluation import measure_reconstruction
    from mmmgpu.landmarks import read_landmarks
    from mmmgpu.model_files import load
    from mmmgpu.reconstruction import reconstruct as render
    from mmmgpu.videos import probe

    get_backend(backend)
    person, info = load(model), probe(clip)
    labels: list[str] = []
    if landmarks and alignments:  # before the long work: can they be used?
        labels = open_corpus([clip], alignments, sync=sync)[0].labels
        read_landmarks(landmarks, clip, info.frames)
    analysed = render(person, clip, out, lossless=lossless, backend=backend)
    results = {
        "video": str(out),
        "clip": clip.name,
        "frames": info.frames,
        "registered_frames": int(analysed.track.registered.sum()),
        "size": [info.width, info.height],
        "fps": float(info.fps),
        "lossless": lossless,
    }
    if landmarks:
        found = measure_reconstruction(
            person, clip, out, analysed, labels=labels, landmarks=landmarks
        )
        results |= found
    show_table(str(out), flat(results))
    write_results(results, json)
