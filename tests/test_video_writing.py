import errno
import subprocess
import sys
from fractions import Fraction

import av
import numpy as np
import pytest
from media import clicks, grey_levels, still, tone, which
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu.errors import InputError
from mmmgpu.sounds import read_sound
from mmmgpu.video_writing import write_video
from mmmgpu.videos import probe, read_frames

NTSC = Fraction(30000, 1001)


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv", "-a b.mp4", "data:日本 1%03d.MP4"])
@pytest.mark.parametrize("fps", [25, NTSC])
@pytest.mark.parametrize("size", [(48, 64), (47, 63), (47, 64)])
def test_size_rate_and_every_frame_come_back(tmp_path, monkeypatch, name, fps, size):
    monkeypatch.chdir(tmp_path)
    assert write_video(name, iter(grey_levels(31, *size)), fps=fps) == 31
    info = probe(name)
    assert (info.height, info.width, info.fps, info.frames) == (*size, fps, 31)
    assert which(read_frames(name), 31) == list(range(31))
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["a.mkv", "a.mp4", "a.mov"])
@pytest.mark.parametrize("size", [(48, 64), (47, 63), (16, 18)])
@pytest.mark.parametrize("fps", [25, NTSC])
def test_lossless_is_exact(tmp_path, name, size, fps):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (7, *size, 3), np.uint8)
    sound = rng.integers(-32768, 32768, (4000, 2)) / np.float32(32768)
    write_video(tmp_path / name, frames, fps=fps, sound=(sound, 16000), lossless=True)
    assert (probe(tmp_path / name).fps, probe(tmp_path / name).frames) == (fps, 7)
    assert_array_equal(list(read_frames(tmp_path / name)), frames)
    samples, rate = read_sound(tmp_path / name, mono=False)
    assert rate == 16000
    assert_array_equal(samples[:4000], sound)


