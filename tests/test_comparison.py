import json
import warnings
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from oracles_dynamics import drawn_labels

from mmmgpu import comparison
from mmmgpu.alignments import Alignment, Segment
from mmmgpu.comparison import REALITY, CompareOptions, _Fold, compare, deal
from mmmgpu.comparison_features import SavedFeatures
from mmmgpu.comparison_scores import METRICS, score
from mmmgpu.corpora import Clip
from mmmgpu.dpds import Dpds
from mmmgpu.dynamics import FIVE, MODELS, trajectory
from mmmgpu.errors import InputError, UnsettledWarning
from mmmgpu.hmm_mean import HmmMean
from mmmgpu.videos import VideoInfo

FPS = 25


def sentence(folder, name, labels, y):
    """A clip that is no video, with its phones and saved features."""
    path = folder / f"{name}.mkv"
    path.write_bytes(name.encode())
    np.savez(folder / f"{name}.npz", features=y)
    segments = [Segment(label, t / FPS, (t + 1) / FPS) for t, label in enumerate(labels)]
    length = len(labels) / FPS
    info = VideoInfo(path, 16, 16, Fraction(FPS), len(labels), length, False)
    return Clip(path, info, Alignment(tuple(segments), (), length))


def corpus(folder, number=6):
    rng = np.random.default_rng(0)
    labels = drawn_labels(rng, number, labels=["AA", "M", "S"], length=(8, 12), first="SIL")
    walks = [rng.normal(size=(len(own), 2)).cumsum(axis=0) for own in labels]
    return [
        sentence(folder, f"s{i}", *pair) for i, pair in enumerate(zip(labels, walks, strict=True))
    ]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    clips = corpus(folder)
    options = CompareOptions(folds=2)
    return folder, clips, compare(clips, SavedFeatures(folder), folder / "work", options=options)


def test_every_sentence_is_in_one_fold():
    folds = deal(23, CompareOptions(folds=5, seed=1))
    assert sorted(i for fold in folds for i in fold) == list(range(23))
    assert {len(fold) for fold in folds} == {4, 5}
    assert folds != deal(23, CompareOptions(folds=5, seed=2))


@pytest.mark.parametrize("folds", [1, 0, 4])
def test_a_wrong_number_of_folds_is_refused(folds):
    with pytest.raises(InputError, match="folds must be between 2 and the number of clips, 3"):
        deal(3, CompareOptions(folds=folds))


def test_every_model_has_every_number_that_it_can_have(compared):
    _, clips, results = compared
    assert list(results["models"]) == list(FIVE)
    for name, found in results["models"].items():
        assert tuple(found) == METRICS
        assert (found["log_likelihood"] is None) == (not MODELS[name].comparable)
        assert found["rms"]["folds"] == 2
        assert found["rms"]["mean"] > 0
    assert sorted(results["sentences"]) == [clip.path.stem for clip in clips]
    json.dumps(results, allow_nan=False)


def test_each_fold_is_judged_by_models_of_the_others(compared):
    folder, clips, results = compared
    own = deal(len(clips), CompareOptions(folds=2))[1]
    y = [np.load(folder / f"s{i}.npz")["features"] for i in range(len(clips))]
    others = [i for i in range(len(clips)) if i not in own]
    model = Dpds.fit([y[i] for i in others], [clips[i].labels for i in others])
    made = [trajectory(model, clips[i].labels) for i in own]
    likely = [model.log_likelihood(y[i], clips[i].labels) for i in own]
    want = score(made, [y[i] for i in own], sum(likely))
    assert results["folds"][1]["dpds"] == pytest.approx(want, rel=1e-9)
    first = results["sentences"][f"s{own[0]}"]["dpds"]
    assert first == pytest.approx(score(made[:1], [y[own[0]]], likely[0]), rel=1e-9)


def test_nothing_is_left_of_the_work(compared):
    assert not (compared[0] / "work").exists()


