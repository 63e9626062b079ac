import av
import numpy as np
import pytest
from media import cut as cut_file
from studied import (
    CONDITIONS,
    N_FRAMES,
    pictures,
    seen_condition,
    seen_step,
    write_clip,
    write_clips,
)

from mmmgpu import study_clips
from mmmgpu.errors import InputError
from mmmgpu.sounds import read_sound
from mmmgpu.study_clips import compare_clips, find_clips
from mmmgpu.video_writing import write_video
from mmmgpu.videos import probe, read_frames


@pytest.fixture
def folder(tmp_path):
    return write_clips(tmp_path / "videos", sentences=("a b", "c"))


def compared(folder, sentence="c", *, cut=False):
    return compare_clips(sentence, find_clips(folder)[sentence], cut=cut)


def written(folder, out, *, mute=False, sentence="c", cut=False):
    out.mkdir()
    clips = study_clips.write_clips(
        out, compared(folder, sentence, cut=cut), real="reality", mute=mute
    )
    return {clip.condition: out / f"{clip.name}.mp4" for clip in clips}


def test_clips_are_found_by_sentence_and_condition(folder):
    (folder / "notes.txt").write_text("x")
    (folder / "dpds" / "notes.txt").write_text("x")
    (folder / ".hidden").mkdir()
    found = find_clips(folder)
    assert list(found) == ["a b", "c"]
    assert list(found["c"]) == sorted(CONDITIONS)
    assert found["a b"]["dpds"] == folder / "dpds" / "a b.mp4"


def test_unpaired_sentences_are_refused(folder):
    (folder / "dpds" / "c.mp4").unlink()
    with pytest.raises(InputError, match=r"dpds: has no clip of the sentence 'c', which 'brand'"):
        find_clips(folder)


def test_one_more_sentence_is_refused(folder):
    write_clip(folder, "slds", "more")
    with pytest.raises(InputError, match=r"brand: has no clip of the sentence 'more'.*'slds'"):
        find_clips(folder)


def test_a_sentence_twice_is_refused(folder):
    write_clip(folder, "slds", "c", suffix=".mkv")
    with pytest.raises(InputError, match=r"c\.mp4: the sentence is also in c\.mkv"):
        find_clips(folder)


@pytest.mark.parametrize("number", [0, 1])
def test_fewer_than_two_conditions_are_refused(tmp_path, number):
    write_clips(tmp_path, conditions=CONDITIONS[:number], sentences=("c",))
    with pytest.raises(InputError, match=f"has {number} folder.*two conditions"):
        find_clips(tmp_path)


def test_an_empty_condition_is_refused(folder):
    (folder / "empty").mkdir()
    with pytest.raises(InputError, match="empty: no video in this folder"):
        find_clips(folder)


def test_no_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match="is no folder"):
        find_clips(tmp_path / "nowhere")


def test_an_unreadable_clip_is_refused(folder):
    cut_file(folder / "slds" / "c.mp4", 0.5)
    with pytest.raises(InputError, match=r"slds/c\.mp4: "):
        compared(folder)


def test_another_length_is_refused_or_cut(folder, tmp_path):
    write_clip(folder, "slds", "c", frames=N_FRAMES - 3)
    with pytest.raises(InputError, match=r"slds/c\.mp4: has 7 frames, but .*10.*--cut"):
        compared(folder)
    files = written(folder, tmp_path / "out", cut=True)
    assert {probe(file).frames for file in files.values()} == {N_FRAMES - 3}
    lengths = {len(read_sound(file)[0]) for file in files.values()}
    assert len(lengths) == 1


def test_another_size_is_refused(folder):
    write_clip(folder, "slds", "c", size=(48, 66))
    with pytest.raises(InputError, match=r"has 66 x 48 pixels, but .*brand.* 64 x 48"):
        compared(folder, cut=True)


def test_another_rate_is_refused(folder):
    write_video(folder / "slds" / "c.mp4", pictures("slds"), fps=30)
    with pytest.raises(InputError, match=r"has 30 frames/s, but .* 25"):
        compared(folder, cut=True)


def test_every_copy_shows_its_condition(folder, tmp_path):
    for condition, file in written(folder, tmp_path / "out").items():
        frames = list(read_frames(file))
        shown = "reality" if condition is None else condition
        assert [seen_condition(frame) for frame in frames] == [shown] * N_FRAMES
        steps = [5] * N_FRAMES if condition is None else list(range(N_FRAMES))
        assert [seen_step(frame) for frame in frames] == steps


