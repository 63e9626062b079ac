import wave
from fractions import Fraction

import numpy as np
import pytest
from media import clicks, encode, encode_sound, grey_levels, song_with_cover, tone
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu.errors import InputError
from mmmgpu.sounds import (
    PEAK,
    check_sync,
    checked_speech,
    energy,
    levelled,
    read_sound,
    read_wav,
    resample,
    write_wav,
)
from mmmgpu.videos import VideoInfo, probe


@pytest.mark.parametrize(
    ("name", "codec", "sample_format", "atol"),
    [
        ("a.wav", "pcm_u8", "u8", 1 / 128),
        ("a.wav", "pcm_s16le", "s16", 1e-4),
        ("a.wav", "pcm_s24le", "s32", 1e-6),
        ("a.wav", "pcm_s32le", "s32", 1e-6),
        ("a.wav", "pcm_f32le", "flt", 1e-7),
        ("a.wav", "pcm_f64le", "dbl", 1e-7),
        ("a.flac", "flac", "s16", 1e-4),
        ("a.mp4", "aac", "fltp", 0.05),
        ("a.ogg", "libopus", "flt", 0.05),
    ],
)
@pytest.mark.parametrize("channels", [1, 2])
def test_every_format_gives_the_same_samples(tmp_path, name, codec, sample_format, atol, channels):
    rate = 48000
    sent = tone(0.6, rate, channels=channels)
    path = encode_sound(tmp_path / name, sent, rate, codec=codec, sample_format=sample_format)
    got, got_rate = read_sound(path, mono=False)
    assert (got.dtype, got.shape[1], got_rate) == (np.float32, channels, rate)
    assert len(sent) <= len(got) <= len(sent) + 2048  # lossy codecs fill their last block
    middle = slice(rate // 10, rate // 2)
    assert_allclose(got[middle], sent[middle], rtol=0, atol=atol)
    assert_allclose(read_sound(path)[0], got.mean(axis=1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("rate", [8000, 11025, 22050, 44100, 48000])
@pytest.mark.parametrize("new_rate", [8000, 16000, 44100])
def test_resampling_keeps_time_and_length(rate, new_rate):
    sent = tone(0.5, rate)[:, 0]
    got = resample(sent, rate, new_rate)
    assert (len(got), got.dtype) == (round(len(sent) * new_rate / rate), np.float32)
    inner = slice(new_rate // 20, -new_rate // 20)
    assert_allclose(got[inner], tone(0.5, new_rate)[: len(got), 0][inner], rtol=0, atol=2e-3)
    assert_array_equal(resample(np.stack([sent, sent], 1), rate, new_rate)[:, 1], got)


def test_resampling_nothing_gives_nothing():
    assert resample(np.zeros(0, np.float32), 8000, 16000).shape == (0,)


def test_reading_resamples(tmp_path):
    path = encode_sound(tmp_path / "a.wav", tone(0.5, 44100, channels=2), 44100)
    samples, rate = read_sound(path, rate=16000)
    assert (rate, samples.shape) == (16000, (8000,))
    assert_allclose(samples[800:7200], 0.75 * tone(0.5, 16000)[800:7200, 0], rtol=0, atol=2e-3)


@pytest.mark.parametrize(("picture", "sound"), [(0, 0), (0, 0.2), (0.4, 0), (0.2, 0.4), (0.4, 0.2)])
def test_sample_0_is_the_beginning_of_the_picture(tmp_path, picture, sound):
    rate = 8000
    sent = clicks(1.5, rate, [0.7])[:, None]
    path = encode_sound(
        tmp_path / "a.mkv",
        sent,
        rate,
        frames=grey_levels(25),
        at=[("picture", picture), (0, sound)],
    )
    samples, _ = read_sound(path)
    assert np.argmax(samples > 0.4) / rate == pytest.approx(0.7 + sound - picture, abs=0.002)


def test_a_cover_picture_is_no_video(tmp_path):
    path = song_with_cover(tmp_path / "a.mp4", tone(1, 16000), 16000)
    assert len(read_sound(path)[0]) == pytest.approx(16000, abs=1024)
    with pytest.raises(InputError, match="has no picture"):
        probe(path)


def test_dropouts_become_silence_and_jitter_does_not(tmp_path):
    rate = 8000
    sent = np.full((8000, 1), 0.5, np.float32)
    at = [(2, 0.01), (3, -0.01), (5, 0.3)]
    samples, _ = read_sound(encode_sound(tmp_path / "a.mkv", sent, rate, at=at))
    silent = np.flatnonzero(samples == 0)
    assert len(samples) == 8000 + 2400
    assert (silent[0], silent[-1], len(silent)) == (5000, 7399, 2400)


def test_wav_files_are_read_as_written(tmp_path):
    sent = np.random.default_rng(0).integers(-32768, 32768, 4001) / np.float32(32768)
    write_wav(tmp_path / "a b.wav", sent, 22050)
    got, rate = read_wav(tmp_path / "a b.wav")
    assert rate == 22050
    assert_array_equal(got, sent)
    write_wav(tmp_path / "c.wav", np.stack([sent, -sent / 2], 1), 22050)
    assert read_sound(tmp_path / "c.wav", mono=False)[0].shape == (4001, 2)


def test_loud_samples_clip_and_do_not_wrap(tmp_path):
    write_wav(tmp_path / "a.wav", np.array([-3.0, 0, 3.0], np.float32), 8000)
    with wave.open(str(tmp_path / "a.wav")) as file:
        assert np.frombuffer(file.readframes(3), "<i2").tolist() == [-32768, 0, 32767]


def test_files_without_sound_are_said_in_one_line(tmp_path):
    encode(tmp_path / "silent.mkv", grey_levels(5))
    (tmp_path / "empty.wav").touch()
    (tmp_path / "text.wav").write_text("no sound " * 100)
    write_wav(tmp_path / "nothing.wav", np.zeros(0, np.float32), 8000)
    for name, words in [
        ("silent.mkv", "has no sound"),
        ("empty.wav", "is empty"),
        ("text.wav", "not a readable"),
        ("nothing.wav", "cannot be decoded|not a readable"),
        ("missing.wav", "no such file"),
    ]:
        with pytest.raises(InputError, match=words) as error:
            read_sound(tmp_path / name)
        assert str(tmp_path / name) in str(error.value)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(("seconds", "word"), [(2.4, "shorter"), (3.6, "longer")])
def test_sound_and_picture_of_different_length(tmp_path, seconds, word):
    info = VideoInfo(tmp_path / "a.mp4", 64, 48, Fraction(25), 75, 3.0, True)
    for good in (2.5, 3.0, 3.5):
        check_sync(info, (np.zeros(round(good * 8000), np.float32), 8000))
    with pytest.raises(InputError, match=rf"a\.mp4: the sound \({seconds:.2f} s\) is {word}"):
        check_sync(info, (np.zeros(round(seconds * 8000), np.float32), 8000))


@pytest.mark.parametrize("fps", [25, 30000 / 1001])
@pytest.mark.parametrize("n_frames", [0, 1, 20, 40])  # 40 frames: longer than the sound
def test_energy_is_the_rms_of_each_frame(fps, n_frames):
    rate = 11025
    samples = np.random.default_rng(1).normal(0, 0.2, rate).astype(np.float32)
    expected = []
    for t in range(n_frames):
        begin, end = round(t * rate / fps), round((t + 1) * rate / fps)
        inside = [float(samples[i]) if i < rate else 0.0 for i in range(begin, end)]
        expected.append(np.sqrt(sum(s * s for s in inside) / (end - begin)))
    assert_allclose(energy(samples, rate, n_frames, fps), expected, rtol=1e-6, atol=1e-12)


def test_speech_is_brought_to_one_level():
    sound = 0.01 * np.sin(np.arange(8000) / 10)
    got = levelled(sound, 8000, 16000)
    assert len(got) == 16000
    assert np.abs(got).max() == pytest.approx(PEAK)
    assert_allclose(got[2000:14000:2], sound[1000:7000] * (PEAK / 0.01), atol=0.01)
    with pytest.raises(InputError, match="the sound is silent or too short"):
        levelled(np.zeros(100), 8000, 16000)


@pytest.mark.parametrize(
    ("samples", "rate", "message"),
    [
        (np.zeros((5, 2)), 8000, r"samples must be mono, shape \(N,\), N > 0, got \(5, 2\)"),
        ([], 8000, "samples must be mono"),
        ([0.0, np.nan], 8000, "NaN or infinity"),
        ([0.0], 0, "rate must be > 0"),
    ],
)
def test_what_is_no_speech(samples, rate, message):
    assert_array_equal(checked_speech([0.25, 1], 8000), np.array([0.25, 1.0]))
    with pytest.raises(InputError, match=message):
        checked_speech(samples, rate)