FEW = ("hmm", "dpds")


def run_here(monkeypatch):
    """Folds are done in this process; returns the numbers of those done."""
    done = []

    def share_out(prepare, shared, items, *, processes, advance):
        for item in items:
            prepare(shared)(item, lambda: advance(1))
            done.append(item)

    monkeypatch.setattr(comparison, "share_out", share_out)
    return done


class Hasty(HmmMean):
    """A model whose fit was ended early."""

    @classmethod
    def fit(cls, sequences, labels):
        warnings.warn(UnsettledWarning("hmm: still gaining after 7 iterations"), stacklevel=2)
        return HmmMean.fit(sequences, labels)


def test_a_fit_that_was_ended_early_is_said_once_and_kept(tmp_path, monkeypatch, capfd):
    run_here(monkeypatch)
    monkeypatch.setattr(comparison, "MODELS", {"hmm": Hasty})
    options = CompareOptions(folds=2, models=("hmm",))
    results = compare(corpus(tmp_path), SavedFeatures(tmp_path), tmp_path / "w", options=options)
    one = ["hmm: still gaining after 7 iterations"]
    assert results["unsettled"] == {"fold 1": one, "fold 2": one}
    said = "warning: fits that were ended early: fold 1: hmm: still gaining after 7 iterations; "
    assert capfd.readouterr().err.count(said) == 1


def test_a_killed_comparison_goes_on_and_ends_in_the_same(tmp_path, monkeypatch):
    clips, done = corpus(tmp_path), run_here(monkeypatch)
    options, saved = CompareOptions(folds=3, models=FEW), SavedFeatures(tmp_path)
    whole = compare(clips, saved, tmp_path / "work", options=options)
    assert done == [0, 1, 2]
    done.clear()
    keep = comparison.write_step

    def killed(folder, name, arrays):
        if name == "fold-1":
            raise KeyboardInterrupt
        keep(folder, name, arrays)

    with monkeypatch.context() as patch:
        patch.setattr(comparison, "write_step", killed)
        with pytest.raises(KeyboardInterrupt):
            compare(clips, saved, tmp_path / "work", options=options)
    assert done == [0]
    done.clear()
    assert compare(clips, saved, tmp_path / "work", options=options) == whole
    assert done == [1, 2]


def test_folds_that_are_done_are_counted_and_other_features_begin_again(tmp_path, monkeypatch):
    clips, done = corpus(tmp_path), run_here(monkeypatch)
    options, saved = CompareOptions(folds=3, models=FEW), SavedFeatures(tmp_path)
    keep, counted = comparison.write_step, []

    @contextmanager
    def progress_bar(total, name):
        counted.append(total)
        yield counted.append

    def killed(folder, name, arrays):
        if name == "fold-1":
            raise KeyboardInterrupt
        keep(folder, name, arrays)

    monkeypatch.setattr(comparison, "progress_bar", progress_bar)
    for _ in range(2):
        with monkeypatch.context() as patch:
            patch.setattr(comparison, "write_step", killed)
            with pytest.raises(KeyboardInterrupt):
                compare(clips, saved, tmp_path / "work", options=options)
    assert done == [0]
    assert counted == [6, 0, 1, 1, 1, 1, 6, 2, 1, 1]  # two models of the first fold were done
    np.savez(tmp_path / "s0.npz", features=np.load(tmp_path / "s0.npz")["features"] + 1)
    compare(clips, saved, tmp_path / "work", options=options)
    assert done == [0, 0, 1, 2]


def test_a_fold_without_some_phone_is_said(tmp_path, monkeypatch, capsys):
    run_here(monkeypatch)
    clips = corpus(tmp_path)
    clips[2] = sentence(tmp_path, "s2", ["SIL", "B", "AA"], np.ones((3, 2)))
    options = CompareOptions(folds=3, models=FEW)
    results = compare(clips, SavedFeatures(tmp_path), tmp_path / "work", options=options)
    fold = next(f for f, own in enumerate(deal(6, options), start=1) if 2 in own)
    assert results["stand_ins"] == {f"fold {fold}": {"B": "M"}}
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"warning: not in every fold's training sentences: fold {fold}: M for B"


