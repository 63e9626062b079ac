"""Corresponding points of two persons' reference frames, and their files: POINTS.

A file names the frames in which the points were marked, with a fingerprint of their pixels, so that
points are never used with other frames. It may come from `mmmgpu mark` or from any other tool; all
of it is checked when it is read. The schema is in docs/points.md. Points are (x, y) [px] in the
frames as filmed, not stabilised; centres of pixels lie at whole numbers.
"""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.files import write_json

Floats = NDArray[np.float64]
Place = str | os.PathLike[str]

FORMAT, VERSION = "mmmgpu-points", 1
CLOSED, OPEN = KINDS = ("closed", "open")  # what the mouth does in a pair of frames
SIDES = ("a", "b")  # the person with a model, the new person
FEWEST, MOST = 3, 1000  # points of a pair
APART = 0.1  # [px] two points that are closer are one and the same
LONGEST_NAME = 60  # letters
STRAIGHT = 0.5  # [px] points within so much of one line determine no affine map


@dataclass(frozen=True)
class FrameMark:
    """Which frame was marked.

    clip, frame: file name of the clip and number of the frame in it.
    fingerprint: of its pixels, by `fingerprint_frame`.
    size: (width, height) [px].
    """

    clip: str
    frame: int
    fingerprint: str
    size: tuple[int, int]


@dataclass(frozen=True)
class MarkedPoint:
    """One point (x, y) [px] in the frame of A and of B; None where it is not marked yet."""

    name: str
    a: tuple[float, float] | None
    b: tuple[float, float] | None


@dataclass(frozen=True)
class PointPair:
    """Corresponding points of two frames.

    kind: "closed" or "open", as the mouths in the frames are.
    a, b: the frame of the person with a model, and that of the new person.
    names: one a point, length N.
    points_a, points_b: (x, y) [px], shape (N, 2).
    """

    kind: str
    a: FrameMark
    b: FrameMark
    names: tuple[str, ...]
    points_a: Floats
    points_b: Floats


def fingerprint_frame(frame: NDArray[np.uint8]) -> str:
    """SHA-256 of the size and pixels of a frame (H, W, 3), the first 32 hexadecimal digits."""
    height, width = frame.shape[:2]
    digest = hashlib.sha256(f"{width}x{height}:".encode())
    digest.update(np.ascontiguousarray(frame).tobytes())
    return digest.hexdigest()[:32]


def mark_of(clip: str, frame: int, picture: NDArray[np.uint8]) -> FrameMark:
    """The mark of frame `frame` of `clip`, which shows `picture` (H, W, 3)."""
    size = (picture.shape[1], picture.shape[0])
    return FrameMark(clip, frame, fingerprint_frame(picture), size)


def read_points(path: Place) -> tuple[PointPair, ...]:
    """Read a POINTS file: its closed pair, then its open pair if there is one.

    Raises:
        InputError: It cannot be read, is of another format or newer, or holds what `check_pair`
            refuses.
    """
    pairs = [parse_pair(value, path) for value in _pairs(_load(path), path)]
    return tuple(_require_kinds(pairs, path))


def write_points(path: Place, pairs: Sequence[PointPair]) -> None:
    """Write pairs as a POINTS file.

    Raises:
        InputError: The pairs are such as `read_points` would refuse; the file cannot be written.
    """
    for pair in pairs:
        check_pair(pair, path)
    values = [_pair_value(pair) for pair in _require_kinds(pairs, path)]
    write_json(path, {"format": FORMAT, "version": VERSION, "pairs": values})


def check_frames(
    pairs: Sequence[PointPair],
    pictures: Mapping[str, tuple[NDArray[np.uint8], NDArray[np.uint8]]],
    path: Place,
) -> None:
    """Make sure that `pairs`, read from `path`, were marked in these pictures.

    pictures: of each kind of pair, A's and B's frame, (H, W, 3).

    Raises:
        InputError: Of the first frame that has another size or other pixels.
    """
    for pair in pairs:
        for side, mark, picture in zip(SIDES, (pair.a, pair.b), pictures[pair.kind], strict=True):
            here = mark_of(mark.clip, mark.frame, picture)
            where = f"{path}: the {pair.kind} pair, side {side}"
            if here.size != mark.size:
                raise InputError(
                    f"{where}: marked in a frame of {_by(mark.size)} pixels, this one ({mark.clip},"
                    f" frame {mark.frame}) has {_by(here.size)}; {_MARK_AGAIN}"
                )
            if here.fingerprint != mark.fingerprint:
                raise InputError(
                    f"{where}: marked in another picture than {mark.clip}, frame {mark.frame} "
                    f"shows here (its fingerprint differs); {_MARK_AGAIN}"
                )


