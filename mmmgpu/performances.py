"""Videos of the built-in performer saying sentences: what the demo learns from, and is judged by.

Every clip comes with its alignment (TextGrid), its text, and true landmarks; the sound is that of
espeak-ng, whose phone times the performer follows.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mmmgpu.alignments import Alignment, Segment, cover, write_textgrid
from mmmgpu.errors import InputError
from mmmgpu.files import atomic_path, require_folder, write_json, write_text
from mmmgpu.parallel import Cancelled, CancelledError, map_ordered
from mmmgpu.performer import Articulation, Performer, articulate, landmarks, performer, render
from mmmgpu.progress import progress
from mmmgpu.video_writing import write_video
from mmmgpu.voices import Speech, is_installed, say

# Together they hold every phone of CMUdict between several others.
SENTENCES: Final = (
    "Papa bought a big blue boat.",
    "My mother makes warm apple muffins.",
    "Five fat foxes found a vase of violets.",
    "She sells fresh fish by the seashore.",
    "The judge and the child chose a large orange jar.",
    "We were away all week in the woods.",
    "Both thin brothers think about the north path.",
    "You could put a good book in that bush.",
    "The boy enjoys noisy toys and coins.",
    "How loud the brown cow is, down by the house!",
    "Please keep these three green peas.",
    "His usual vision of treasure is a pleasure.",
    "Go home slowly over the cold snow.",
    "A young king is singing a long song.",
    "Red roses rarely grow around here.",
    "Who moved the blue moon into the room?",
    "Black cats catch rats and bats at last.",
    "The nurse heard her first word early.",
    "Light white kites fly high at night.",
    "Let ten men get seven wet pens.",
    "Do not drop the hot pot on the rock.",
    "Some lucky duck must jump above the mud.",
    "Wait, they say it may rain today.",
    "Zebras, bees and lizards live in this zoo.",
    "Give him six silver pins and a ring.",
    "Why would you wish for rough weather?",
)
SILENCE: Final = 0.5  # s before and after each sentence
PACE: Final = 150  # words a minute, as people talk


@dataclass(frozen=True)
class Stage:
    """How performances are filmed.

    size: (height, width) of the pictures [px].
    fps: frames a second.
    pace: [words a minute] of the voice.
    voice: of espeak-ng.
    silence: [s] before and after what is said.
    """

    size: tuple[int, int] = (256, 256)
    fps: int = 25
    pace: int = PACE
    voice: str = "en-us"
    silence: float = SILENCE


STAGE: Final = Stage()


def require_voice() -> None:
    """Check that sentences can be said.

    Raises:
        InputError: espeak-ng is not installed.
    """
    if not is_installed():
        raise InputError("performers need a voice; run pip install 'mmmgpu[tts]'")


def padded(speech: Speech, before: float, after: float) -> Speech:
    """`speech` with silence [s] around it."""
    samples = np.pad(
        speech.samples, (round(before * speech.rate), round(after * speech.rate))
    ).astype(np.float32)
    duration = len(samples) / speech.rate
    late = round(before * speech.rate) / speech.rate
    phones, words = (
        [Segment(s.label, s.start + late, s.end + late) for s in segments]
        for segments in (speech.alignment.phones, speech.alignment.words)
    )
    return Speech(samples, speech.rate, Alignment(cover(phones, duration), tuple(words), duration))


def say_sentence(text: str, stage: Stage = STAGE) -> Speech:
    """What the performer hears in its ear: `text` at the stage's pace between silences."""
    return padded(say(text, rate_wpm=stage.pace, voice=stage.voice), stage.silence, stage.silence)


