"""Marking corresponding points: what is proposed, what is marked so far, and what it does.

The paper marks 38 points about the mouth by hand (CE05, Fig. 2a). Here a template of 38, in mouth
widths from the middle of the mouth, is carried to the mouth of either frame as a first proposal,
and a person moves the points where they belong. `mmmgpu.marking_server` shows the page for it.
"""

import json
import os
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.files import write_json
from mmmgpu.points import (
    CLOSED,
    KINDS,
    MOST,
    FrameMark,
    MarkedPoint,
    PointPair,
    check_frames,
    mark_of,
    pair_points,
    parse_point,
    read_points,
    write_points,
)

if TYPE_CHECKING:
    from mmmgpu.reference_pairs import ShownFrame

Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]
Frames = Mapping[str, "tuple[ShownFrame, ShownFrame]"]  # A's and B's, of each kind

# Name; row among the landmarks of mmmgpu/landmarks.py; (x, y) with the mouth closed, and open, in
# mouth widths from the middle between the corners. Means over the trackers' points of a dozen
# speakers. Right is the person's, so it comes first. No two points meet when the lips do.
_TABLE = (
    ("nose_1", 71, -0.41, -0.75, -0.41, -0.80),
    ("nose_2", 69, -0.37, -0.53, -0.37, -0.58),
    ("nose_3", 68, 0.00, -0.48, 0.00, -0.54),
    ("nose_4", 70, 0.37, -0.53, 0.37, -0.58),
    ("nose_5", 72, 0.41, -0.75, 0.41, -0.80),
    ("outer_lip_1", 0, -0.50, 0.00, -0.50, 0.00),
    ("outer_lip_2", 2, -0.38, 0.10, -0.40, 0.22),
    ("outer_lip_3", 4, -0.15, 0.21, -0.17, 0.42),
    ("outer_lip_4", 5, 0.00, 0.23, 0.00, 0.45),
    ("outer_lip_5", 6, 0.15, 0.21, 0.17, 0.42),
    ("outer_lip_6", 8, 0.38, 0.10, 0.40, 0.22),
    ("outer_lip_7", 10, 0.50, 0.00, 0.50, 0.00),
    ("outer_lip_8", 12, 0.38, -0.06, 0.40, -0.13),
    ("outer_lip_9", 14, 0.15, -0.13, 0.16, -0.24),
    ("outer_lip_10", 15, 0.00, -0.10, 0.00, -0.21),
    ("outer_lip_11", 16, -0.15, -0.13, -0.16, -0.24),
    ("outer_lip_12", 18, -0.38, -0.06, -0.40, -0.13),
    ("inner_lip_1", 20, -0.45, 0.00, -0.45, 0.00),
    ("inner_lip_2", 23, -0.23, 0.02, -0.24, 0.17),
    ("inner_lip_3", 25, 0.00, 0.03, 0.00, 0.22),
    ("inner_lip_4", 27, 0.23, 0.02, 0.24, 0.17),
    ("inner_lip_5", 30, 0.45, 0.00, 0.45, 0.00),
    ("inner_lip_6", 34, 0.12, 0.01, 0.13, -0.09),
    ("inner_lip_7", 36, -0.12, 0.01, -0.13, -0.09),
    ("jaw_1", 42, -1.33, -0.41, -1.32, -0.42),
    ("jaw_2", 44, -1.11, 0.23, -1.08, 0.23),
    ("jaw_3", 46, -0.78, 0.62, -0.78, 0.62),
    ("jaw_4", 48, -0.46, 0.85, -0.46, 0.88),
    ("jaw_5", 50, 0.00, 0.95, 0.00, 1.01),
    ("jaw_6", 52, 0.46, 0.85, 0.46, 0.88),
    ("jaw_7", 54, 0.78, 0.62, 0.78, 0.62),
    ("jaw_8", 56, 1.11, 0.23, 1.08, 0.23),
    ("jaw_9", 58, 1.33, -0.41, 1.32, -0.42),
    ("cheek_1", 87, -0.99, -0.77, -0.98, -0.81),
    ("cheek_2", 88, 0.99, -0.77, 0.98, -0.81),
    ("cheek_3", 95, -0.67, -0.01, -0.67, -0.03),
    ("cheek_4", 96, 0.67, -0.01, 0.67, -0.03),
    ("chin", 102, 0.00, 0.54, 0.00, 0.64),
)
NAMES = tuple(str(row[0]) for row in _TABLE)
LANDMARK_ROWS = tuple(int(row[1]) for row in _TABLE)
"""Which landmarks (see `mmmgpu.landmarks`, `mmmgpu.performer.landmarks`) the 38 points are."""

PREVIEW_STEP = 2  # [px] the map of the preview is computed so often, linear between


def template(kind: str) -> Floats:
    """The 38 points, named `NAMES`, (x, y) in mouth widths from the middle of a mouth, (38, 2)."""
    first = 2 if kind == CLOSED else 4
    return np.array([row[first : first + 2] for row in _TABLE], np.float64)


