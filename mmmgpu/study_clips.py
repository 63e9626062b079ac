"""The clips of a study: found by condition and sentence, compared, and written without a trace.

Every clip is decoded and written again with the same encoder and the same settings, with the sound
of the sentence's real clip, under a random name. Nothing of the old file but its pixels is taken
over. The files of one sentence have one length in bytes: the shorter ones end in an MP4 box of
type `free`, which players skip.
"""

import os
import secrets
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.sounds import check_sync, read_sound
from mmmgpu.studies import StudyClip
from mmmgpu.video_writing import Sound, write_video
from mmmgpu.videos import VIDEO_SUFFIXES, VideoInfo, probe, read_frames

Clips = Mapping[str, Path]  # of one sentence, by condition
_BOX = 8  # bytes of an MP4 box without content


@dataclass(frozen=True)
class Sentence:
    """The clips of one sentence, by condition, that can be shown beside each other.

    frames: how many of each clip are shown.
    """

    name: str
    clips: Mapping[str, VideoInfo]
    frames: int


def find_clips(
    folder: Path, conditions: Collection[str] | None = None
) -> dict[str, dict[str, Path]]:
    """The files FOLDER/CONDITION/SENTENCE.*, by sentence and condition, both sorted.

    conditions: those that are wanted; None: all that there are.

    Raises:
        InputError: There are fewer than two conditions, or not one that is wanted; one of them
            lacks a sentence that another has, or has it twice.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give one with a folder of clips per condition")
    homes = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    if conditions is not None:
        homes = _chosen(homes, conditions, folder)
    if len(homes) < 2:
        raise InputError(
            f"{folder}: has {len(homes)} folder(s) in it, but two conditions at least are needed; "
            "put the clips into a folder per condition"
        )
    found = {home.name: _by_sentence(home) for home in homes}
    sentences = sorted(set().union(*found.values()))
    for home in homes:
        for sentence in sentences:
            if sentence not in found[home.name]:
                other = next(name for name, clips in found.items() if sentence in clips)
                raise InputError(
                    f"{home}: has no clip of the sentence '{sentence}', which '{other}' has; "
                    "put it there, or take the sentence out everywhere"
                )
    return {s: {home.name: found[home.name][s] for home in homes} for s in sentences}


def _chosen(homes: Sequence[Path], conditions: Collection[str], folder: Path) -> list[Path]:
    has = [home.name for home in homes]
    for name in conditions:
        if name not in has:
            raise InputError(f"{folder}: has no folder '{name}'; choose from {', '.join(has)}")
    return [home for home in homes if home.name in conditions]


def _by_sentence(home: Path) -> dict[str, Path]:
    clips: dict[str, Path] = {}
    for file in sorted(home.iterdir()):
        if file.suffix.lower() not in VIDEO_SUFFIXES or file.name.startswith("."):
            continue
        if file.stem in clips:
            raise InputError(f"{file}: the sentence is also in {clips[file.stem].name}; keep one")
        clips[file.stem] = file
    if not clips:
        raise InputError(f"{home}: no video in this folder; put clips there, or take it away")
    return clips


def compare_clips(sentence: str, clips: Clips, *, cut: bool) -> Sentence:
    """What one sentence's clips are, if nothing but the pictures tells them apart.

    cut: show as many frames of each as the shortest has.

    Raises:
        InputError: A clip cannot be read; they differ in size, frame rate or, unless `cut`, length.
    """
    infos = {condition: probe(path) for condition, path in clips.items()}
    first, *others = infos.values()
    for info in others:
        for what, here, there in (
            ("pixels", _size(info), _size(first)),
            ("frames/s", f"{float(info.fps):g}", f"{float(first.fps):g}"),
            ("frames", str(info.frames), str(first.frames)),
        ):
            if here != there and not (cut and what == "frames"):
                remedy = " or add --cut" if what == "frames" else ""
                raise InputError(
                    f"{info.path}: has {here} {what}, but {first.path} has {there}; "
                    f"make the clips of a sentence alike{remedy}"
                )
    return Sentence(sentence, infos, min(info.frames for info in infos.values()))


def _size(info: VideoInfo) -> str:
    return f"{info.width} x {info.height}"


def write_clips(folder: Path, sentence: Sentence, *, real: str, mute: bool) -> list[StudyClip]:
    """Write every clip of a sentence, and its real one with the picture frozen; what was written.

    real: the condition whose sound all of them get, unless `mute`.

    Raises:
        InputError: A clip cannot be decoded; the real one has no sound, or of another length.
    """
    sound = None if mute else _sound(sentence, real)
    written = []
    for condition in (*sentence.clips, None):
        clip = StudyClip(secrets.token_hex(8), sentence.name, condition)
        info = sentence.clips[real if condition is None else condition]
        frames = _frames(info, sentence.frames, frozen=condition is None)
        write_video(_file(folder, clip), frames, fps=info.fps, sound=sound)
        written.append(clip)
    _equalise([_file(folder, clip) for clip in written])
    return written


def _file(folder: Path, clip: StudyClip) -> Path:
    return folder / f"{clip.name}.mp4"


def _sound(sentence: Sentence, real: str) -> Sound:
    """The sound of the real clip, exactly as long as the frames that are shown."""
    info = sentence.clips[real]
    if not info.has_sound:
        raise InputError(f"{info.path}: has no sound; give a clip with sound, or add --mute")
    samples, rate = read_sound(info.path)
    check_sync(info, (samples, rate))
    wanted = round(sentence.frames / info.fps * rate)
    return np.pad(samples, (0, max(0, wanted - len(samples))))[:wanted], rate


def _frames(info: VideoInfo, number: int, *, frozen: bool) -> Iterator[NDArray[np.uint8]]:
    """The first `number` frames, or, frozen, the middle one as often; of even width and height.

    An odd picture gets one more column or row: most browsers show only 4:2:0.
    """
    middle = number // 2
    start, stop = (middle, middle + 1) if frozen else (0, number)
    margin = ((0, info.height % 2), (0, info.width % 2), (0, 0))
    for frame in read_frames(info.path, start=start, stop=stop):
        yield from repeat(np.pad(frame, margin, mode="edge"), number if frozen else 1)


def _equalise(files: Sequence[Path]) -> None:
    """Make the files one length in bytes and one age: none says how much there was to encode."""
    length = max(file.stat().st_size for file in files) + _BOX
    for file in files:
        box = length - file.stat().st_size
        with file.open("ab") as end:
            end.write(box.to_bytes(4, "big") + b"free" + bytes(box - _BOX))
        os.utime(file, (0, 0))
