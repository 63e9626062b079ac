"""Write video with sound, one frame at a time: H.264 + AAC for people, exact RGB for measuring.

Colours are converted with BT.601 up to 576 lines and BT.709 above, and tagged so: players that
heed the tags and players that guess show the same. Sizes with an odd number of pixels cannot have
halved colour (4:2:0); they are written with full colour (4:4:4), which browsers other than Firefox
and most players show. Padding would change the size.
"""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.audio.frame import AudioFrame
from av.container import OutputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from numpy.typing import NDArray

from .errors import InputError
from .files import atomic_path
from .videos import ACCURATE_ROUNDING, FULL_CHROMA_IN

Sound = tuple[NDArray[np.float32], int]

_FLAGS = int(Interpolation.BICUBIC) | ACCURATE_ROUNDING | FULL_CHROMA_IN
_AAC_RATES = (8000, 11025, 12000, 16000, 22050, 24000, 32000, 44100, 48000, 64000, 88200, 96000)
# AVColorSpace, AVColorPrimaries, AVColorTransferCharacteristic (one number in each)
_BT709, _BT601_625, _BT601 = 1, 5, 6


@dataclass(frozen=True)
class _Recipe:
    """Codecs and their settings for one kind of file."""

    video: str
    pixels: str
    video_options: dict[str, str]
    audio: str
    audio_format: str
    audio_options: dict[str, str]


_FAST = {"aac_coder": "fast"}  # at 192 kbit/s 10 dB closer to speech than the default "twoloop"
_LOSSY = _Recipe("libx264", "yuv420p", {"preset": "veryfast", "crf": "16"}, "aac", "fltp", _FAST)
_X264RGB = _Recipe("libx264rgb", "rgb24", {"preset": "veryfast", "crf": "0"}, "flac", "s32", {})
_FFV1 = _Recipe("ffv1", "bgr0", {"level": "3", "slices": "4"}, "pcm_f32le", "flt", {})
_QUICKTIME = replace(_X264RGB, audio="pcm_f32le", audio_format="flt")
_LOSSLESS = {".mkv": _FFV1, ".mp4": _X264RGB, ".mov": _QUICKTIME}
_FORMATS = {".mkv": "matroska", ".mp4": "mp4", ".mov": "mov"}


def write_video(
    path: str | os.PathLike[str],
    frames: Iterable[NDArray[np.uint8]],
    *,
    fps: Fraction | int,
    sound: Sound | None = None,
    lossless: bool = False,
) -> int:
    """Write `frames` (uint8 RGB (H, W, 3), taken one at a time) at `fps`; return their number.

    `sound` is (samples (n,) or (n, 2) in [-1, 1], rate); its first sample belongs to the beginning
    of the first frame. The suffix chooses the file: .mp4, .mov or .mkv, H.264 + AAC; with
    `lossless` exact RGB: FFV1 in .mkv (the fastest), H.264 in RGB in .mp4 and .mov, and sound
    as float samples, in .mp4 as 24-bit FLAC.
    The file appears when it is complete; on any exception nothing of it remains.

    Raises InputError for another suffix, for no frames, for frames of different sizes, and where
    the file cannot be written (folder, permission, disk full).
    """
    suffix = require_video_name(path)
    recipe = _LOSSLESS[suffix] if lossless else _LOSSY
    rate = Fraction(fps)
    count = 0
    options = {} if suffix == ".mkv" else {"movflags": "+faststart"}  # plays while it loads
    with (
        atomic_path(path) as temporary,
        av.open(f"file:{temporary}", "w", format=_FORMATS[suffix], options=options) as media,
    ):
        write_frame: Callable[[NDArray[np.uint8] | None], None] | None = None
        for image in frames:
            if write_frame is None:
                write_frame = _open_picture(media, recipe, rate, image, path)
                write_sound = _open_sound(media, recipe, sound)
            write_frame(image)
            count += 1
            write_sound(count / rate)
        if write_frame is None:
            raise InputError(f"{path}: there are no frames to write; give a longer clip or speech")
        write_frame(None)
        write_sound(None)
    return count


