import json
from collections import Counter

import numpy as np
import pytest

from mmmgpu import demo
from mmmgpu.demo import HELD_OUT, NEW, Script, make_demo, mouth_closeup, write_side_by_side
from mmmgpu.demo_second import SECOND, Second
from mmmgpu.errors import InputError
from mmmgpu.figures import CAPTION_HEIGHT
from mmmgpu.model_files import load
from mmmgpu.performances import SENTENCES, Stage
from mmmgpu.sounds import read_sound
from mmmgpu.video_writing import write_video
from mmmgpu.videos import probe, read_frames
from mmmgpu.voices import say

pytestmark = pytest.mark.usefixtures("kept")

SHORT = {
    "seed": 5,
    "script": Script(("Papa bought a boat.", "We saw five fish."), ("My map.", "Oh boy."), "Bye."),
    "prototypes": 6,
    "second": Second(8, ("Two boats.", "See my map."), ("Five fish.",)),
    "stage": Stage(size=(144, 160), silence=0.2, pace=220),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("a demo")
    return out, make_demo(out, **SHORT)


def test_everything_lies_in_one_folder(made):
    out, results = made
    assert {path.name for path in out.iterdir()} == {
        "corpus",
        "model.mmm",
        "model.json",
        "spoken.mp4",
        "side-by-side.mp4",
        "report.html",
        "results.json",
        "second",
        "points.json",
        "transferred.mmm",
        "adapted.mmm",
        "second-before.mp4",
        "second-after.mp4",
        "second-side-by-side.mp4",
        "transfer-report.html",
    }
    assert json.loads((out / "results.json").read_text()) == results
    assert results["evaluation"]["clips"] == ["held-out-01.mp4", "held-out-02.mp4"]
    assert "also_in_training" not in results["evaluation"]
    assert "lips" in results["evaluation"]


def test_the_new_sentence_has_picture_and_sound_of_one_length(made):
    info = probe(made[0] / "spoken.mp4")
    samples, rate = read_sound(made[0] / "spoken.mp4")
    assert (info.width, info.height, info.fps) == (160, 144, 25)
    assert abs(info.duration - len(samples) / rate) <= 1 / 25
    assert np.abs(samples).max() > 0.1


def test_real_reconstructed_and_spoken_stand_side_by_side(made):
    out, _ = made
    info, real = (probe(out / name) for name in ("side-by-side.mp4", "corpus/held-out-01.mp4"))
    assert (info.width, info.frames, info.has_sound) == (3 * 160, real.frames, True)
    for together, alone in zip(
        read_frames(out / "side-by-side.mp4"), read_frames(real.path), strict=True
    ):
        shown = together[CAPTION_HEIGHT:][:144].reshape(144, 3, 160, 3).astype(int)
        error = np.abs(shown - alone[:, None]).mean(axis=(0, 2, 3))
        assert error[0] < 2  # of 255, by H.264
        assert error[1] < 4  # the reconstruction
    assert np.abs(shown[:60, 2] - shown[:60, 0]).max() > 20  # the spoken one moves its own head


def test_the_report_shows_both_videos(made):
    page = (made[0] / "report.html").read_text()
    assert page.count("data:video/mp4") == 2
    assert "Bye." in page
    assert "Errors" in page


def test_the_second_performer_speaks_before_and_after(made):
    out, results = made
    spoken = probe(out / "spoken.mp4")
    both = probe(out / "second-side-by-side.mp4")
    assert (both.width, both.frames, both.has_sound) == (2 * 160, spoken.frames, True)
    first, second = load(out / "model.mmm"), load(out / "adapted.mmm")
    assert set(second.notes["clips"]) == {"adapt-01.mp4", "adapt-02.mp4"}
    assert len(second.sources) == len(first.sources)
    judged = results["second"]["evaluation"]
    assert judged["clips"] == ["judge-01.mp4"]
    assert "also_in_training" not in judged
    assert results["second"]["adaptation"]["coverage"]["frames"]["IY"] > 0
    page = (out / "transfer-report.html").read_text()
    assert page.count("data:video/mp4") == 2
    assert "Adaptation" in page


def test_a_finished_demo_keeps_its_model_and_says_what_to_open(made, monkeypatch, capsys):
    out, results = made

    def refuse(*args, **options):
        raise AssertionError("trained again")

    monkeypatch.setattr(demo, "train", refuse)
    again = make_demo(out, **SHORT)
    said = capsys.readouterr()
    assert again["evaluation"] == results["evaluation"]
    assert str(out / "report.html") in said.out.splitlines()[-1]
    assert str(out / "second-side-by-side.mp4") in said.out.splitlines()[-1]
    assert len(said.out.splitlines()) == 1
    assert "demo: learn the mouth" in said.err
    with pytest.raises(AssertionError, match="trained again"):
        make_demo(out, **{**SHORT, "prototypes": 5})


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        make_demo(tmp_path / "file" / "demo", **SHORT)


def test_without_a_voice_nothing_is_begun(tmp_path, monkeypatch):
    monkeypatch.setattr("mmmgpu.performances.is_installed", lambda: False)
    with pytest.raises(InputError, match=r"mmmgpu\[tts\]"):
        make_demo(tmp_path / "demo", **SHORT)
    assert not (tmp_path / "demo").exists()


def test_what_is_judged_was_not_learned():
    assert not set(SECOND.judged) & {*SECOND.adapted, *SENTENCES}
    assert not {*HELD_OUT, NEW} & set(SENTENCES)
    assert not [sentence for sentence, n in Counter([*SENTENCES, *HELD_OUT]).items() if n > 1]
    known = {phone.label for phone in say(" ".join(SENTENCES)).alignment.phones}
    assert {phone.label for phone in say(" ".join([*HELD_OUT, NEW])).alignment.phones} <= known


def test_videos_of_odd_size_still_play(tmp_path):
    paths = []
    for name, level in (("a", 40), ("b", 200)):
        paths.append(tmp_path / f"{name}.mkv")
        frames = [np.full((33, 31, 3), level, np.uint8)] * 2
        sound = (np.zeros(1600, np.float32), 16000)
        write_video(paths[-1], frames, fps=25, sound=sound, lossless=True)
    out = tmp_path / "both.mp4"
    write_side_by_side({"a": paths[0], "b": paths[1]}, out, mouth=(15, 20, 10))
    info = probe(out)
    assert (info.width % 2, info.height % 2, info.frames) == (0, 0, 2)
    frame = next(iter(read_frames(out)))[CAPTION_HEIGHT:]
    np.testing.assert_allclose(frame[5:-5, 5:25], 40, rtol=0, atol=4)
    np.testing.assert_allclose(frame[5:-5, 37:57], 200, rtol=0, atol=4)


def test_the_closeup_shows_the_mouth_in_the_middle():
    y, x = np.mgrid[:80, :100]
    frame = np.stack([x, y, x], axis=-1).astype(np.uint8)
    closer = mouth_closeup(frame, (60.0, 40.0, 20.0))
    assert closer.shape == (60, 100, 3)
    np.testing.assert_allclose(closer[30, 50, :2], (60, 40), rtol=0, atol=1)
    np.testing.assert_allclose(closer[30, 90, :2], (80, 40), rtol=0, atol=1)  # half the size


def test_the_closeup_of_a_mouth_as_wide_as_the_picture_is_the_picture():
    frame = np.random.default_rng(0).integers(0, 255, (60, 100, 3)).astype(np.uint8)
    np.testing.assert_array_equal(mouth_closeup(frame, (50.0, 30.0, 90.0)), frame)