def propose(kind: str, a: "ShownFrame", b: "ShownFrame") -> list[MarkedPoint]:
    """The template carried to the mouths in two frames; points outside a frame are left out."""
    points = []
    carried = [template(kind) * shown.mouth[2] + np.array(shown.mouth[:2]) for shown in (a, b)]
    for name, at_a, at_b in zip(NAMES, *(np.round(c, 2).tolist() for c in carried), strict=True):
        if _inside(at_a, a.picture) and _inside(at_b, b.picture):
            points.append(MarkedPoint(name, (at_a[0], at_a[1]), (at_b[0], at_b[1])))
    return points


def _inside(point: Sequence[float], picture: Picture) -> bool:
    height, width = picture.shape[:2]
    return bool(0 <= point[0] <= width - 1 and 0 <= point[1] <= height - 1)


@dataclass(frozen=True)
class Problem:
    """Why a pair cannot be saved; `point` is the name of the point at fault, or None."""

    text: str
    point: str | None = None


class Session:
    """What a person has marked so far, in two kinds of pairs; safe to use from several threads.

    A revision number goes up with every change, so that two pages cannot overwrite each other.
    """

    def __init__(self, out: str | os.PathLike[str], frames: Frames):
        """Begin with what was marked but not saved for `out`, else with what is in the file `out`
        if it exists, else with the proposals.

        frames: A's and B's frame for "closed", and for "open" if there are such.

        Raises:
            InputError: A file is there, but is none of points, or was marked in other frames.
        """
        self.out = Path(out)
        self.frames = frames
        self._lock = threading.RLock()
        self._marks = {kind: _marks(*shown) for kind, shown in frames.items()}
        self._points = {kind: propose(kind, *shown) for kind, shown in frames.items()}
        self._revision, self._saved_revision = 0, -1
        if self.draft.exists():
            self._points = _read_draft(self.draft, self._marks)
        elif self.out.exists():
            self._points = {kind: [] for kind in frames} | _read(self.out, frames)
            self._saved_revision = self._revision

    @property
    def draft(self) -> Path:
        """The file that keeps what is not saved, until it is."""
        return self.out.with_name(f"{self.out.name}.part")

    @property
    def saved(self) -> bool:
        """Whether the file holds what is marked."""
        return self._revision == self._saved_revision

    def describe(self) -> dict[str, Any]:
        """All that the page needs to know, but the pictures: JSON values."""
        with self._lock:
            pairs = [self._describe_pair(kind) for kind in KINDS if kind in self.frames]
            return {"out": str(self.out), **self._state(), "pairs": pairs}

    def replace(self, kind: str, points: Any, revision: Any) -> dict[str, Any]:
        """Put the JSON value `points` in place of those of one pair; the new state.

        Points may lack a side as long as they are not saved. Until then they are kept in `draft`.

        Raises:
            StaleError: `revision` is not the current one: another page has changed the points.
            InputError: `points` is no list of points; the draft cannot be written.
        """
        if not isinstance(points, list) or len(points) > MOST:
            raise InputError(f"points must be a list of at most {MOST}; mark fewer")
        found = [parse_point(p, i, f"the {kind} pair") for i, p in enumerate(points, start=1)]
        with self._lock:
            if revision != self._revision:
                raise StaleError("the points were changed in another window; reload this page")
            if found != self._points[kind]:
                changed = {**self._points, kind: found}
                write_json(self.draft, _draft_value(changed, self._marks))
                self._points, self._revision = changed, self._revision + 1
            return {**self._state(), "problems": self._problem_values(kind)}

    def problems(self, kind: str) -> list[Problem]:
        """Why the pair `kind` cannot be saved; empty if it can.

        An open pair without points can: it is left out.
        """
        with self._lock:
            points = self._points[kind]
        if not points and kind != CLOSED:
            return []
        unpaired = [p for p in points if p.a is None or p.b is None]
        if unpaired:
            return [Problem(_unpaired(p), p.name) for p in unpaired]
        try:
            self._pair(kind)
        except InputError as error:
            return [Problem(str(error).removeprefix(f"{self.out}: "))]
        return []

    def pair(self, kind: str) -> PointPair:
        """The points of one kind as a pair.

        Raises:
            InputError: They cannot be used yet.
        """
        with self._lock:
            return self._pair(kind)

    def save(self) -> dict[str, Any]:
        """Write the file; the new state.

        Raises:
            InputError: A pair has problems, or the file cannot be written. No file is changed.
        """
        with self._lock:
            pairs = [self._pair(k) for k in self.frames if self._points[k] or k == CLOSED]
            write_points(self.out, pairs)
            self._saved_revision = self._revision
            self.draft.unlink(missing_ok=True)
            return self._state()

    def _state(self) -> dict[str, Any]:
        return {"revision": self._revision, "saved": self.saved}

    def _pair(self, kind: str) -> PointPair:
        from mmmgpu.correspondence import rbf_correspondence

        pair = pair_points(kind, self._marks[kind], self._points[kind], self.out)
        try:
            rbf_correspondence(pair.points_a, pair.points_b)
        except InputError as error:
            raise InputError(f"{self.out}: the {kind} pair: {error}") from error
        return pair

    def _problem_values(self, kind: str) -> list[dict[str, Any]]:
        return [{"text": p.text, "point": p.point} for p in self.problems(kind)]

    def _describe_pair(self, kind: str) -> dict[str, Any]:
        sides = zip(("a", "b"), self._marks[kind], strict=True)
        frames = {s: {"clip": m.clip, "frame": m.frame, "size": list(m.size)} for s, m in sides}
        return {
            "kind": kind,
            **frames,
            "points": _values(self._points[kind]),
            "proposal": _values(propose(kind, *self.frames[kind])),
            "problems": self._problem_values(kind),
        }


