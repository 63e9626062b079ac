"""``mmmgpu align``: when each phone of a known transcript is said -> TextGrids."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from mmmgpu.commands.endings import say
from mmmgpu.commands.options import Clips, Json
from mmmgpu.commands.places import require_output, videos_in, write_results
from mmmgpu.commands.summaries import show_table
from mmmgpu.errors import InputError
from mmmgpu.files import read_text

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mmmgpu.alignments import Alignment
    from mmmgpu.lexicons import Spoken

EXAMPLE = "Example: mmmgpu align clips/*.mp4 --transcripts clips --out alignments"
ALIGNERS = ("pocketsphinx", "hmm")
WORK = "hmm.work"  # the folder of unfinished training

Transcripts = Mapping[str, tuple[Path, str]]  # the file and the text of each clip, by its name
Result = dict[str, Any]


def align(
    clips: Clips,
    *,
    transcripts: Annotated[
        Path,
        typer.Option(
            metavar="DIR|FILE",
            help="Folder with NAME.txt for every clip NAME.*; or one file with a line "
            "'NAME<tab>what is said' for each; for a single clip also its text.",
        ),
    ],
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for the alignments, NAME.TextGrid.")
    ],
    aligner: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="pocketsphinx: English, clip by clip, by models that come with it. hmm: any "
            "language, by models trained on CLIPs and transcripts alone; needs many clips.",
        ),
    ] = ALIGNERS[0],
    dictionary: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="With --aligner hmm: how words are pronounced, in lines 'word PHONE PHONE ...' "
            "(CMUdict's format); without it the speech is English.",
        ),
    ] = None,
    breath: Annotated[
        bool,
        typer.Option("--breath", help="With --aligner hmm: look for breaths (BR) in the pauses."),
    ] = False,
    json: Json = None,
) -> None:
    """Find when each phone of a transcript is said in CLIPs.

    The speech is English unless a dictionary is given; sound files are taken too. Every clip's
    TextGrid is written as soon as it is known. With pocketsphinx one that is newer than its clip
    and transcript is kept, so an interrupted job continues; with hmm all are made anew, and an
    interrupted training continues. A clip that cannot be aligned is reported, the others go on, and
    the status is 1 at the end. Times are those of the sound in the file: give --sync to train.
    """
    if aligner not in ALIGNERS:
        raise typer.BadParameter(f"choose one of {', '.join(ALIGNERS)}", param_hint="--aligner")
    if aligner != "hmm" and (dictionary is not None or breath):
        option = "--breath" if breath else "--dictionary"
        raise typer.BadParameter("is for --aligner hmm", param_hint=option)
    found = videos_in(clips)
    said = read_transcripts(transcripts, found)
    inputs = [transcripts, dictionary, *found]
    require_output(out / f"{found[0].stem}.TextGrid", inputs)
    require_output(json, inputs)
    jobs = [_Job(out, clip, *said.get(clip.stem, (transcripts, None))) for clip in found]
    if aligner == "hmm":
        results, training = _align_by_hmms(jobs, out / WORK, dictionary, breath=breath)
    else:
        results, training = _align_one_by_one(jobs), {}
    counts = {s: sum(r["status"] == s for r in results) for s in ("aligned", "kept", "failed")}
    if counts["failed"] < len(results):
        show_table(str(out), counts.items())
    write_results({"folder": str(out), **counts, **training, "clips": results}, json)
    if counts["failed"]:
        raise typer.Exit(1)


def read_transcripts(place: Path, clips: Sequence[Path]) -> Transcripts:
    """The file that holds the transcript of each clip, and its text, by the clip's name.

    Raises:
        InputError: There is no such place, a file cannot be read or does not tell clips apart, or
            two clips have one name.
    """
    names = [clip.stem for clip in clips]
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise InputError(f"{double[0]}: two clips have this name; rename one of them")
    if place.is_dir():
        files = {name: place / f"{name}.txt" for name in names}
        return {name: (f, read_text(f)) for name, f in files.items() if f.is_file()}
    text = read_text(place)
    rows = [line.partition("\t") for line in text.splitlines() if line.strip()]
    if len(clips) == 1 and not any(tab for _, tab, _ in rows):
        return {names[0]: (place, text)}
    for name, tab, _ in rows:
        if not tab:
            raise InputError(f"{place}: {name[:40]!r} is no 'NAME<tab>what is said'; correct it")
    return {Path(name.strip()).stem: (place, words) for name, _, words in rows}


class _Job(NamedTuple):
    """The folder OUT, one clip, and the file and text of its transcript (None: there is none)."""

    out: Path
    clip: Path
    transcript: Path
    text: str | None

    @property
    def textgrid(self) -> Path:
        return self.out / f"{self.clip.stem}.TextGrid"

    @property
    def words(self) -> str:
        """The text; an InputError where there is none."""
        if self.text is None:
            raise InputError(f"{self.transcript}: holds no transcript of {self.clip.stem}; add it")
        return self.text

    def read_sound(self) -> tuple["NDArray[np.float32]", int]:
        """The sound of the clip, (samples, rate), as long as its picture."""
        from mmmgpu.sounds import check_sync, read_sound
        from mmmgpu.videos import picture_start, probe

        sound = read_sound(self.clip)
        if picture_start(self.clip) is not None:
            check_sync(probe(self.clip), sound)
        return sound

    def write(self, alignment: "Alignment") -> Result:
        """Write the TextGrid."""
        from mmmgpu.alignments import write_textgrid

        write_textgrid(alignment, self.textgrid)
        return self.result("aligned", phones=len(alignment.phones))

    def failed(self, error: InputError) -> Result:
        """Say why the clip cannot be aligned."""
        reason = str(error).removeprefix(f"{self.clip}: ")
        say(f"error: {self.clip}: {reason}")
        return self.result("failed", reason=reason)

    def result(self, status: str, **facts: Any) -> Result:
        """What became of the clip, for --json."""
        return {"clip": str(self.clip), "textgrid": str(self.textgrid), "status": status, **facts}


def _align_one_by_one(jobs: Sequence[_Job]) -> list[Result]:
    """Align each clip by pocketsphinx, unless there is a TextGrid newer than what it comes from."""
    from mmmgpu.aligner import align_speech
    from mmmgpu.progress import progress

    def align(job: _Job) -> Result:
        sources = [f.stat().st_mtime_ns for f in (job.clip, job.transcript) if f.exists()]
        made = job.textgrid.stat().st_mtime_ns if job.textgrid.is_file() else 0
        if len(sources) == 2 and made > max(sources):
            return job.result("kept")
        return job.write(align_speech(*job.read_sound(), job.words))

    results = []
    for job in progress(jobs, "align clips"):
        try:
            results.append(align(job))
        except InputError as error:
            results.append(job.failed(error))
    return results


def _align_by_hmms(
    jobs: Sequence[_Job], folder: Path, dictionary: Path | None, *, breath: bool
) -> tuple[list[Result], Result]:
    """Align all clips by models trained on them; the second of the results is about the training.

    Until that is done its steps lie in `folder`.
    """
    from mmmgpu.checkpoints import fingerprint, open_checkpoints
    from mmmgpu.hmm_aligner import align, make_recording, misfit, train_hmms
    from mmmgpu.hmm_training import ROUNDS
    from mmmgpu.progress import progress, progress_bar

    words_of = _words_by(dictionary)
    recordings, results = {}, {}
    for job in progress(jobs, "read clips"):
        try:
            recordings[job] = make_recording(*job.read_sound(), words_of(job.words))
        except InputError as error:
            results[job] = job.failed(error)
    if not recordings:
        return list(results.values()), {}
    files = [*filter(None, [dictionary]), *(f for job in recordings for f in job[1:3])]
    steps = open_checkpoints(folder, fingerprint(files, {"breath": breath, "steps": 1}))
    with progress_bar(sum(ROUNDS) * len(recordings), "train phone models") as advance:
        trained = train_hmms([*recordings.values()], breath=breath, folder=steps, advance=advance)
    for job, recording in progress(recordings.items(), "align clips"):
        found = align(trained.hmms, recording)
        results[job] = job.write(found) | {"misfit": misfit(trained.hmms, recording, found)}
    _warn_of_suspects([results[job] for job in recordings])
    shutil.rmtree(folder)
    return [results[job] for job in jobs], {"training": trained.facts}


def _warn_of_suspects(results: Sequence[Result]) -> None:
    """One line for each clip whose sound fits its transcript far worse than the others' do."""
    from mmmgpu.hmm_aligner import suspects

    misfits = [one["misfit"] for one in results]
    for one, is_suspect in zip(results, suspects(misfits), strict=True):
        one["suspect"] = bool(is_suspect)
        if is_suspect:
            say(
                f"warning: {one['clip']}: the sound fits its transcript far worse than in other "
                f"clips (misfit {one['misfit']:.1f}, median {median(misfits):.1f}); is that what "
                "is said?"
            )


def _words_by(dictionary: Path | None) -> "Callable[[str], list[Spoken]]":
    """How a text becomes words with their pronunciations: by `dictionary`, or English."""
    from mmmgpu.lexicons import look_up, read_lexicon
    from mmmgpu.pronunciation import look_up_english

    if dictionary is None:
        return look_up_english
    return partial(look_up, lexicon=read_lexicon(dictionary), path=dictionary)
