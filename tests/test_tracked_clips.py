from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mmmgpu.tracked_clips import kept_tracks, known_tracks
from mmmgpu.tracks import Track


@dataclass(frozen=True)
class File:
    path: Path
    length: int

    @property
    def name(self):
        return self.path.name


def file(path, content, *, length=1):
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    return File(path, length)


def test_clips_are_known_by_name_and_content(tmp_path):
    track = Track(np.eye(3)[None], np.ones(1, bool), np.ones(1), np.ones(3), np.zeros(3), 0.1)
    same, changed, gone = (file(tmp_path / n, n.encode() * 999_999) for n in ("a", "b", "c"))
    kept = kept_tracks([same, changed, gone], dict.fromkeys("abc", track))
    assert list(kept) == ["a", "b", "c"]
    moved = file(tmp_path / "elsewhere" / "a", b"a" * 999_999)
    now = file(tmp_path / "b", b"b" * 999_998 + b".")
    renamed = file(tmp_path / "d", b"c" * 999_999)
    assert known_tracks([moved, now, renamed], kept) == {"a": track}
    assert known_tracks([same, gone], kept) == {"a": track, "c": track}
    assert known_tracks([same], {}) == {}
    longer = file(tmp_path / "a", b"a" * 999_999, length=2)
    assert known_tracks([longer, gone], kept) == {"c": track}
