"""Clips that a model remembers the tracks of: met again, they need not be tracked again."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mmmgpu.corpora import Clip
from mmmgpu.tracks import Track

BLOCK = 1 << 20  # bytes of a file read at a time


@dataclass(frozen=True)
class TrackedClip:
    """How the model's reference saw a clip.

    sha256: of its file, hexadecimal.
    """

    sha256: str
    track: Track


def kept_tracks(clips: Sequence[Clip], tracks: Mapping[str, Track]) -> dict[str, TrackedClip]:
    """What a model keeps of `clips`, by name; `tracks` by name too."""
    return {c.name: TrackedClip(_digest(c.path), tracks[c.name]) for c in clips}


def known_tracks(clips: Sequence[Clip], kept: Mapping[str, TrackedClip]) -> dict[str, Track]:
    """The tracks of those of `clips` that are `kept` under their names, and still the same."""

    def is_same(clip: Clip, old: TrackedClip) -> bool:
        """Also read as so many frames, which is a matter of versions."""
        return old.sha256 == _digest(clip.path) and len(old.track) == clip.length

    met = [c for c in clips if c.name in kept and is_same(c, kept[c.name])]
    return {c.name: kept[c.name].track for c in met}


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            digest.update(block)
    return digest.hexdigest()
