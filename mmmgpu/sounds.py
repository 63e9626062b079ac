"""Sound in and out: float32 samples in [-1, 1] on the clock of the picture.

Sample 0 belongs to the beginning of the first frame: what a file says before it is cut, and silence
is put in where the sound starts later.
"""

import os
import wave
from fractions import Fraction
from typing import Any, Final

import numpy as np
from av.audio.frame import AudioFrame
from av.audio.resampler import AudioResampler
from numpy.typing import ArrayLike, NDArray

from .errors import InputError
from .files import atomic_path
from .videos import VideoInfo, open_media, picture_start

PEAK: Final = 0.5  # of full scale, to which speech is brought before it is analysed
_GAP_S = 0.05  # timestamps that leave a gap longer than this are believed, and filled with silence
_LONGEST_GAP_S = 60.0  # more is a broken clock
_LIMIT_S = 0.5  # sound and picture may differ in length by this much


def read_sound(
    path: str | os.PathLike[str], *, rate: int | None = None, mono: bool = True
) -> tuple[NDArray[np.float32], int]:
    """Read the (first) sound of a video or sound file as (samples, rate).

    Samples are float32 in [-1, 1], shape (n,), the mean of the channels; (n, channels) with
    `mono=False`. They are resampled to `rate` [Hz], where given. Sample 0 is at the beginning of
    the picture, where there is one. Raises InputError for files without sound.
    """
    origin = picture_start(path)
    with open_media(path) as media:
        if not media.streams.audio:
            raise InputError(f"{path}: has no sound; give a file with sound")
        stream = media.streams.audio[0]
        chunks = [(_time(f), _floats(f), f.sample_rate) for f in media.decode(stream)]
    if not chunks:
        raise InputError(f"{path}: its sound cannot be decoded; copy or download it again")
    if len({(c.shape[1], r) for _, c, r in chunks}) > 1:
        raise InputError(f"{path}: its sound changes rate or channels; cut the clip there")
    own_rate = chunks[0][2]
    samples = _on_one_clock([(t, c) for t, c, _ in chunks], own_rate, origin)
    if mono:
        samples = samples.mean(axis=1, dtype=np.float64).astype(np.float32)[:, None]
    if rate is not None and rate != own_rate:
        samples = resample(samples, own_rate, rate)
    return (samples[:, 0] if mono else samples), rate or own_rate


def _time(frame: AudioFrame) -> float | None:
    known = frame.pts is not None and frame.time_base is not None
    return frame.time if known else None


def _floats(frame: AudioFrame) -> NDArray[np.float32]:
    """Return the samples of one decoded frame (n, channels) in [-1, 1], whatever their format."""
    raw: Any = frame.to_ndarray()  # (channels, n), or (1, n * channels) where they are interleaved
    samples = raw.T if frame.format.is_planar else raw.reshape(-1, frame.layout.nb_channels)
    if samples.dtype == np.uint8:
        return np.asarray((samples - 128.0) / 128, np.float32)
    scale = 1 if samples.dtype.kind == "f" else 1 / -float(np.iinfo(samples.dtype).min)
    return np.asarray(samples * scale, np.float32)


def _on_one_clock(
    chunks: list[tuple[float | None, NDArray[np.float32]]], rate: int, origin: float | None
) -> NDArray[np.float32]:
    """Join chunks (n, channels) that start at times [s] so that sample 0 is at `origin`.

    Only the first time and gaps are believed: small jitter of the timestamps would be heard.
    """
    channels = chunks[0][1].shape[1]
    start = chunks[0][0] or 0.0
    joined: list[NDArray[np.float32]] = []
    position = 0
    for time, chunk in chunks:
        late = 0 if time is None else round((time - start) * rate) - position
        if _GAP_S * rate < late < _LONGEST_GAP_S * rate:
            joined.append(np.zeros((late, channels), np.float32))
            position += late
        joined.append(chunk)
        position += len(chunk)
    offset = 0 if origin is None else round((start - origin) * rate)
    silence = np.zeros((max(offset, 0), channels), np.float32)
    return np.concatenate([silence, *joined])[max(-offset, 0) :]


