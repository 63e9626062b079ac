"""The frames of tracked clips as one numbered row, or in stretches, one for a process at a time."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mmmgpu.backends import default_threads
from mmmgpu.corpora import Clip
from mmmgpu.errors import InputError
from mmmgpu.parallel import Cancelled, CancelledError, map_ordered
from mmmgpu.regions import Region
from mmmgpu.tracks import Track, crop, crops, rebase
from mmmgpu.videos import read_chosen_frames

F32 = NDArray[np.float32]
S = TypeVar("S", bound=np.generic)
T = TypeVar("T")

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
    def _ends(self) -> NDArray[np.int64]:
        """The numbers behind the last frame of each clip."""
        return np.cumsum([clip.length for clip in self.clips])

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

    def by_clip(self, rows: NDArray[S]) -> list[NDArray[S]]:
        """Rows of all frames, and others behind them, (N, d) -> (T, d) of every clip."""
        return np.split(rows, self._ends)[:-1]

    def pictures(
        self, numbers: Iterable[int]
    ) -> tuple[NDArray[np.uint8], tuple[tuple[str, int], ...]]:
        """Some frames in full, (n, H, W, 3), and the clip name and frame number of each."""
        wanted = [int(i) for i in numbers]
        found = self._read(wanted, lambda frame, clip, t: (frame, (clip.name, t)))
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

        def take(frame: NDArray[np.uint8], clip: Clip, t: int) -> F32:
            track = self.tracks[clip.name]
            return crop(frame, track.poses[t], track, region)

        return self._read(numbers, take)

    def _read(
        self, numbers: Iterable[int], take: Callable[[NDArray[np.uint8], Clip, int], T]
    ) -> dict[int, T]:
        """What is taken of some frames, by number, rising; a clip is read once, some at a time.

        take: Given a frame in full, its clip and its place in it.
        """
        wanted = np.unique(np.fromiter(numbers, np.int64))
        ends = self._ends
        parts = np.split(wanted, np.searchsorted(wanted, ends))[:-1]
        jobs = [job for job in zip(self.clips, ends, parts, strict=True) if len(job[2])]

        def read(job: tuple[Clip, int, NDArray[np.int64]], cancelled: Cancelled) -> list[T]:
            clip, end, own = job
            places, taken = own - (end - clip.length), []
            for t, frame in zip(places, read_chosen_frames(clip.path, places), strict=True):
                if cancelled():
                    raise CancelledError
                taken.append(take(frame, clip, int(t)))
            return taken

        found = map_ordered(read, jobs, threads=default_threads())
        return dict(zip(wanted.tolist(), chain.from_iterable(found), strict=True))


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