class StaleError(Exception):
    """A change that was made to an older state than the current one."""


def _marks(a: "ShownFrame", b: "ShownFrame") -> tuple[FrameMark, FrameMark]:
    return mark_of(a.clip, a.frame, a.picture), mark_of(b.clip, b.frame, b.picture)


def _read(path: Path, frames: Frames) -> dict[str, list[MarkedPoint]]:
    """The points in the file `path`, which must have been marked in `frames`."""
    pairs = read_points(path)
    check_frames(pairs, {k: (a.picture, b.picture) for k, (a, b) in frames.items()}, path)
    found = {}
    for pair in pairs:
        rows = zip(pair.names, pair.points_a.tolist(), pair.points_b.tolist(), strict=True)
        found[pair.kind] = [MarkedPoint(name, (*a,), (*b,)) for name, a, b in rows]
    return found


def _draft_value(
    points: Mapping[str, Sequence[MarkedPoint]], marks: Mapping[str, tuple[FrameMark, FrameMark]]
) -> dict[str, Any]:
    return {
        "frames": _fingerprints(marks),
        "points": {kind: _values(some) for kind, some in points.items()},
    }


def _fingerprints(marks: Mapping[str, tuple[FrameMark, FrameMark]]) -> dict[str, list[str]]:
    return {kind: [a.fingerprint, b.fingerprint] for kind, (a, b) in marks.items()}


def _read_draft(
    path: Path, marks: Mapping[str, tuple[FrameMark, FrameMark]]
) -> dict[str, list[MarkedPoint]]:
    """The points that were marked in the same frames, but not saved."""
    try:
        draft = json.loads(path.read_text("utf-8"))
        same, points = draft["frames"] == _fingerprints(marks), draft["points"]
        found = {
            kind: [parse_point(p, i, str(path)) for i, p in enumerate(points[kind], start=1)]
            for kind in marks
        }
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({error}); remove this file") from error
    if not same:
        raise InputError(f"{path}: holds unsaved points of other frames; remove or rename it")
    return found


def _values(points: Sequence[MarkedPoint]) -> list[dict[str, Any]]:
    return [{"name": p.name, "a": p.a and list(p.a), "b": p.b and list(p.b)} for p in points]


def _unpaired(point: MarkedPoint) -> str:
    if point.a is None and point.b is None:
        return f"point {point.name!r} is marked nowhere: delete it"
    here, there = ("B", "A") if point.a is None else ("A", "B")
    return f"point {point.name!r} is unpaired: only in {here}, not in {there}; pair it or delete it"


def warped_onto(pair: PointPair, picture_a: Picture) -> Picture:
    """A's picture carried onto B's frame by the correspondence of `pair`, uint8 (H_b, W_b, 3).

    Every pixel q of B shows A at the p with S(p) = q (Eq. 6). What A does not show is black.
    """
    import cv2

    from mmmgpu.correspondence import rbf_correspondence

    width, height = pair.b.size
    rows, columns = np.mgrid[
        0 : height + PREVIEW_STEP : PREVIEW_STEP, 0 : width + PREVIEW_STEP : PREVIEW_STEP
    ]
    grid = np.stack([columns, rows], axis=-1).astype(np.float64)
    coarse = rbf_correspondence(pair.points_a, pair.points_b).inverse(grid)
    scale = np.array([[1 / PREVIEW_STEP, 0, 0], [0, 1 / PREVIEW_STEP, 0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    fine = cv2.warpAffine(coarse.astype(np.float32), scale, (width, height), flags=flags)
    return np.asarray(cv2.remap(picture_a, fine[..., 0], fine[..., 1], cv2.INTER_LINEAR), np.uint8)


def folded_points(pair: PointPair) -> list[str]:
    """Names of the points next to which the correspondence folds over; none if it is one to one."""
    from mmmgpu.correspondence import rbf_correspondence

    folds = rbf_correspondence(pair.points_a, pair.points_b).folds(*pair.a.size)
    pixels = np.argwhere(folds)[:, ::-1]
    distance = np.linalg.norm(pixels[:, None] - pair.points_a[None], axis=-1)
    nearest = set(distance.argmin(axis=1).tolist()) if len(pixels) else set()
    return [pair.names[i] for i in sorted(nearest)]