_MARK_AGAIN = "use the model and clips it was made for, or mark again: mmmgpu mark"


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def check_pair(pair: PointPair, path: Place) -> None:
    """Make sure that the points of `pair` can be used; `path` is named if they cannot.

    Raises:
        InputError: Fewer than three points, or absurdly many; two of one name; on either side a
            point outside the picture, two in one place, all on one line, or one that is not finite.
    """
    where, count = f"{path}: the {pair.kind} pair", len(pair.names)
    if count < FEWEST:
        raise InputError(f"{where}: has {count} points, at least {FEWEST} are needed; mark more")
    if count > MOST:
        raise InputError(f"{where}: has {count} points, at most {MOST} can be used; leave some out")
    name, times = Counter(pair.names).most_common(1)[0]
    if times > 1:
        raise InputError(f"{where}: {times} points are named {name!r}; rename all but one")
    for side, mark, points in zip(
        SIDES, (pair.a, pair.b), (pair.points_a, pair.points_b), strict=True
    ):
        _check_side(points, mark, pair.names, f"{where}, side {side}")


def _check_side(points: Floats, mark: FrameMark, names: Sequence[str], where: str) -> None:
    size = np.array(mark.size)
    for name, point in zip(names, points, strict=True):
        if not np.isfinite(point).all():
            raise InputError(f"{where}: point {name!r} is not finite; mark it again")
        if (point < 0).any() or (point > size - 1).any():
            raise InputError(
                f"{where}: point {name!r} at ({point[0]:g}, {point[1]:g}) is outside the picture "
                f"of {_by(mark.size)} pixels; move it inside"
            )
    distance = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    near = np.argwhere(np.triu(distance < APART, k=1))
    if near.size:
        one, other = (names[i] for i in near[0])
        raise InputError(
            f"{where}: points {one!r} and {other!r} are duplicates, in one place; "
            "move or delete one"
        )
    if _spread_across(points) <= STRAIGHT:
        raise InputError(f"{where}: all points lie on one line; mark one beside it")


def _spread_across(points: Floats) -> float:
    """Largest distance [px] of the points (N, 2) from the line that fits them best."""
    centred = points - points.mean(axis=0)
    across = np.linalg.svd(centred, full_matrices=False)[2][1]
    return float(np.abs(centred @ across).max())


def _require_kinds(pairs: Sequence[PointPair], path: Place) -> list[PointPair]:
    """The pairs, closed first; one of them at least, and none twice."""
    kinds = [pair.kind for pair in pairs]
    if CLOSED not in kinds:
        raise InputError(f"{path}: has no closed pair; mark the frames with the mouth closed")
    for kind in KINDS:
        if kinds.count(kind) > 1:
            raise InputError(f"{path}: has more than one {kind} pair; keep one of them")
    return sorted(pairs, key=lambda pair: KINDS.index(pair.kind))


