"""Everything in one go, on built-in performers: film, learn, speak, reconstruct, judge, report.

Filming and training continue where a killed run stopped; the rest takes less than a minute.
"""

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mmmgpu.alignments import read_alignment
from mmmgpu.backends import default_threads
from mmmgpu.checkpoints import fingerprint
from mmmgpu.corpora import open_corpus
from mmmgpu.demo_second import SECOND, Second, add_second_person
from mmmgpu.evaluation import evaluate, measure_reconstruction
from mmmgpu.figures import captions
from mmmgpu.files import require_folder, write_json
from mmmgpu.model_files import load
from mmmgpu.models import Model
from mmmgpu.performances import SENTENCES, STAGE, Stage, make_corpus, require_voice, say_sentence
from mmmgpu.reconstruction import reconstruct
from mmmgpu.reports import write_report
from mmmgpu.sounds import read_sound
from mmmgpu.speaking import speak
from mmmgpu.training import Options, train
from mmmgpu.trajectory_files import Trajectory
from mmmgpu.video_writing import write_video
from mmmgpu.videos import probe, read_frames
from mmmgpu.voices import Speech

Bytes = NDArray[np.uint8]

HELD_OUT: Final = (
    "A happy family of five moved to the village.",
    "Would you measure the boy's new shoes?",
    "Paul thinks that brown bears like jam.",
    "The weather was good on both Fridays.",
    "Choose any picture of the younger girl.",
    "We mixed hot coffee with cold milk.",
)
RECONSTRUCTED: Final = 2  # of the clips held out
NEW: Final = "Nobody has ever filmed me saying these words."
SEED: Final = 23  # of the performer with the clearest mouth


@dataclass(frozen=True)
class Script:
    """What the performer says.

    learned: in the clips to learn from. held_out: in those to judge by; the first is also shown
    side by side. new: what only the model says.
    """

    learned: Sequence[str] = SENTENCES
    held_out: Sequence[str] = HELD_OUT
    new: str = NEW


SCRIPT: Final = Script()