def test_every_copy_has_the_sound_of_the_real_clip(folder, tmp_path):
    files = written(folder, tmp_path / "out")
    sounds = [read_sound(file) for file in files.values()]
    samples, rate = sounds[0]
    spectrum = np.abs(np.fft.rfft(samples * np.hanning(len(samples))))
    pitch = np.fft.rfftfreq(len(samples), 1 / rate)[spectrum.argmax()]
    assert abs(pitch - 700) < 5  # the third of CONDITIONS
    for other, _ in sounds[1:]:
        np.testing.assert_array_equal(other, samples)


def test_muted_copies_have_no_sound(folder, tmp_path):
    assert not any(
        probe(f).has_sound for f in written(folder, tmp_path / "out", mute=True).values()
    )


def test_a_real_clip_without_sound_is_refused(folder, tmp_path):
    write_clip(folder, "reality", "c", rate=None)
    with pytest.raises(InputError, match=r"reality/c\.mp4: has no sound.*--mute"):
        written(folder, tmp_path / "out")


def test_other_clips_may_lack_sound_or_have_another(folder, tmp_path):
    write_clip(folder, "slds", "c", rate=None)
    write_clip(folder, "brand", "c", rate=44100)
    files = written(folder, tmp_path / "out")
    assert all(probe(file).has_sound for file in files.values())


def described(file):
    """All that a container says about itself and its streams, but for the pictures."""
    with av.open(str(file)) as media:
        streams = [
            (s.type, s.codec.name, dict(s.metadata), s.frames, s.duration, str(s.time_base))
            + ((s.profile, str(s.average_rate), s.pix_fmt) if s.type == "video" else (s.rate,))
            for s in media.streams
        ]
        return dict(media.metadata), media.duration, media.bit_rate, streams


def encoder_settings(file):
    """What libx264 writes about itself into the stream."""
    data = file.read_bytes()
    begin = data.index(b"x264 - core")
    return data[begin : data.index(b"\0", begin)]


def test_nothing_but_the_pictures_tells_copies_apart(folder, tmp_path):
    for condition in ("slds", "reality"):
        clip = folder / condition / "c.mp4"  # now one that another encoder has written
        sound = read_sound(clip)
        write_video(clip.with_suffix(".mkv"), read_frames(clip), fps=25, sound=sound, lossless=True)
        clip.unlink()
        files = written(folder, tmp_path / f"out-{condition}")
        facts = [described(file) for file in files.values()]
        assert all(fact == facts[0] for fact in facts)
        assert len({encoder_settings(file) for file in files.values()}) == 1
        assert len({file.stat().st_size for file in files.values()}) == 1
        assert {file.stat().st_mtime for file in files.values()} == {0}


def test_metadata_of_the_clips_is_left_behind(folder, tmp_path):
    path = folder / "slds" / "c.mp4"
    with av.open(str(path)) as media, av.open(str(tmp_path / "t.mp4"), "w") as out:
        out.metadata["title"], out.metadata["comment"] = "made by slds", "artificial"
        stream = out.add_stream_from_template(media.streams.video[0])
        for packet in media.demux(media.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    (tmp_path / "t.mp4").replace(path)
    assert b"artificial" in path.read_bytes()
    for file in written(folder, tmp_path / "out").values():
        assert b"artificial" not in file.read_bytes()
        assert b"slds" not in file.read_bytes()


def test_names_mean_nothing_and_are_new_each_time(folder, tmp_path):
    one, two = (written(folder, tmp_path / name) for name in ("one", "two"))
    names = [file.stem for files in (one, two) for file in files.values()]
    assert len(set(names)) == 10
    assert all(len(name) == 16 and set(name) <= set("0123456789abcdef") for name in names)


def test_odd_pictures_are_written_even(tmp_path):
    for condition in ("brand", "reality"):
        write_clip(tmp_path / "odd", condition, "c", size=(47, 63))
    files = written(tmp_path / "odd", tmp_path / "out")
    for file in files.values():
        info = probe(file)
        assert (info.width, info.height) == (64, 48)
        with av.open(str(file)) as media:
            assert media.streams.video[0].pix_fmt == "yuv420p"
    frame = next(read_frames(files["brand"])).astype(int)
    np.testing.assert_allclose(frame[:, -1], frame[:, -2], rtol=0, atol=3)
