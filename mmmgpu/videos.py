"""Read video: what a clip is, and its frames one at a time, upright and at a constant rate.

The clock of a clip is its constant frame rate. A clip with a steady clock is passed on frame for
frame; one with a variable rate (phones, screen recorders) is resampled to the nearest frame in
time. Frames keep the coded size: pixels that the file declares to be non-square are not stretched,
because models, landmarks and regions are counted in coded pixels.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.sidedata.sidedata import Type as SideDataType
from av.video.frame import VideoFrame
from av.video.reformatter import Colorspace, Interpolation, VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import ArrayLike, NDArray

from .errors import InputError

VIDEO_SUFFIXES = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ts", ".webm", ".wmv"}
STANDARD_RATES = (
    *(Fraction(1000 * n, 1001) for n in (24, 30, 60)),
    *(Fraction(n) for n in (10, 12, 15, 24, 25, 30, 50, 60, 100, 120)),
)
_STEADY = 0.25  # of a frame: a clock that strays no further from constant is taken as constant
_LONGEST_GAP_S = 10.0  # between two frames; more is a broken clock, not a variable rate
# libswscale's flags for unbiased rounding and chroma at full width (av < 18 does not name them)
ACCURATE_ROUNDING, FULL_CHROMA_OUT, FULL_CHROMA_IN = 0x40000, 0x2000, 0x4000
_EXACT = int(Interpolation.BILINEAR) | ACCURATE_ROUNDING | FULL_CHROMA_OUT
_UNSPECIFIED = 2  # AVCOL_SPC_UNSPECIFIED
_COMPLETE = "copy or download it again"


@dataclass(frozen=True)
class VideoInfo:
    """A clip as `read_frames` delivers it: upright, `frames` frames at the constant rate `fps`.

    `width` and `height` are in pixels, `duration` = frames / fps in seconds.
    """

    path: Path
    width: int
    height: int
    fps: Fraction
    frames: int
    duration: float
    has_sound: bool


@dataclass(frozen=True)
class _Scan:
    """What one pass over the packets tells, and the first frame."""

    first: VideoFrame
    matrix: tuple[int, int, int, int]  # (a, b, c, d) of the display matrix
    fps: Fraction
    repeats: NDArray[np.int64]  # (source frames,): how often each one is shown
    last_key: int | None  # decoding timestamp of the last key frame
    has_sound: bool


@contextmanager
def open_media(path: str | os.PathLike[str]) -> Iterator[InputContainer]:
    """Open a file for decoding; whatever FFmpeg cannot read becomes an InputError."""
    file = Path(path)
    if not file.exists():
        raise InputError(f"{file}: no such file; check the path")
    if file.is_dir():
        raise InputError(f"{file}: is a folder; give a video or sound file")
    if file.is_file() and file.stat().st_size == 0:
        raise InputError(f"{file}: is empty; {_COMPLETE}")
    try:
        # "file:" so that no name is taken for a protocol; the list keeps playlists off the network
        with av.open(f"file:{file.absolute()}", options={"protocol_whitelist": "file"}) as media:
            if media.format.name == "tty":
                raise InputError(f"{file}: is text, not video or sound; give another file")
            yield media
    except av.FFmpegError as error:
        raise InputError(
            f"{file}: not a readable video or sound file, or a truncated one "
            f"({error.strerror or type(error).__name__}); play it to check, or {_COMPLETE}"
        ) from error


def video_stream(media: InputContainer, path: str | os.PathLike[str]) -> VideoStream:
    """Return the (first) video stream; cover pictures of sound files do not count."""
    for stream in media.streams.video:
        if not stream.disposition & stream.disposition.attached_pic:
            stream.thread_type = "AUTO"
            return stream
    raise InputError(f"{path}: has no picture; give a video")


def probe(path: str | os.PathLike[str], *, minimum_frames: int = 1) -> VideoInfo:
    """Describe a video without decoding more than its ends.

    Raises InputError where the file is missing, no video, truncated, or has fewer than
    `minimum_frames` frames.
    """
    scan = _scan(path)
    _check_end(path, scan.last_key)
    width, height = scan.first.width, scan.first.height
    if _is_transposed(scan.matrix):
        width, height = height, width
    frames = int(scan.repeats.sum())
    if frames < minimum_frames:
        raise InputError(
            f"{path}: has {frames} frame(s) but {minimum_frames} are needed; give a longer clip"
        )
    duration = float(frames / scan.fps)
    return VideoInfo(Path(path), width, height, scan.fps, frames, duration, scan.has_sound)


def read_frames(
    path: str | os.PathLike[str], *, start: int = 0, stop: int | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Yield frames `start` <= t < `stop` as uint8 RGB (H, W, 3), one at a time.

    They are upright and at the constant rate of `probe(path).fps`; without `stop` as many as
    `probe(path).frames`. Frames before `start` are decoded but not converted. Raises InputError
    as `probe` does, and where decoding ends early.
    """
    yield from _read(path, lambda count: np.arange(start, count if stop is None else stop))