def perform(
    performer: Performer,
    speech: Speech,
    path: str | os.PathLike[str],
    *,
    fps: int = 25,
    rng: np.random.Generator,
    noise: bool = True,
    cancelled: Cancelled = lambda: False,
) -> Articulation:
    """Film a performer saying `speech`.

    Beside the video come ``NAME.TextGrid`` and ``NAME.npz`` with the true landmarks, ``points``
    float32 (T, 103, 2) [px] (see `mmmgpu.landmarks`). The video is written last: where it is, all
    is there.

    Args:
        performer: Who speaks.
        speech: Sound and alignment.
        path: ``.mp4``, ``.mov`` or ``.mkv``.
        fps: Frames a second.
        rng: Of head motion, blinks and noise.
        noise: Whether the camera adds its noise.
        cancelled: Asked before every frame; an answer of True ends in `CancelledError`.

    Returns:
        What moved.

    Raises:
        InputError: A file cannot be written, or the alignment holds a phone of no performer.
    """
    path = Path(path)
    frames = max(1, round(np.ceil(speech.alignment.duration * fps - 1e-6)))
    motion = articulate(performer, speech.alignment.phones, frames, float(fps), rng)
    write_textgrid(speech.alignment, path.with_suffix(".TextGrid"))
    _write_landmarks(performer, motion, path.with_suffix(".npz"))

    def pictures() -> Any:
        for image in render(performer, motion, rng=rng if noise else None):
            if cancelled():
                raise CancelledError
            yield image

    write_video(path, pictures(), fps=Fraction(fps), sound=(speech.samples, speech.rate))
    return motion


def _write_landmarks(performer: Performer, motion: Articulation, path: Path) -> None:
    points: NDArray[np.float32] = np.array(
        [landmarks(performer, motion, t) for t in range(len(motion))], np.float32
    )
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, points=points)


def make_corpus(
    folder: str | os.PathLike[str],
    *,
    seed: int,
    sentences: Sequence[str] = SENTENCES,
    name: str = "sentence",
    stage: Stage = STAGE,
    threads: int = 1,
) -> tuple[Path, ...]:
    """Film one performer saying every sentence: ``NAME-01.mp4`` and so on, with their alignments.

    Clips that are there already from the same call, killed or finished, are kept. The text of each
    lies beside it in ``NAME-01.txt``.

    Args:
        folder: Made if it does not exist; files of these names in it are replaced.
        seed: Which performer; also of head motion and noise.
        sentences: English text.
        name: Of the clips. Clips with another name move their heads differently.
        stage: Size, frame rate and voice.
        threads: Clips at a time.

    Raises:
        InputError: No espeak-ng, nothing to say, or the folder cannot be written.
    """
    require_voice()
    folder = require_folder(folder)
    clips = tuple(folder / f"{name}-{i:02}.mp4" for i in range(1, len(sentences) + 1))
    _forget_other_plan(folder / f"{name}s.json", clips, seed, sentences, stage)
    face = performer(seed, size=stage.size)
    salt = int.from_bytes(name.encode(), "big")

    def one(item: tuple[int, Path, str], cancelled: Cancelled) -> None:
        i, clip, text = item
        if clip.exists():
            return
        write_text(clip.with_suffix(".txt"), text + "\n")
        rng = np.random.default_rng([seed, salt, i])
        perform(face, say_sentence(text, stage), clip, fps=stage.fps, rng=rng, cancelled=cancelled)

    items = list(zip(range(len(clips)), clips, sentences, strict=True))
    done = map_ordered(one, items, threads=threads)
    for _ in progress(done, f"film {name}s", total=len(items)):
        pass
    return clips


def _forget_other_plan(
    record: Path, clips: Sequence[Path], seed: int, sentences: Sequence[str], stage: Stage
) -> None:
    """Remove clips that were made by another call, told by the `record` it left."""
    plan = {"seed": seed, "sentences": list(sentences), "stage": asdict(stage)}
    plan = json.loads(json.dumps(plan))
    if record.is_file() and _read_plan(record) == plan:
        return
    for clip in clips:
        clip.unlink(missing_ok=True)
    write_json(record, plan)


def _read_plan(record: Path) -> Any:
    try:
        return json.loads(record.read_text("utf-8"))
    except ValueError:
        return None  # damaged: as if from another call
