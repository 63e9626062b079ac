"""``mmmgpu speak``: the model's person saying something new."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mmmgpu.commands.endings import say
from mmmgpu.commands.options import Backend, Json, LibraryDefault, Lossless, ModelFile, VideoOut
from mmmgpu.commands.places import require_output, require_video_output, write_results
from mmmgpu.commands.summaries import flat, show_table
from mmmgpu.errors import InputError
from mmmgpu.files import read_text

if TYPE_CHECKING:
    from mmmgpu.alignments import Alignment
    from mmmgpu.models import Model
    from mmmgpu.trajectory_files import Trajectory
    from mmmgpu.video_writing import Sound

EXAMPLE = 'Example: mmmgpu speak ann.mmm --text "Good morning." --out morning.mp4'
MODES = (
    {"text"},
    {"alignment", "audio"},
    {"audio", "transcript"},
    {"from_trajectory"},
    {"from_trajectory", "audio"},
)
LONGEST_GAP = 0.5  # s, by which sound and phones may differ in length


def speak(
    model: ModelFile,
    *,
    out: VideoOut,
    text: Annotated[
        str | None, typer.Option(metavar="TEXT", help="What to say, by a synthetic voice.")
    ] = None,
    alignment: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Phones and times (.TextGrid, .align, .lab) of --audio."),
    ] = None,
    audio: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The voice: a sound or video file.")
    ] = None,
    transcript: Annotated[
        str | None, typer.Option(metavar="TEXT", help="The English words said in --audio.")
    ] = None,
    from_trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Render a trajectory (CSV), saved and perhaps edited."),
    ] = None,
    save_trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Keep what the mouth does, frame by frame, as CSV."),
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option(
            metavar="CLIP", help="Clip of the person to put the mouth on; else the model's own."
        ),
    ] = None,
    voice: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Voice or language of espeak-ng for --text.",
            default_factory=LibraryDefault("mmmgpu.voices", "say", "voice"),
        ),
    ],
    movement: Annotated[
        str,
        typer.Option(
            "--trajectory",
            metavar="NAME",
            help="How phones become movement: egp02, hmm, brand, slds or dpds.",
            default_factory=LibraryDefault("mmmgpu.speaking", "plan", "movement"),
        ),
    ],
    articulation: Annotated[
        float,
        typer.Option(
            metavar="FACTOR",
            help="How far the mouth moves, 0.5 to 1.5.",
            default_factory=LibraryDefault("mmmgpu.speaking", "plan", "articulation"),
        ),
    ],
    sync: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            help="Move the sound against the picture by so much (negative: earlier).",
        ),
    ] = 0.0,
    lossless: Lossless = False,
    backend: Backend,
    json: Json = None,
) -> None:
    """Make a video of the model's person saying something new.

    What is said is one of: --text; --audio with its --alignment; --audio with its --transcript;
    --from-trajectory, with or without --audio. @FILE in place of a TEXT reads it from a file.
    Without --background the picture is that of the calmest clip that the model was trained on.
    """
    texts = {"text": text, "transcript": transcript}
    files = {"alignment": alignment, "audio": audio, "from_trajectory": from_trajectory}
    if {name for name, value in (texts | files).items() if value is not None} not in MODES:
        raise typer.BadParameter(
            "give one of: --text; --audio and --alignment; --audio and --transcript; "
            "--from-trajectory, with or without --audio"
        )
    if from_trajectory is not None and articulation != 1:
        raise typer.BadParameter("a trajectory has its own", param_hint="--articulation")
    inputs = [model, background, *files.values()]
    require_video_output(out, inputs)
    require_output(save_trajectory, [out, *inputs])
    require_output(json, [out, *inputs])
    from mmmgpu.backends import get_backend
    from mmmgpu.model_files import load
    from mmmgpu.models import REGULARISED
    from mmmgpu.speaking import plan, render
    from mmmgpu.trajectory_files import read_trajectory, write_trajectory

    if from_trajectory is not None and movement != REGULARISED:
        raise typer.BadParameter("--from-trajectory has its own", param_hint="--trajectory")
    get_backend(backend)
    person = load(model)
    sound, phones = _voice(text, voice, alignment, audio, transcript)
    if phones is not None:
        stand_ins = _stand_ins(person, phones, movement)
        trajectory = plan(person, phones, movement=movement, articulation=articulation)
    elif from_trajectory is not None:
        stand_ins = {}
        trajectory = read_trajectory(from_trajectory, len(person.basis.images), person.fps)
    if sound is not None:
        _check_lengths(sound, trajectory, audio)
        sound = _delayed(sound, sync)
    if save_trajectory is not None:
        write_trajectory(trajectory, save_trajectory)
    render(
        person,
        trajectory,
        out,
        sound=sound,
        background=background,
        lossless=lossless,
        backend=backend,
    )
    results = _results(out, phones, stand_ins)
    show_table(str(out), flat({k: v for k, v in results.items() if k != "phones"}))
    write_results(results, json)


def _voice(
    text: str | None,
    voice: str,
    alignment: Path | None,
    audio: Path | None,
    transcript: str | None,
) -> "tuple[Sound | None, Alignment | None]":
    """The sound and its phones; without phones where a trajectory takes their place."""
    from mmmgpu import voices
    from mmmgpu.aligner import align_speech
    from mmmgpu.alignments import read_alignment
    from mmmgpu.sounds import read_sound

    if text is not None:
        speech = voices.say(_given(text), voice=voice)
        return (speech.samples, speech.rate), speech.alignment
    if audio is None:
        return None, None
    sound = read_sound(audio, mono=False)
    if alignment is not None:
        return sound, read_alignment(alignment)
    if transcript is not None:
        return sound, align_speech(sound[0].mean(axis=1), sound[1], _given(transcript))
    return sound, None


def _given(text: str) -> str:
    """`text`, or what is in the file that it names after an @."""
    return read_text(Path(text[1:])) if text.startswith("@") else text


def _stand_ins(model: "Model", phones: "Alignment", movement: str) -> dict[str, str]:
    """Phones that the model has not seen and those that take their place; one warning."""
    from mmmgpu.models import labels_known
    from mmmgpu.phones import stand_in

    known = set(labels_known(model, movement))
    unknown = sorted({phone.label for phone in phones.phones} - known)
    found = {label: stand_in(label, known) for label in unknown}
    if found:
        said = ", ".join(f"{other} for {label}" for label, other in found.items())
        say(f"warning: the model has not seen every phone; what looks alike stands in: {said}")
    return found


def _check_lengths(sound: "Sound", trajectory: "Trajectory", audio: Path | None) -> None:
    """Raise InputError where the sound is much shorter or longer than the picture will be."""
    spoken, shown = len(sound[0]) / sound[1], float(len(trajectory) / trajectory.fps)
    if abs(spoken - shown) > LONGEST_GAP:
        word = "shorter" if spoken < shown else "longer"
        raise InputError(
            f"{audio}: the sound ({spoken:.2f} s) is {word} than its phones ({shown:.2f} s) by "
            f"more than {LONGEST_GAP} s; give what belongs together"
        )


def _delayed(sound: "Sound", seconds: float) -> "Sound":
    """`sound` moved later by `seconds`, or earlier and cut."""
    import numpy as np

    samples, rate = sound
    if not np.isfinite(seconds):
        raise InputError(f"--sync {seconds}: must be a number of seconds")
    late = round(seconds * rate)
    silence = np.zeros((max(late, 0), *samples.shape[1:]), np.float32)
    return np.concatenate([silence, samples[max(-late, 0) :]]), rate


def _results(out: Path, phones: "Alignment | None", stand_ins: dict[str, str]) -> dict[str, Any]:
    from mmmgpu.videos import probe

    info = probe(out)
    return {
        "video": str(out),
        "frames": info.frames,
        "fps": float(info.fps),
        "seconds": info.duration,
        "size": [info.width, info.height],
        "words": [] if phones is None else [word.label for word in phones.words],
        "phones": [] if phones is None else [list(phone) for phone in phones.phones],
        "stand_ins": stand_ins,
    }