def read_chosen_frames(
    path: str | os.PathLike[str], chosen: ArrayLike
) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames whose numbers are `chosen`, rising; otherwise as `read_frames`.

    Frames between them are decoded but not converted.
    """
    yield from _read(path, lambda count: np.asarray(chosen, np.int64))


def _read(
    path: str | os.PathLike[str], choose: Callable[[int], NDArray[np.int64]]
) -> Iterator[NDArray[np.uint8]]:
    """The frames that `choose` names, rising, when told how many there are."""
    scan = _scan(path)
    wanted = choose(int(scan.repeats.sum()))
    shown = np.cumsum(scan.repeats)  # after each source frame
    times = np.bincount(np.searchsorted(shown, wanted, side="right"), minlength=len(shown) + 1)
    left = len(wanted)
    convert = _converter(path, scan)
    seen = 0
    with open_media(path) as media:
        for frame in media.decode(video_stream(media, path)):
            if seen == len(shown) or (seen > 0 and not left):
                return
            if times[seen]:
                image = convert(frame)
                for _ in range(times[seen]):
                    yield image
            left -= times[seen]
            seen += 1
    if seen < len(shown):
        raise InputError(
            f"{path}: truncated or damaged: {seen} of {len(shown)} frames decode; {_COMPLETE}"
        )


def picture_start(path: str | os.PathLike[str]) -> float | None:
    """Return the time of the first frame on the file's own clock [s]; None without a picture."""
    with open_media(path) as media:
        if all(s.disposition & s.disposition.attached_pic for s in media.streams.video):
            return None
        for frame in media.decode(video_stream(media, path)):
            return float(frame.time or 0.0)
    raise InputError(f"{path}: no frame can be decoded; {_COMPLETE}")


# ---- scanning -------------------------------------------------------------------------------


def _scan(path: str | os.PathLike[str]) -> _Scan:
    """Read every packet, decode only the first frame."""
    first: VideoFrame | None = None
    stamps: list[int | None] = []
    last_key: int | None = None
    ends = [0.0]
    with open_media(path) as media:
        stream = video_stream(media, path)
        for packet in media.demux():
            if packet.pts is not None and packet.time_base is not None:
                ends.append(float((packet.pts + (packet.duration or 0)) * packet.time_base))
            if packet.stream_index != stream.index:
                continue
            if first is None:
                first = next((f for f in packet.decode() if isinstance(f, VideoFrame)), None)
            if packet.size and not packet.is_discard:
                stamps.append(packet.pts)
                last_key = packet.dts if packet.is_keyframe else last_key
        if first is None or first.width * first.height == 0:
            raise InputError(f"{path}: no frame can be decoded; {_COMPLETE}")
        _check_promises(path, media, stream, len(stamps), max(ends))
        times = _source_times(path, stream, first, stamps)
        fps, repeats = _constant_rate(times, stream)
        sound = len(media.streams.audio) > 0
    return _Scan(first, _display_matrix(first), fps, repeats, last_key, sound)


def _check_promises(
    path: str | os.PathLike[str], media: InputContainer, stream: VideoStream, found: int, end: float
) -> None:
    """Compare what the header says with what is there."""
    if found < stream.frames:
        raise InputError(
            f"{path}: truncated: {found} of {stream.frames} frames are there; {_COMPLETE}"
        )
    promised = (media.duration or 0) / av.time_base
    slack = 2 / float(stream.average_rate or 25)
    if "matroska" in media.format.name and end < promised - slack:
        raise InputError(f"{path}: truncated: ends at {end:.2f} s of {promised:.2f} s; {_COMPLETE}")


def _check_end(path: str | os.PathLike[str], last_key: int | None) -> None:
    """Decode the last frames: a file cut in the middle of a frame has a damaged last one."""
    damaged: bool | None = None
    with open_media(path) as media:
        stream = video_stream(media, path)
        if last_key is not None:
            media.seek(last_key, stream=stream)
        for frame in media.decode(stream):
            damaged = frame.is_corrupt
    if damaged is None and last_key is not None:  # sought too far: decode all
        _check_end(path, None)
    if damaged:
        raise InputError(f"{path}: truncated: the last frame is incomplete; {_COMPLETE}")


