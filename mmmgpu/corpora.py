"""The clips of one person with what is said in them, checked before any long work begins."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mmmgpu.alignments import (
    Alignment,
    check_against,
    find_alignment,
    frame_labels,
    read_alignment,
    shift,
)
from mmmgpu.errors import InputError
from mmmgpu.sounds import check_sync, read_sound
from mmmgpu.videos import VideoInfo, probe


@dataclass(frozen=True)
class Clip:
    """One clip of a corpus and its alignment, already moved by ``--sync``."""

    path: Path
    info: VideoInfo
    alignment: Alignment

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def length(self) -> int:
        """The number of frames."""
        return self.info.frames

    @property
    def labels(self) -> list[str]:
        """The majority phone of every frame."""
        return frame_labels(self.alignment, self.info.frames, float(self.info.fps))


def open_corpus(paths: Sequence[Path], alignments: Path, *, sync: float = 0.0) -> list[Clip]:
    """Look at every clip and its alignment.

    Args:
        paths: Video files of one person, with different names before the suffix, of one size.
        alignments: Folder with a TextGrid, .align or .lab for every clip, or one such file.
        sync: [s] by which sound and alignment are moved against the picture; negative: earlier.

    Raises:
        InputError: Of the first file that cannot be used.
    """
    check_names(paths)
    corpus = [_open_clip(path, alignments, sync) for path in paths]
    for clip in corpus[1:]:
        _check_size(corpus[0].info, clip.info)
    return corpus


def check_names(clips: Sequence[Path]) -> None:
    """Raise InputError unless there are clips, with different names before the suffix.

    By these what belongs to a clip is found: alignments, landmarks, results.
    """
    if not clips:
        raise InputError("no clip given; name at least one video file")
    names = [clip.stem for clip in clips]
    for i, clip in enumerate(clips):
        if clip.stem in names[:i]:
            raise InputError(f"{clip}: two clips are called {clip.stem}; rename one of them")


def _check_size(first: VideoInfo, other: VideoInfo) -> None:
    if (other.width, other.height) != (first.width, first.height):
        raise InputError(
            f"{other.path}: is {other.width} x {other.height}, {first.path} is "
            f"{first.width} x {first.height}; give clips of one size"
        )


def _open_clip(path: Path, alignments: Path, sync: float) -> Clip:
    info = probe(path, minimum_frames=2)
    if info.has_sound:
        check_sync(info, read_sound(path))
    found = find_alignment(alignments, path)
    alignment = read_alignment(found)
    check_against(alignment, info.duration, found)
    return Clip(path, info, shift(alignment, sync) if sync else alignment)


def check_rates(corpus: Sequence[Clip]) -> None:
    """All clips have one frame rate.

    Raises:
        InputError: Of the first clip that has another.
    """
    rate = corpus[0].info.fps
    for clip in corpus:
        if abs(clip.info.fps / rate - 1) > 0.001:
            raise InputError(
                f"{clip.path}: has {float(clip.info.fps):g} frames/s but {corpus[0].name} "
                f"{float(rate):g}; convert the clips to one rate"
            )