@pytest.mark.parametrize("height", [48, 608])
@pytest.mark.parametrize("width", [128, 127])
def test_colours_survive_and_are_tagged(tmp_path, height, width):
    picture = still(height, width)
    write_video(tmp_path / "a.mp4", [picture] * 5, fps=25)
    patches = (slice(height // 6, None, height // 3), slice(width // 8, None, width // 4))
    for frame in read_frames(tmp_path / "a.mp4"):
        assert_allclose(frame[patches], np.array(picture[patches], float), rtol=0, atol=4)
    with av.open(str(tmp_path / "a.mp4")) as media:
        context = media.streams.video[0].codec_context
        tags = (context.colorspace, context.color_primaries, context.color_trc, context.color_range)
        expected = "yuv420p" if width == 128 else "yuv444p"
        assert context.pix_fmt == expected
    assert [int(t) for t in tags] == ([6, 5, 6, 1] if height == 48 else [1, 1, 1, 1])


def test_colours_have_no_bias(tmp_path):
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 256, (12, 16, 3))
    picture = np.repeat(np.repeat(colours, 16, 0), 16, 1).astype(np.uint8)
    write_video(tmp_path / "a.mp4", [picture], fps=25)
    error = next(read_frames(tmp_path / "a.mp4"))[8::16, 8::16] - colours.astype(float)
    assert_allclose(error.mean(axis=(0, 1)), 0, atol=0.4)


def event_times(path):
    """Times [s] of the first white frame and of the first loud sample, by a plain decoder."""
    with av.open(str(path)) as media:
        light = next(
            f.time for f in media.decode(video=0) if f.to_ndarray(format="gray").min() > 99
        )
    with av.open(str(path)) as media:
        for frame in media.decode(audio=0):
            loud = np.flatnonzero(np.abs(frame.to_ndarray()[0]) > 0.3)
            if len(loud):
                return light, frame.time + loud[0] / frame.rate
    raise AssertionError("no click")


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv"])
@pytest.mark.parametrize("rate", [16000, 22050, 44100, 48000, 15999])
@pytest.mark.parametrize(("fps", "flash"), [(25, 0), (25, 30), (NTSC, 41)])
def test_a_click_is_heard_with_its_flash(tmp_path, name, rate, fps, flash):
    frames = np.zeros((60, 48, 64, 3), np.uint8)
    frames[flash] = 255
    sound = clicks(float(60 / fps), rate, [float(flash / fps)])
    write_video(tmp_path / name, frames, fps=fps, sound=(sound, rate))
    light, click = event_times(tmp_path / name)
    assert light == pytest.approx(float(flash / fps), abs=0.002)
    assert click == pytest.approx(light, abs=0.004)
    samples, own = read_sound(tmp_path / name)
    assert np.argmax(samples > 0.3) / own == pytest.approx(float(flash / fps), abs=0.004)
    assert len(samples) / own == pytest.approx(float(60 / fps), abs=0.05)


@pytest.mark.parametrize("lossless", [False, True])
def test_sound_of_another_length_is_written_whole(tmp_path, lossless):
    for seconds in (0.3, 1.7):
        sound = (tone(seconds, 16000), 16000)
        path = tmp_path / "a.mkv"
        write_video(path, grey_levels(25), fps=25, sound=sound, lossless=lossless)
        samples, _ = read_sound(path)
        assert seconds * 16000 <= len(samples) <= seconds * 16000 + 2048


def test_frames_are_taken_one_at_a_time(tmp_path):
    """The writer must not hold on to frames: each is overwritten after it was given."""
    buffer = np.zeros((48, 64, 3), np.uint8)
    levels = grey_levels(40)

    def frames():
        for level in levels:
            buffer[:] = level
            yield buffer

    write_video(tmp_path / "a.mkv", frames(), fps=25, lossless=True)
    assert_array_equal(list(read_frames(tmp_path / "a.mkv")), levels)


def failing(error):
    yield from grey_levels(30)
    raise error


@pytest.mark.parametrize("error", [RuntimeError("broken"), KeyboardInterrupt(), InputError("bad")])
@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_an_exception_leaves_the_old_file_and_nothing_else(tmp_path, error, name):
    (tmp_path / name).write_text("old")
    with pytest.raises(type(error)) as caught:
        write_video(tmp_path / name, failing(error), fps=25, sound=(tone(2, 8000), 8000))
    assert caught.value is error
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [(name, "old")]


def test_what_cannot_be_written_is_said_in_one_line(tmp_path):
    (tmp_path / "folder.mp4").mkdir()
    (tmp_path / "file").touch()
    mixed = [*grey_levels(3), still(50, 64)]
    for name, frames, words in [
        ("a.webm", grey_levels(3), r"name it \.mp4, \.mov or \.mkv"),
        ("a", grey_levels(3), r"name it \.mp4, \.mov or \.mkv"),
        ("a.mp4", [], "there are no frames"),
        ("a.mp4", mixed, r"frame 3 has shape \(50, 64, 3\), the first one \(48, 64, 3\)"),
        ("folder.mp4", grey_levels(3), "it is a folder"),
        ("file/a.mp4", grey_levels(3), "is a file, not a folder"),
        ("missing/a.mp4", grey_levels(3), "folder does not exist"),
    ]:
        with pytest.raises(InputError, match=words) as error:
            write_video(tmp_path / name, frames, fps=25)
        assert str(tmp_path / name) in str(error.value)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="sound has 3 channels"):
        write_video(tmp_path / "a.mp4", frames, fps=25, sound=(np.zeros((9, 3)), 8000))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.mp4"]


WRITE_TO_A_LIMIT = """
import resource, sys
import numpy as np
from mmmgpu.errors import InputError
from mmmgpu.video_writing import write_video
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
noise = np.random.default_rng(0).integers(0, 256, (40, 96, 128, 3), np.uint8)
try:
    write_video(sys.argv[1], noise, fps=25, lossless=sys.argv[2] == "lossless")
except InputError as error:
    print(error)
"""


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
@pytest.mark.parametrize("kind", ["lossy", "lossless"])
def test_a_disk_that_takes_no_more(tmp_path, name, kind):
    """A limit on the size of files fails in the same system call as a full disk does."""
    command = [sys.executable, "-W", "error", "-c", WRITE_TO_A_LIMIT, str(tmp_path / name), kind]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert done.stdout.startswith(f"cannot write {tmp_path / name}: ")
    assert "the file system takes no file that large" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match=r"a\.mp4: the disk is full: free some space"):
        write_video(tmp_path / "a.mp4", grey_levels(3), fps=25)
    assert list(tmp_path.iterdir()) == []