def require_video_name(path: str | os.PathLike[str]) -> str:
    """Return the suffix of `path` in small letters; InputError if no such video can be written."""
    suffix = Path(path).suffix.lower()
    if suffix not in _FORMATS:
        raise InputError(f"{path}: cannot write '{suffix}' files; name it .mp4, .mov or .mkv")
    return suffix


def _open_picture(
    media: OutputContainer,
    recipe: _Recipe,
    rate: Fraction,
    first: NDArray[np.uint8],
    path: str | os.PathLike[str],
) -> Callable[[NDArray[np.uint8] | None], None]:
    """Add the picture stream; return the function that writes a frame (None: the end)."""
    height, width = first.shape[:2]
    stream: Any = media.add_stream(recipe.video, rate=rate, options=recipe.video_options)
    stream.width, stream.height = width, height
    odd = width % 2 == 1 or height % 2 == 1
    pixels = "yuv444p" if recipe.pixels == "yuv420p" and odd else recipe.pixels
    stream.pix_fmt = pixels
    stream.codec_context.time_base = 1 / rate
    stream.thread_type = "AUTO"
    convert = _colour_converter(stream, pixels, height)
    count = 0

    def write_frame(image: NDArray[np.uint8] | None) -> None:
        nonlocal count
        if image is None:
            media.mux(stream.encode(None))
            return
        if image.shape != first.shape:
            raise InputError(
                f"{path}: frame {count} has shape {image.shape}, the first one {first.shape}; "
                "give frames of one size"
            )
        frame = convert(VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24"))
        frame.pts, frame.time_base = count, 1 / rate
        media.mux(stream.encode(frame))
        count += 1

    return write_frame


def _colour_converter(stream: Any, pixels: str, height: int) -> Callable[[VideoFrame], VideoFrame]:
    """Tag the stream and return the matching RGB -> `pixels` conversion."""
    reformatter = VideoReformatter()
    if not pixels.startswith("yuv"):
        return lambda frame: reformatter.reformat(frame, format=pixels)
    context = stream.codec_context
    standard = height <= 576
    context.color_range = int(ColorRange.MPEG)
    context.colorspace = _BT601 if standard else _BT709
    context.color_primaries = _BT601_625 if standard else _BT709
    context.color_trc = _BT601 if standard else _BT709
    matrix = Colorspace.ITU601 if standard else Colorspace.ITU709
    return lambda frame: reformatter.reformat(
        frame,
        format=pixels,
        interpolation=_FLAGS,
        dst_colorspace=matrix,
        dst_color_range=ColorRange.MPEG,
    )


def _open_sound(
    media: OutputContainer, recipe: _Recipe, sound: Sound | None
) -> Callable[[Fraction | None], None]:
    """Add the sound stream; return the function that writes up to a time [s] (None: the end)."""
    if sound is None:
        return lambda until: None
    samples, rate = _playable(sound, recipe)
    stream: Any = media.add_stream(recipe.audio, rate=rate, options=recipe.audio_options)
    stream.layout = "stereo" if samples.shape[1] == 2 else "mono"
    stream.format = recipe.audio_format
    if recipe.audio == "aac":
        stream.bit_rate = 192_000
    done = 0

    def write_sound(until: Fraction | None) -> None:
        nonlocal done
        end = len(samples) if until is None else min(len(samples), round(until * rate))
        if end > done:
            chunk = np.ascontiguousarray(samples[done:end].T)
            frame = AudioFrame.from_ndarray(chunk, format="fltp", layout=stream.layout.name)
            frame.sample_rate, frame.pts, frame.time_base = rate, done, Fraction(1, rate)
            media.mux(stream.encode(frame))
            done = end
        if until is None:
            media.mux(stream.encode(None))

    return write_sound


def _playable(sound: Sound, recipe: _Recipe) -> Sound:
    """Return samples (n, 1 or 2) and a rate that the codec takes."""
    samples, rate = sound
    samples = np.asarray(samples, np.float32).reshape(len(samples), -1)
    if samples.shape[1] not in (1, 2):
        raise InputError(f"sound has {samples.shape[1]} channels; give mono or stereo")
    if recipe.audio == "aac" and rate not in _AAC_RATES:
        from .sounds import resample

        return resample(samples, rate, 48000), 48000
    return samples, rate