def resample(samples: NDArray[np.float32], rate: int, new_rate: int) -> NDArray[np.float32]:
    """Resample (n,) or (n, channels) from `rate` to `new_rate` [Hz] with libswresample.

    The result has round(n * new_rate / rate) samples; sample 0 stays at time 0.
    """
    length = round(len(samples) * new_rate / rate)
    if samples.ndim == 2:
        columns = [resample(column, rate, new_rate) for column in samples.T]
        return np.stack(columns, axis=1)
    if length == 0 or rate == new_rate:
        return samples[:length].astype(np.float32)
    frame = AudioFrame.from_ndarray(
        np.ascontiguousarray(samples[None], np.float32), format="fltp", layout="mono"
    )
    frame.sample_rate, frame.pts, frame.time_base = rate, 0, Fraction(1, rate)
    resampler = AudioResampler(format="fltp", layout="mono", rate=new_rate)
    parts = [f.to_ndarray()[0] for f in resampler.resample(frame) + resampler.resample(None)]
    result = np.concatenate(parts)[:length]
    return np.pad(result, (0, length - len(result)))


def checked_speech(samples: ArrayLike, rate: int) -> NDArray[np.float64]:
    """Return mono `samples` as float64, shape (N,).

    Raises:
        InputError: They are none, not mono or not finite, or `rate` [Hz] is no rate.
    """
    sound = np.asarray(samples, dtype=np.float64)
    if sound.ndim != 1 or not sound.size:
        raise InputError(f"samples must be mono, shape (N,), N > 0, got {sound.shape}")
    if not np.isfinite(sound).all():
        raise InputError("samples must be finite; there is NaN or infinity in the sound")
    if rate <= 0:
        raise InputError(f"rate must be > 0 samples a second, got {rate}")
    return sound


def levelled(sound: NDArray[np.float64], rate: int, new_rate: int) -> NDArray[np.float64]:
    """Return mono `sound`, (N,), resampled from `rate` to `new_rate` [Hz], the loudest at `PEAK`.

    Raises:
        InputError: There is nothing to be heard.
    """
    samples = resample(sound.astype(np.float32), rate, new_rate).astype(np.float64)
    peak: float = np.abs(samples).max(initial=0.0)
    if not peak:
        raise InputError("the sound is silent or too short; give a clip with speech")
    return samples * (PEAK / peak)


def check_sync(info: VideoInfo, sound: tuple[NDArray[np.float32], int]) -> None:
    """Raise InputError where the sound (samples, rate) is too short or long for the picture."""
    samples, rate = sound
    seconds = len(samples) / rate
    if abs(seconds - info.duration) > _LIMIT_S:
        word = "shorter" if seconds < info.duration else "longer"
        raise InputError(
            f"{info.path}: the sound ({seconds:.2f} s) is {word} than the picture "
            f"({info.duration:.2f} s) by more than {_LIMIT_S} s; cut them to one length"
        )


def write_wav(path: str | os.PathLike[str], samples: NDArray[np.float32], rate: int) -> None:
    """Write samples (n,) or (n, channels) in [-1, 1] as a 16-bit WAV file; louder ones clip."""
    whole = np.clip(np.rint(np.asarray(samples, np.float64) * 32768), -32768, 32767)
    with atomic_path(path) as temporary, wave.open(str(temporary), "wb") as file:
        file.setnchannels(1 if samples.ndim == 1 else samples.shape[1])
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(whole.astype("<i2").tobytes())


def read_wav(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], int]:
    """Read a WAV file as (samples (n,), rate), its channels averaged."""
    return read_sound(path)


def energy(
    samples: NDArray[np.float32], rate: int, n_frames: int, fps: Fraction | float
) -> NDArray[np.float64]:
    """Return the RMS of `samples` (n,) inside every frame, shape (n_frames,).

    Frame t covers [t, t + 1) / fps; beyond the end of the sound the samples count as 0.
    """
    edges = np.rint(np.arange(n_frames + 1) * (rate / float(fps))).astype(np.int64)
    squares = np.concatenate([[0.0], np.cumsum(np.square(samples, dtype=np.float64))])
    sums = np.diff(squares[np.minimum(edges, len(samples))])
    rms: NDArray[np.float64] = np.sqrt(sums / np.maximum(np.diff(edges), 1))
    return rms
