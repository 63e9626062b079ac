import itertools
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from media import cut, encode, encode_sound, grey_levels, set_display_matrix, still, tone, which
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu.errors import InputError
from mmmgpu.videos import probe, read_chosen_frames, read_frames

NTSC = Fraction(30000, 1001)


@pytest.mark.parametrize("name", ["a.mkv", "name with spaces.mkv", "-i.mkv", "data:日本 1%03d.mkv"])
def test_any_name(tmp_path, name, monkeypatch):
    encode(tmp_path / "plain.mkv", grey_levels(5))
    (tmp_path / "plain.mkv").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    info = probe(name)
    assert (info.path, info.width, info.height) == (Path(name), 64, 48)
    assert (info.fps, info.frames, info.duration, info.has_sound) == (25, 5, 0.2, False)
    assert which(read_frames(name), 5) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mpg", "mpeg1video", "yuv420p"),
        ("a.mpg", "mpeg2video", "yuv422p"),
        ("a.ts", "mpeg2video", "yuv420p"),
        ("a.avi", "mpeg4", "yuv420p"),
        ("a.avi", "mjpeg", "yuvj420p"),
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mp4", "libx264", "gray"),
        ("a.mov", "libx264", "yuv420p10le"),
        ("a.mkv", "ffv1", "gray"),
        ("a.mkv", "libx264", "yuv444p"),
        ("a.webm", "libvpx", "yuv420p"),
        ("a.webm", "libvpx-vp9", "yuv420p"),
    ],
)
@pytest.mark.parametrize("rate", [25, NTSC])
def test_every_frame_of_every_kind_of_file(tmp_path, name, codec, pixels, rate):
    tags = {"color_range": 2} if pixels == "gray" else {}  # grey is coded from 0 to 255
    path = encode(tmp_path / name, grey_levels(19), codec=codec, pixels=pixels, rate=rate, **tags)
    info = probe(path)
    frames = list(read_frames(path))
    assert (info.fps, info.frames, info.width, info.height) == (rate, 19, 64, 48)
    assert which(frames, 19) == list(range(19))
    assert {(f.shape, f.dtype, f.flags.c_contiguous) for f in frames} == {
        ((48, 64, 3), np.dtype(np.uint8), True)
    }
    assert_allclose(np.ptp(np.array(frames, float), axis=-1), 0, atol=3)  # grey stays grey


def test_a_part_is_that_part(tmp_path):
    path = encode(tmp_path / "a.mkv", grey_levels(12))
    assert which(read_frames(path, start=4), 12) == list(range(4, 12))
    assert which(read_frames(path, start=4, stop=7), 12) == [4, 5, 6]
    assert which(read_frames(path, stop=3), 12) == [0, 1, 2]
    assert list(read_frames(path, start=5, stop=5)) == []
    assert list(read_frames(path, start=30)) == []


def test_chosen_frames_are_those(tmp_path):
    path = encode(tmp_path / "a.mkv", grey_levels(12))
    assert which(read_chosen_frames(path, [0, 3, 4, 11]), 12) == [0, 3, 4, 11]
    assert which(read_chosen_frames(path, [5]), 12) == [5]
    assert list(read_chosen_frames(path, [])) == []


def test_reading_stops_early_without_a_file_left_open(tmp_path):
    path = encode(tmp_path / "a.mkv", grey_levels(12))
    frames = read_frames(path)
    next(frames)
    frames.close()
    descriptors = Path("/proc/self/fd")
    if not descriptors.exists():
        pytest.skip("open files can be listed on Linux only")
    assert str(path) not in {str(d.readlink()) for d in descriptors.iterdir() if d.is_symlink()}


def shown_by(matrix, image):
    """The picture pixel by pixel, from the definition of the display matrix."""
    a, b, c, d = matrix
    placed = {
        (a * x + c * y, b * x + d * y): image[y, x]
        for y in range(image.shape[0])
        for x in range(image.shape[1])
    }
    left, top = np.min(list(placed), axis=0)
    width, height = np.max(list(placed), axis=0) - (left, top) + 1
    result = np.zeros((height, width, 3), np.uint8)
    for (x, y), pixel in placed.items():
        result[y - top, x - left] = pixel
    return result