@dataclass(frozen=True)
class _Steps:
    """Announces the steps of the demo on the standard error, and takes their times [s]."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        print(f"demo: {name}", file=sys.stderr, flush=True)
        begin = time.monotonic()
        yield
        self.seconds[name] = round(time.monotonic() - begin, 1)


def make_demo(
    out: Path,
    *,
    seed: int = SEED,
    second: Second = SECOND,
    script: Script = SCRIPT,
    prototypes: int = 46,
    stage: Stage = STAGE,
    backend: str = "warp",
) -> dict[str, Any]:
    """Film a performer, learn it, and let the model speak; leave all in the folder `out`.

    There will be ``corpus/``, ``model.mmm``, ``spoken.mp4``, ``side-by-side.mp4`` (real |
    reconstructed | spoken), ``report.html``, what `demo_second` makes of a second performer,
    ``second-side-by-side.mp4`` (before | after adaptation) and ``results.json``. A killed run
    continues. The last line on the standard output says what to open.

    Args:
        out: Made if it does not exist; files of these names in it are replaced.
        seed: Which performer, and of everything random.
        second: The second performer, to whom the model is transferred.
        script: What is said.
        prototypes: M.
        stage: Size and rate of the pictures, and the voice.
        backend: A name for `mmmgpu.backends.get_backend`.

    Returns:
        What is in ``results.json``: measurements as JSON values.

    Raises:
        InputError: The folder cannot be written, or there is no espeak-ng.
    """
    require_voice()
    out, steps = require_folder(out), _Steps()
    corpus = out / "corpus"
    with steps.step("film the performer"):
        learned, held_out = _film(corpus, seed, script, stage)
    with steps.step("learn the mouth"):
        model = _learn(out, learned, Options(prototypes=prototypes, seed=seed), backend)
    with steps.step("speak a new sentence"):
        speech = say_sentence(script.new, stage)
        spoken = speak(model, speech, out / "spoken.mp4", backend=backend)
    with steps.step("reconstruct and compare"):
        shown, pictures = _compare(
            model, held_out[:RECONSTRUCTED], out / "side-by-side.mp4", backend
        )
    with steps.step("judge"):
        judged = evaluate(model, held_out, corpus, landmarks=corpus, backend=backend)
        judged["reconstruction"] = pictures
    with steps.step("write the report"):
        videos = {
            f"The model says: “{script.new}”": out / "spoken.mp4",
            f"Not learned: “{script.held_out[0]}” Real, drawn again from its own model "
            "coordinates, and spoken by the model from the phones alone; below, the mouths "
            "enlarged.": out / "side-by-side.mp4",
        }
        page = out / "report.html"
        write_report(
            model,
            page,
            evaluation=judged,
            held_out=shown,
            spoken=spoken,
            videos=videos,
            backend=backend,
        )
    transferred, pair = add_second_person(
        out,
        model,
        corpus,
        speech,
        second=second,
        stage=stage,
        step=steps.step,
        threads=default_threads(),
        backend=backend,
    )
    both = out / "second-side-by-side.mp4"
    write_side_by_side(pair, both, mouth=load(out / "adapted.mmm").basis.region.mouth)
    results = {
        "seed": seed,
        "sentence": script.new,
        "training": model.notes,
        "evaluation": judged,
        "second": transferred,
        "seconds": steps.seconds,
    }
    write_json(out / "results.json", results)
    print(f"Open {page} in a browser; the second person speaks in {both}")
    return results


def _film(
    corpus: Path, seed: int, script: Script, stage: Stage
) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """The clips to learn from and those held out, all in one folder."""
    threads = default_threads()
    learned, held_out = (
        make_corpus(corpus, seed=seed, sentences=said, name=name, stage=stage, threads=threads)
        for said, name in ((script.learned, "sentence"), (script.held_out, "held-out"))
    )
    return learned, held_out


def _learn(out: Path, clips: Sequence[Path], options: Options, backend: str) -> Model:
    """Train, or load the model that this very code has trained on these very clips."""
    path, record = out / "model.mmm", out / "model.json"
    code = sorted(Path(__file__).parent.glob("**/*.py"))
    made_by = {"made_by": fingerprint([*code, *clips], {**vars(options), "backend": backend})}
    if path.is_file() and record.is_file() and _read_record(record) == made_by:
        return load(path)
    record.unlink(missing_ok=True)
    model = train(clips, clips[0].parent, path, options=options, backend=backend)
    write_json(record, made_by)
    return model


def _read_record(record: Path) -> Any:
    try:
        return json.loads(record.read_text("utf-8"))
    except ValueError:
        return None


def _compare(
    model: Model, clips: Sequence[Path], out: Path, backend: str
) -> tuple[Trajectory, list[dict[str, Any]]]:
    """Reconstruct the clips, speak the first one too, and show real, reconstructed and spoken.

    Returns:
        The first clip in model coordinates, and what the reconstructions measure.
    """
    corpus = open_corpus(clips, clips[0].parent)
    with tempfile.TemporaryDirectory(prefix="mmmgpu-") as folder:
        measured, analysed = [], []
        again = [Path(folder) / f"{clip.stem}.mkv" for clip in clips]
        for clip, made in zip(corpus, again, strict=True):
            found = reconstruct(model, clip.path, made, lossless=True, backend=backend)
            measured.append(
                measure_reconstruction(
                    model,
                    clip.path,
                    made,
                    found,
                    labels=clip.labels,
                    landmarks=clip.path.parent,
                )
            )
            analysed.append(found)
        said = Path(folder) / "said.mkv"
        samples, rate = read_sound(clips[0])
        speech = Speech(samples, rate, read_alignment(clips[0].with_suffix(".TextGrid")))
        speak(model, speech, said, lossless=True, backend=backend)
        shown = {"real": clips[0], "reconstructed": again[0], "spoken from phones": said}
        write_side_by_side(shown, out, mouth=model.basis.region.mouth)
    first = Trajectory(
        tuple(corpus[0].labels), analysed[0].alpha, analysed[0].beta, corpus[0].info.fps
    )
    return first, measured


def write_side_by_side(
    videos: Mapping[str, Path], out: Path, *, mouth: tuple[float, float, float]
) -> None:
    """Write videos of one size and rate beside each other, captions above, mouths enlarged below.

    Args:
        videos: Captions and files; the first one gives the sound and the frame rate.
        out: ``.mp4``.
        mouth: (x, y, width) [px]: what is enlarged.

    Raises:
        InputError: A video cannot be read, or `out` not be written.
    """
    paths = list(videos.values())
    info = probe(paths[0])
    strip = captions(list(videos), info.width)

    def rows() -> Iterator[Bytes]:
        for frames in zip(*(read_frames(path) for path in paths), strict=False):
            closer = [mouth_closeup(frame, mouth) for frame in frames]
            picture = np.vstack([strip, np.hstack(frames), np.hstack(closer)])
            yield picture[: len(picture) // 2 * 2, : picture.shape[1] // 2 * 2]  # even: plays all

    write_video(out, rows(), fps=info.fps, sound=read_sound(paths[0]))


def mouth_closeup(frame: Bytes, mouth: tuple[float, float, float]) -> Bytes:
    """2.5 mouth widths around `mouth` (x, y, width) [px], as wide as `frame` (H, W, 3)."""
    x, y, width = mouth
    share = min(1.0, 2.5 * width / frame.shape[1])
    size = (frame.shape[1], round(0.6 * frame.shape[1]))
    corner = np.array([x, y]) - share * np.array(size) / 2
    to_frame = np.array([[share, 0, corner[0]], [0, share, corner[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    closer = cv2.warpAffine(frame, to_frame, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(closer, np.uint8)
