"""Makers of small odd media files."""

from fractions import Fraction

import av
import numpy as np
from av.stream import Disposition


def still(height=48, width=64):
    """One uint8 RGB picture (H, W, 3) without any symmetry, in large patches of plain colour."""
    patches = np.random.default_rng(5).integers(30, 226, (3, 4, 3))
    rows = np.arange(height) * 3 // height
    columns = np.arange(width) * 4 // width
    return patches[rows[:, None], columns].astype(np.uint8)


def grey_levels(n, height=48, width=64):
    """n plain grey frames, each one told from the others by its level."""
    return [np.full((height, width, 3), level, np.uint8) for level in grey_values(n)]


def grey_values(n):
    return np.linspace(20, 235, n).astype(np.uint8)


def which(frames, n):
    """The index of each frame among `grey_levels(n)`, also after lossy coding."""
    means = np.array([frame.mean() for frame in frames])
    return np.abs(means[:, None] - grey_values(n)).argmin(axis=1).tolist()


def encode(path, frames, *, codec="ffv1", pixels="bgr0", rate=25, ticks=None, clock=None, **tags):
    """Encode RGB frames with timestamps `ticks` [1 / clock s] (default: one a frame)."""
    clock = Fraction(clock or rate)
    with av.open(str(path), "w") as media:
        stream = media.add_stream(codec, rate=rate)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        stream.codec_context.time_base = 1 / clock
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for k, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = k if ticks is None else ticks[k], 1 / clock
            media.mux(stream.encode(frame))
        media.mux(stream.encode(None))
    return path


def encode_sound(path, samples, rate, *, codec="pcm_s16le", sample_format="s16", frames=(), at=()):
    """Encode samples (n, channels) in [-1, 1] in blocks of 1000, shifted by `at` [(block, s)]."""
    layout = {1: "mono", 2: "stereo"}[samples.shape[1]]
    with av.open(str(path), "w") as media:
        if frames:
            picture = media.add_stream("ffv1", rate=25)
            picture.height, picture.width = frames[0].shape[:2]
            picture.pix_fmt = "bgr0"
        options = {"aac_coder": "fast"} if codec == "aac" else {}  # the default distorts a sine
        stream = media.add_stream(codec, rate=rate, options=options)
        stream.layout, stream.format = layout, sample_format
        for k, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="bgr0")
            frame.pts, frame.time_base = k + round(dict(at).get("picture", 0) * 25), Fraction(1, 25)
            media.mux(picture.encode(frame))
        late = 0.0
        for k, begin in enumerate(range(0, len(samples), 1000)):
            late += dict(at).get(k, 0.0)
            block = np.ascontiguousarray(samples[begin : begin + 1000].T, np.float32)
            sound = av.AudioFrame.from_ndarray(block, format="fltp", layout=layout)
            sound.sample_rate, sound.time_base = rate, Fraction(1, rate)
            sound.pts = begin + round(late * rate)
            media.mux(stream.encode(sound))
        for open_stream in [stream, *([picture] if frames else [])]:
            media.mux(open_stream.encode(None))
    return path


def song_with_cover(path, samples, rate):
    """A sound file (n, 1) that carries a cover picture, as music files do."""
    with av.open(str(path), "w") as media:
        stream = media.add_stream("aac", rate=rate)
        stream.layout = "mono"
        cover = media.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 64, 48, "yuvj420p"
        cover.disposition = Disposition.attached_pic
        block = np.ascontiguousarray(samples.T)
        sound = av.AudioFrame.from_ndarray(block, format="fltp", layout="mono")
        sound.sample_rate, sound.pts, sound.time_base = rate, 0, Fraction(1, rate)
        media.mux(stream.encode(sound) + stream.encode(None))
        picture = av.VideoFrame.from_ndarray(still(), format="rgb24")
        media.mux(cover.encode(picture) + cover.encode(None))
    return path


def tone(seconds, rate, *, hertz=440.0, channels=1):
    """A sine (n, channels); the second channel is half as loud."""
    wave = 0.5 * np.sin(2 * np.pi * hertz * np.arange(round(seconds * rate)) / rate)
    return np.stack([wave, wave / 2][:channels], axis=1).astype(np.float32)


def clicks(seconds, rate, times):
    """Silence with a short burst beginning at each of `times` [s], shape (n,)."""
    samples = np.zeros(round(seconds * rate), np.float32)
    for time in times:
        begin = round(time * rate)
        samples[begin : begin + rate // 500] = 0.8
    return samples


def set_display_matrix(path, a, b, c, d):
    """Overwrite the matrix of the first track of an MP4: (x, y) is shown at (ax + cy, bx + dy)."""
    data = bytearray(path.read_bytes())
    begin = data.index(b"tkhd") + 44
    matrix = [a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30]
    data[begin : begin + 36] = np.array(matrix, ">i4").tobytes()
    path.write_bytes(data)


def cut(path, share):
    """Keep only the first `share` of a file's bytes."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path