def _source_times(
    path: str | os.PathLike[str],
    stream: VideoStream,
    first: VideoFrame,
    stamps: list[int | None],
) -> NDArray[np.float64] | int:
    """Return the source frames' times (n,) [s] in order, or only n where there is no good clock.

    Packets before the first frame that decodes (of an open group of pictures) do not count.
    """
    if first.pts is None or stream.time_base is None or any(s is None for s in stamps):
        with open_media(path) as media:
            return sum(1 for _ in media.decode(video_stream(media, path)))
    ticks = np.sort(np.array([s for s in stamps if s is not None and s >= first.pts]))
    times = (ticks - ticks[0]) * float(stream.time_base)
    gaps = np.diff(times)
    return len(times) if np.any(gaps > _LONGEST_GAP_S) else times


def _constant_rate(
    times: NDArray[np.float64] | int, stream: VideoStream
) -> tuple[Fraction, NDArray[np.int64]]:
    """Return the rate and how often each source frame is shown at it."""
    declared = [Fraction(r) for r in (stream.guessed_rate, stream.average_rate) if r]
    if isinstance(times, int):
        return (declared or [Fraction(25)])[0], np.ones(times, np.int64)
    tick = float(stream.time_base or 0)
    for rate in declared:
        if _stray(times, rate) <= 1.5 * tick * float(rate):
            return rate, np.ones(len(times), np.int64)
    rate = min([*STANDARD_RATES, *declared], key=lambda r: _stray(times, r))
    if _stray(times, rate) > _STEADY:
        rate = _usual_rate(times)
    return rate, _nearest_in_time(times, rate)


def _stray(times: NDArray[np.float64], rate: Fraction) -> float:
    """Return the largest distance of `times` (n,) from a clock of that rate, in frames."""
    return float(np.abs(times * float(rate) - np.arange(len(times))).max())


def _usual_rate(times: NDArray[np.float64]) -> Fraction:
    """Return the rate of the intervals without a missing frame, where possible a standard one."""
    gaps = np.diff(times)
    gaps = gaps[gaps > 1 / 240] if np.any(gaps > 1 / 240) else np.array([1 / 25])
    usual = 1 / float(gaps[gaps < 1.5 * np.quantile(gaps, 0.2)].mean())
    standard = min(STANDARD_RATES, key=lambda r: abs(float(r) - usual))
    close = abs(float(standard) - usual) <= 0.05 * usual
    return standard if close else Fraction(usual).limit_denominator(1001)


def _nearest_in_time(times: NDArray[np.float64], rate: Fraction) -> NDArray[np.int64]:
    """Return (n,): how many instants k / rate have each of `times` (n,) as their nearest."""
    instants = np.arange(round(times[-1] * float(rate)) + 1) / float(rate)
    nearest = np.searchsorted((times[1:] + times[:-1]) / 2, instants)
    return np.bincount(nearest, minlength=len(times))


# ---- pixels ---------------------------------------------------------------------------------


def _display_matrix(frame: VideoFrame) -> tuple[int, int, int, int]:
    """Return (a, b, c, d): pixel (x, y) is shown at (a x + c y, b x + d y), up to a shift."""
    side_data: Any = frame.side_data  # av's own types name its class wrongly
    matrix = side_data.get(SideDataType.DISPLAYMATRIX)
    if matrix is None:
        return 1, 0, 0, 1
    m = np.frombuffer(bytes(matrix), np.int32)
    return int(m[0]), int(m[1]), int(m[3]), int(m[4])


def _is_transposed(matrix: tuple[int, int, int, int]) -> bool:
    return abs(matrix[1]) > abs(matrix[0])


def _upright(image: NDArray[np.uint8], matrix: tuple[int, int, int, int]) -> NDArray[np.uint8]:
    """Turn and mirror `image` (H, W, 3) by a display matrix, in steps of 90 degrees."""
    a, b, c, d = matrix
    if _is_transposed(matrix):
        image, a, d = image.transpose(1, 0, 2), c, b
    return np.ascontiguousarray(image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def _converter(
    path: str | os.PathLike[str], scan: _Scan
) -> Callable[[VideoFrame], NDArray[np.uint8]]:
    """Return decoded frame -> upright uint8 RGB (H, W, 3).

    It keeps FFmpeg's conversion tables between frames. Colour matrix and range are those that the
    frames are tagged with; untagged ones follow the custom: BT.601 up to 576 lines, BT.709 above.
    """
    size = scan.first.width, scan.first.height
    untagged = int(scan.first.colorspace) == _UNSPECIFIED
    matrix = Colorspace.ITU709 if untagged and size[1] > 576 else None
    reformatter = VideoReformatter()

    def convert(frame: VideoFrame) -> NDArray[np.uint8]:
        if (frame.width, frame.height) != size:
            raise InputError(
                f"{path}: the picture changes its size from {size[0]}x{size[1]} to "
                f"{frame.width}x{frame.height}; cut the clip there"
            )
        rgb = reformatter.reformat(
            frame, format="rgb24", interpolation=_EXACT, src_colorspace=matrix
        )
        return _upright(np.asarray(rgb.to_ndarray(), np.uint8), scan.matrix)

    return convert
