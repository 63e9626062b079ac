"""The frames of tracked clips as one numbered row, or in stretches, one for a process at a time."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmmgpu.corpora import Clip
from mmmgpu.errors import InputError
from mmmgpu.regions import Region
from mmmgpu.tracks import Track, crop, crops, rebase
from mmmgpu.videos import read_chosen_frames

Floats = NDArray[np.float64]
F32 = NDArray[np.float32]

STRETCHES = 8  # at least, of a corpus: to decode up to one costs little beside analysing it


@dataclass(frozen=True)
class Stretch:
    """The frames start <= t < stop of a tracked clip."""

    clip: Clip
    track: Track
    start: int
    stop: int

    @property
    def name(self) -> str:
        return f"{self.clip.name}-{self.start}"

    @property
    def length(self) -> int:
        return self.stop - self.start

    @property
    def registered(self) -> NDArray[np.bool_]:
        return self.track.registered[self.start : self.stop]

    def crops(self, region: Region) -> Iterator[F32]:
        """The region of each frame, (h, w, 3)."""
        return crops(self.clip.path, self.track, region, start=self.start, stop=self.stop)


@dataclass(frozen=True)
class Pictures:
    """Some pictures (n, h, w, 3) of a region, to be seen as if they were frames."""

    name: str
    images: F32

    @property
    def length(self) -> int:
        return len(self.images)

    def crops(self, region: Region) -> Iterator[F32]:
        """The pictures, which are of `region`."""
        assert self.images.shape[1:3] == region.shape
        return iter(self.images)


@dataclass(frozen=True)
class Frames:
    """The frames of all used clips as one numbered row."""

    clips: Sequence[Clip]
    tracks: Mapping[str, Track]

    def __len__(self) -> int:
        return sum(clip.length for clip in self.clips)

    @property
    def registered(self) -> NDArray[np.bool_]:
        return np.concatenate([self.tracks[c.name].registered for c in self.clips])

    def find(self, i: int) -> tuple[Clip, int]:
        """The clip and its frame that are number `i` of the row."""
        for clip in self.clips:
            if i < clip.length:
                return clip, i
            i -= clip.length
        raise IndexError(i)

    @property
    def stretches(self) -> list[Stretch]:
        """All frames in order."""
        return [stretch for clip in self.clips for stretch in self.stretches_of(clip)]

    def stretches_of(self, clip: Clip) -> list[Stretch]:
        """The frames of `clip`; few clips are cut, so that all processes end at the same time."""
        parts = min(clip.length, -(-STRETCHES // len(self.clips)))
        ends = [clip.length * part // parts for part in range(parts + 1)]
        track = self.tracks[clip.name]
        return [Stretch(clip, track, *ends[part : part + 2]) for part in range(parts)]

    def by_clip(self, rows: Floats) -> list[Floats]:
        """Rows of all frames, and others behind them, (N, d) -> (T, d) of every clip."""
        return np.split(rows, np.cumsum([clip.length for clip in self.clips]))[:-1]

    def pictures(
        self, numbers: Iterable[int]
    ) -> tuple[NDArray[np.uint8], tuple[tuple[str, int], ...]]:
        """Some frames in full, (n, H, W, 3), and the clip name and frame number of each."""
        wanted = [int(i) for i in numbers]
        found = {i: (frame, (clip.name, t)) for i, clip, t, frame in self._read(wanted)}
        whole, places = zip(*(found[i] for i in wanted), strict=True)
        return np.stack(whole), places

    def number(self, name: str, t: int) -> int:
        """The number in the row of frame `t` of the clip called `name`."""
        before = 0
        for clip in self.clips:
            if clip.name == name:
                return before + t
            before += clip.length
        raise KeyError(name)

    def crops(self, numbers: Iterable[int], region: Region) -> dict[int, F32]:
        """The regions of some frames, by number, rising."""
        return {
            i: crop(frame, self.tracks[clip.name].poses[t], self.tracks[clip.name], region)
            for i, clip, t, frame in self._read(numbers)
        }

    def _read(self, numbers: Iterable[int]) -> Iterator[tuple[int, Clip, int, NDArray[np.uint8]]]:
        """Some frames in full, rising, with number, clip and place in it; a clip is read once."""
        wanted = np.unique(np.fromiter(numbers, np.int64))
        first = 0
        for clip in self.clips:
            own = wanted[(first <= wanted) & (wanted < first + clip.length)] - first
            if len(own):
                for t, frame in zip(own.tolist(), read_chosen_frames(clip.path, own), strict=True):
                    yield first + t, clip, t, frame
            first += clip.length


def rebased_frames(frames: Frames, name: str, t: int) -> Frames:
    """`frames` as frame `t` of the clip called `name` sees them: its pose is the identity.

    Its gain becomes 1 and its offset 0.

    Raises:
        InputError: That clip was not tracked.
    """
    tracks = frames.tracks
    if name not in tracks:
        raise InputError(f"{name}: holds the reference frame, but its head was not found there")
    first = tracks[name]
    pose = first.poses[t]
    rebased = {n: rebase(track, pose, first.gain, first.offset) for n, track in tracks.items()}
    return Frames(frames.clips, rebased)
