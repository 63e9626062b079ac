"""``mmmgpu align``: when each phone of a known transcript is said -> TextGrids."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from mmmgpu.commands.endings import say
from mmmgpu.commands.options import Clips, Json
from mmmgpu.commands.places import require_output, videos_in, write_results
from mmmgpu.commands.summaries import show_table
from mmmgpu.errors import InputError

EXAMPLE = "Example: mmmgpu align clips/*.mp4 --transcripts clips --out alignments"


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
    json: Json = None,
) -> None:
    """Find when each phone of a transcript is said in CLIPs.

    The speech is English; sound files are taken too. Every clip's TextGrid is written as soon as it
    is known; one that is newer than its clip and transcript is kept, so an interrupted job
    continues. A clip that cannot be aligned is reported, the others go on, and the status is 1 at
    the end. Times are those of the sound in the file: give --sync to train.
    """
    found = videos_in(clips)
    said = read_transcripts(transcripts, found)
    require_output(out / f"{found[0].stem}.TextGrid", [transcripts, *found])
    require_output(json, [transcripts, *found])
    from mmmgpu.progress import progress

    results = []
    for clip in progress(found, "align clips"):
        textgrid = out / f"{clip.stem}.TextGrid"
        try:
            if clip.stem not in said:
                raise InputError(f"{transcripts}: holds no transcript of {clip.stem}; add it")
            result = _align_clip(clip, *said[clip.stem], textgrid)
        except InputError as error:
            reason = str(error).removeprefix(f"{clip}: ")
            say(f"error: {clip}: {reason}")
            result = {"status": "failed", "reason": reason}
        results.append({"clip": str(clip), "textgrid": str(textgrid), **result})
    counts = {s: sum(r["status"] == s for r in results) for s in ("aligned", "kept", "failed")}
    if counts["failed"] < len(results):
        show_table(str(out), counts.items())
    write_results({"folder": str(out), **counts, "clips": results}, json)
    if counts["failed"]:
        raise typer.Exit(1)


def read_transcripts(place: Path, clips: Sequence[Path]) -> dict[str, tuple[Path, str]]:
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


def read_text(path: Path) -> str:
    """The text in the UTF-8 file `path`.

    Raises:
        InputError: There is none.
    """
    try:
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8; convert it") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def _align_clip(clip: Path, transcript: Path, words: str, textgrid: Path) -> dict[str, Any]:
    """Write the TextGrid of one clip, unless one is there that is newer than what it comes from."""
    from mmmgpu.aligner import align_speech
    from mmmgpu.alignments import write_textgrid
    from mmmgpu.sounds import check_sync, read_sound
    from mmmgpu.videos import picture_start, probe

    sources = [f.stat().st_mtime_ns for f in (clip, transcript) if f.exists()]
    if len(sources) == 2 and textgrid.is_file() and textgrid.stat().st_mtime_ns > max(sources):
        return {"status": "kept"}
    samples, rate = read_sound(clip)
    if picture_start(clip) is not None:
        check_sync(probe(clip), (samples, rate))
    alignment = align_speech(samples, rate, words)
    write_textgrid(alignment, textgrid)
    return {"status": "aligned", "phones": len(alignment.phones)}