FAULTS = {
    "shorter": (np.ones((2, 2)), r"s3: features: has 2 frames but \d+ labels"),
    "NaN": (np.full((9, 2), np.nan), "s3: features: "),
    "no file": (None, r"s3: .*s3\.npz: no features of"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fold_that_fails_says_which_sentence(tmp_path, monkeypatch, fault):
    if fault != "NaN":  # that one goes through processes
        run_here(monkeypatch)
    clips, (y, message) = corpus(tmp_path), FAULTS[fault]
    (tmp_path / "s3.npz").unlink()
    if y is not None:
        clips[3] = sentence(tmp_path, "s3", clips[3].labels, y)
    options = CompareOptions(folds=2, models=FEW)
    with pytest.raises(InputError, match=rf"^fold \d, {message}") as error:
        compare(clips, SavedFeatures(tmp_path), tmp_path / "work", options=options)
    assert "\n" not in str(error.value)


def test_features_of_another_length_a_frame_name_model_and_fold(tmp_path):
    clips = corpus(tmp_path)
    clips[3] = sentence(tmp_path, "s3", clips[3].labels, np.ones((len(clips[3].labels), 5)))
    with pytest.raises(InputError, match=r"^fold 1, s3: features: .* shape \(T, 2\).* \(\d+, 5\)"):
        _Fold(0, clips, SavedFeatures(tmp_path), [0], None, FEW).run(tmp_path, lambda: None)


@dataclass(frozen=True)
class Shown(SavedFeatures):
    """Writes what it is to show."""

    def learn(self, clips, folder, fold):
        return self

    def render(self, clip, features, out):
        np.save(out, features)
        Path(f"{out}.npy").rename(out)


def test_videos_lie_by_condition_and_sentence(tmp_path):
    clips = corpus(tmp_path)
    fold = _Fold(0, clips, Shown(tmp_path), [1, 4], tmp_path / "videos", FEW)
    fold.run(tmp_path, lambda: None)
    found = {p.relative_to(tmp_path / "videos").as_posix() for p in tmp_path.glob("videos/*/*")}
    assert found == {f"{c}/s{i}.mp4" for c in ("hmm", "dpds", REALITY) for i in (1, 4)}
    real = np.load(tmp_path / "videos" / REALITY / "s4.mp4")
    np.testing.assert_array_equal(real, np.load(tmp_path / "s4.npz")["features"])


def test_videos_never_replace_the_clips(tmp_path):
    folder = tmp_path / "videos" / REALITY
    folder.mkdir(parents=True)
    clips = corpus(folder)
    own = folder / "s0.mp4"
    clips[0].path.rename(own)
    clips[0] = replace(clips[0], path=own)
    with pytest.raises(InputError, match=r"reality/s0\.mp4: would replace a clip"):
        compare(
            clips,
            SavedFeatures(folder),
            tmp_path / "work",
            videos=tmp_path / "videos",
            options=CompareOptions(folds=2),
        )
    assert own.read_bytes() == b"s0"
    assert not (tmp_path / "work").exists()


def test_arithmetic_that_fails_is_said_too(tmp_path, monkeypatch):
    class Broken(HmmMean):
        def generate(self, labels):
            raise FloatingPointError("overflow")

    monkeypatch.setattr(comparison, "MODELS", {"hmm": Broken})
    fold = _Fold(2, corpus(tmp_path), SavedFeatures(tmp_path), [0], None, ["hmm"])
    with pytest.raises(InputError, match=r"^fold 3, s0 by hmm: overflow$"):
        fold.run(tmp_path, lambda: None)