def _load(path: Place) -> Any:
    try:
        return json.loads(Path(path).read_text("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: is not JSON ({reason}); give a file of mmmgpu mark") from error


def _pairs(value: Any, path: Place) -> list[Any]:
    """The pairs of a whole file."""
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise InputError(f"{path}: is no file of points ({FORMAT}); give one of mmmgpu mark")
    version = value.get("version")
    if type(version) is not int or version < 1:
        raise InputError(f"{path}: version must be {VERSION}, is {version!r}; correct it")
    if version > VERSION:
        raise InputError(
            f"{path}: is of version {version}, newer than this mmmgpu reads ({VERSION}); "
            "update mmmgpu"
        )
    pairs = value.get("pairs")
    if not isinstance(pairs, list):
        raise InputError(f"{path}: pairs must be a list, is {_short(pairs)}; correct it")
    return pairs


def parse_pair(value: Any, path: Place) -> PointPair:
    """The pair that JSON `value` describes, checked; errors name `path`.

    Raises:
        InputError: It describes none, or one that cannot be used.
    """
    if not isinstance(value, dict) or value.get("kind") not in KINDS:
        kind = value.get("kind") if isinstance(value, dict) else value
        raise InputError(f"{path}: kind of a pair must be closed or open, is {_short(kind)}")
    kind = value["kind"]
    where = f"{path}: the {kind} pair"
    a, b = (_parse_mark(value.get(side), f"{where}, {side}") for side in SIDES)
    points = value.get("points")
    if not isinstance(points, list):
        raise InputError(f"{where}: points must be a list, is {_short(points)}; correct it")
    found = [parse_point(point, i, where) for i, point in enumerate(points, start=1)]
    return pair_points(kind, (a, b), found, path)


def pair_points(
    kind: str, marks: tuple[FrameMark, FrameMark], points: Sequence[MarkedPoint], path: Place
) -> PointPair:
    """`points`, marked in the frames `marks` of A and B, as a pair, checked.

    Raises:
        InputError: A point lacks one side, or `check_pair` refuses the pair; `path` is named.
    """
    for point in points:
        if point.a is None or point.b is None:
            raise InputError(
                f"{path}: the {kind} pair: point {point.name!r} is unpaired: it has no "
                f"{'a' if point.a is None else 'b'}; mark it there too or delete it"
            )
    names = tuple(point.name for point in points)
    points_a = np.array([point.a for point in points], np.float64).reshape(-1, 2)
    points_b = np.array([point.b for point in points], np.float64).reshape(-1, 2)
    pair = PointPair(kind, *marks, names, points_a, points_b)
    check_pair(pair, path)
    return pair


def _parse_mark(value: Any, where: str) -> FrameMark:
    if not isinstance(value, dict):
        raise InputError(f"{where}: must say which frame was marked, is {_short(value)}")
    clip, frame, fingerprint = (value.get(key) for key in ("clip", "frame", "fingerprint"))
    size = value.get("size")
    if not isinstance(clip, str) or not clip:
        raise InputError(f"{where}: clip must be the name of a clip, is {_short(clip)}; correct it")
    if type(frame) is not int or frame < 0:
        raise InputError(f"{where}: frame must be a number >= 0, is {_short(frame)}; correct it")
    if not isinstance(fingerprint, str) or not fingerprint:
        raise InputError(
            f"{where}: fingerprint must be that of the frame, is {_short(fingerprint)}; correct it"
        )
    if not (isinstance(size, list) and len(size) == 2 and all(_is_size(n) for n in size)):
        raise InputError(f"{where}: size must be [width, height], is {_short(size)}; correct it")
    return FrameMark(clip, frame, fingerprint, (size[0], size[1]))


def _is_size(value: Any) -> bool:
    return type(value) is int and value >= 1


def parse_point(value: Any, number: int, where: str) -> MarkedPoint:
    """The point that JSON `value` describes, the `number`-th; a side that it lacks is None.

    Raises:
        InputError: It describes none; begins with `where`.
    """
    name = value.get("name") if isinstance(value, dict) else None
    if not isinstance(name, str) or not name.isprintable() or not 1 <= len(name) <= LONGEST_NAME:
        raise InputError(
            f"{where}: point {number} must have a name of 1 to {LONGEST_NAME} letters; give it one"
        )
    here = f"{where}: point {name!r}"
    a, b = (_coordinates(value.get(side), f"{here}, {side}") for side in SIDES)
    return MarkedPoint(name, a, b)


def _coordinates(value: Any, where: str) -> tuple[float, float] | None:
    """[x, y] as finite floats; None stays None."""
    if value is None:
        return None
    fits = isinstance(value, list) and len(value) == 2
    if not fits or not all(type(number) in (int, float) for number in value):
        raise InputError(f"{where}: must be two numbers [x, y], is {_short(value)}; correct it")
    try:
        x, y = (float(number) for number in value)
    except OverflowError:
        x = y = np.inf
    if not np.isfinite([x, y]).all():
        raise InputError(f"{where}: must be finite, is {_short(value)}; mark it again")
    return x, y


def _short(value: Any) -> str:
    """A value as an error names it, on one line and not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else f"{text[:37]}..."


def _mark_value(mark: FrameMark) -> dict[str, Any]:
    return {
        "clip": mark.clip,
        "frame": mark.frame,
        "fingerprint": mark.fingerprint,
        "size": list(mark.size),
    }


def _pair_value(pair: PointPair) -> dict[str, Any]:
    points = zip(pair.names, pair.points_a.tolist(), pair.points_b.tolist(), strict=True)
    return {
        "kind": pair.kind,
        "a": _mark_value(pair.a),
        "b": _mark_value(pair.b),
        "points": [{"name": name, "a": a, "b": b} for name, a, b in points],
    }