@pytest.mark.parametrize(
    "matrix",
    [(a, 0, 0, d) for a in (1, -1) for d in (1, -1)]
    + [(0, b, c, 0) for b in (1, -1) for c in (1, -1)],
)
def test_turned_and_mirrored_video_is_upright(tmp_path, matrix):
    path = encode(tmp_path / "a.mp4", [still()] * 3, codec="libx264rgb", pixels="rgb24", qmax=0)
    plain = next(read_frames(path))
    set_display_matrix(path, *matrix)
    frames = list(read_frames(path))
    info = probe(path)
    assert_array_equal(frames[2], shown_by(matrix, plain))
    assert frames[0].shape == (info.height, info.width, 3)


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
@pytest.mark.parametrize("seed", range(4))
def test_variable_rate_becomes_the_nearest_frame_in_time(tmp_path, suffix, seed):
    """Most frames 1/30 s apart, a third of them missing, the times rounded to odd milliseconds."""
    rng = np.random.default_rng(seed)
    kept = np.sort(rng.choice(np.arange(1, 60), 38, replace=False))
    ms = np.array([0, *(kept * 1000 // 30 + rng.integers(-4, 5, 38))])
    codec, pixels = ("ffv1", "bgr0") if suffix == ".mkv" else ("libx264", "yuv420p")
    path = encode(
        tmp_path / f"a{suffix}", grey_levels(39), ticks=ms, clock=1000, codec=codec, pixels=pixels
    )
    info = probe(path)
    assert float(info.fps) == pytest.approx(30, rel=0.002)
    instants = np.arange(info.frames) * 1000 / float(info.fps)
    distances = np.abs(instants[:, None] - ms)
    shown = which(read_frames(path), 39)
    assert len(shown) == info.frames
    assert_allclose(distances[range(len(shown)), shown], distances.min(axis=1), atol=1e-9)
    assert abs(instants[-1] - ms[-1]) <= 17


def test_a_part_of_variable_rate_is_that_part(tmp_path):
    ms = [0, 40, 80, 310, 350, 390, 430, 470]
    path = encode(tmp_path / "a.mkv", grey_levels(8), ticks=ms, clock=1000)
    everything = which(read_frames(path), 8)
    assert everything == [0, 1, 2, 2, 2, 3, 3, 3, 3, 4, 5, 6, 7]
    assert which(read_frames(path, start=3, stop=7), 8) == everything[3:7]


@pytest.mark.parametrize("rate", [30, 18])
def test_jitter_is_no_variable_rate(tmp_path, rate):
    rng = np.random.default_rng(0)
    ticks = np.arange(60) * (540 // rate) + rng.integers(-2, 3, 60)  # phones: a little off
    path = encode(tmp_path / "a.mkv", grey_levels(60), rate=rate, ticks=ticks - ticks[0], clock=540)
    assert (probe(path).fps, probe(path).frames) == (rate, 60)
    assert which(read_frames(path), 60) == list(range(60))


def test_a_late_start_and_a_broken_clock_lose_no_frame(tmp_path):
    late = encode(tmp_path / "late.mkv", grey_levels(9), ticks=range(50, 59))
    leap = [0, 1, 2, 3, 90000, 90001, 90002, 90003, 90004]  # an hour between two frames
    broken = encode(tmp_path / "broken.mkv", grey_levels(9), ticks=leap)
    for path in (late, broken):
        assert probe(path).frames == 9
        assert which(read_frames(path), 9) == list(range(9))


REC_709, REC_601 = 1, 5


@pytest.mark.parametrize(
    ("matrix", "full", "height", "tagged"),
    [
        *itertools.product((REC_709, REC_601), (False, True), (48, 720), (True,)),
        (REC_601, False, 48, False),
        (REC_709, False, 720, False),
    ],
)
def test_colours_are_those_of_the_tags(tmp_path, matrix, full, height, tagged):
    """Y, Cb, Cr of known colours by the standards' own formulae; untagged: 601, or 709 in HD."""
    colours = np.array([[200, 30, 40], [30, 180, 60], [50, 60, 220], [128, 128, 128]], float)
    red, blue = (0.2126, 0.0722) if matrix == REC_709 else (0.299, 0.114)
    luma = colours @ [red, 1 - red - blue, blue]
    cb = (colours[:, 2] - luma) / (2 - 2 * blue)
    cr = (colours[:, 0] - luma) / (2 - 2 * red)
    scale = (1.0, 1.0, 0) if full else (219 / 255, 224 / 255, 16)
    planes = [luma * scale[0] + scale[2], cb * scale[1] + 128, cr * scale[1] + 128]
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as media:
        stream = media.add_stream("libx264", rate=25, options={"qp": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, height, "yuv444p"
        if tagged:
            stream.codec_context.colorspace = matrix
            stream.codec_context.color_range = 2 if full else 1
        rows = [np.repeat(np.rint(p).astype(np.uint8), 16)[None].repeat(height, 0) for p in planes]
        frame = av.VideoFrame.from_ndarray(np.stack(rows), format="yuv444p")
        media.mux(stream.encode(frame))
        media.mux(stream.encode(None))
    assert_allclose(next(read_frames(path))[height // 2, 8::16], colours, atol=2.1)


def bad_files(folder):
    """(file, words of the error) for everything that is no usable video."""
    (folder / "folder.mp4").mkdir()
    (folder / "empty.mp4").touch()
    (folder / "text.mp4").write_text("This is a letter, not a video.\n" * 200)
    (folder / "text.nfo").write_text("This is a letter, not a video.\n" * 200)
    (folder / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(20000))
    (folder / "list.m3u8").write_text("#EXTM3U\n#EXTINF:1,\nhttp://localhost:9/a.ts\n")
    encode_sound(folder / "sound.wav", tone(0.5, 8000), 8000)
    return [
        ("missing.mp4", "no such file"),
        ("folder.mp4", "is a folder"),
        ("empty.mp4", "is empty"),
        ("text.mp4", "not a readable video"),
        ("text.nfo", "text, not video"),
        ("noise.mp4", "not a readable video"),
        ("list.m3u8", "not a readable video"),
        ("sound.wav", "has no picture"),
    ]


def test_what_is_no_video_is_said_in_one_line(tmp_path, capfd):
    for name, words in bad_files(tmp_path):
        for use in (probe, lambda path: list(read_frames(path))):
            with pytest.raises(InputError, match=words) as error:
                use(tmp_path / name)
            assert str(tmp_path / name) in str(error.value)
            assert "\n" not in str(error.value)
            assert "; " in str(error.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.77, 0.9])
@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("a.mp4", "libx264", {}),
        ("a.mp4", "libx264", {"movflags": "+faststart"}),
        ("a.mkv", "libx264", {}),
        ("a.webm", "libvpx", {}),
        ("a.avi", "mpeg4", {}),
        ("a.mpg", "mpeg1video", {}),
    ],
)
def test_truncated_files_are_found_by_probe(tmp_path, name, codec, options, share):
    rng = np.random.default_rng(1)
    path = tmp_path / name
    with av.open(str(path), "w", options=options) as media:
        stream = media.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(50):
            image = rng.integers(0, 256, (48, 64, 3), np.uint8)
            media.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        media.mux(stream.encode(None))
    assert probe(path).frames == 50
    with pytest.raises(InputError, match=r"truncated|not a readable"):
        probe(cut(path, share))


def test_a_clip_may_be_required_to_be_longer(tmp_path):
    path = encode(tmp_path / "a.mp4", grey_levels(1), codec="libx264", pixels="yuv420p")
    assert (probe(path).frames, probe(path).fps) == (1, 25)
    assert which(read_frames(path), 1) == [0]
    with pytest.raises(InputError, match=r"a\.mp4: has 1 frame\(s\) but 2 are needed"):
        probe(path, minimum_frames=2)


def test_a_change_of_size_is_an_error(tmp_path):
    small = encode(tmp_path / "a.ts", grey_levels(9), codec="mpeg2video", pixels="yuv420p")
    large = [np.zeros((96, 128, 3), np.uint8)] * 9
    encode(tmp_path / "b.ts", large, codec="mpeg2video", pixels="yuv420p", ticks=range(9, 18))
    small.write_bytes(small.read_bytes() + (tmp_path / "b.ts").read_bytes())
    with pytest.raises(InputError, match="changes its size from 64x48 to 128x96"):
        list(read_frames(small))


def test_sound_is_seen(tmp_path):
    path = encode_sound(tmp_path / "a.mkv", tone(1, 8000), 8000, frames=grey_levels(25))
    assert probe(path).has_sound
