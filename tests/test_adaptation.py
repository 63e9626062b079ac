from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from pairs import interrupt_second_step

from mmmgpu import corpus_steps
from mmmgpu.adaptation import OTHER_STEP, AdaptOptions, _face, adapt
from mmmgpu.adaptation_folds import METHODS
from mmmgpu.alignments import Alignment, cover, read_alignment, write_textgrid
from mmmgpu.corpora import open_corpus
from mmmgpu.errors import InputError
from mmmgpu.evaluation import evaluate
from mmmgpu.model_files import load
from mmmgpu.models import phonemes_of, trajectories
from mmmgpu.reconstruction import analyse_clip
from mmmgpu.video_writing import write_video
from mmmgpu.videos import read_frames

pytestmark = pytest.mark.usefixtures("kept")


@pytest.fixture(scope="module")
def before(transferred):
    """The transferred model."""
    return transferred[1]


def take_style(two_persons, before, out, *, clips=None, folder=None, **options):
    clips = clips or two_persons.second.clips
    folder = folder or two_persons.second.alignments
    return adapt(before, clips, folder, out, options=AdaptOptions(**options))


def test_prototypes_are_chosen_anew_about_the_same_reference(two_persons, before, adapted):
    out, model = adapted
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    assert len(set(model.sources)) == len(before.sources)
    i, j = model.basis.reference, before.basis.reference
    assert model.sources[i] == before.sources[j]
    np.testing.assert_allclose(model.basis.images[i], before.basis.images[j], atol=1e-3)
    assert model.basis.region == before.basis.region
    np.testing.assert_array_equal(model.basis.w_t, before.basis.w_t)
    for (name, t), picture in zip(model.sources, model.prototype_frames, strict=True):
        clip = next(c for c in two_persons.second.clips if c.name == name)
        np.testing.assert_array_equal(next(read_frames(clip, start=t, stop=t + 1)), picture)
    said = {p for s in two_persons.second.sentences for p in s.split()} | {"SIL"}
    for alpha, beta in model.dynamics.values():  # of the second person's clips alone
        assert set(alpha.labels) == set(beta.labels) == said
    assert set(model.dynamics) == {"hmm", "brand", "slds", "dpds"}


def test_the_models_before_say_the_same_in_the_new_prototypes(before, adapted):
    """A frame made of old prototypes looks the same when it is made of the new ones."""
    model = adapted[1]
    old_flow = before.basis.flow(before.alpha.trained.mean[0])
    new_flow = model.basis.flow(model.alpha.pooled.mean[0])
    weight = before.basis.w_f[..., None]
    missed = np.sqrt((weight * (new_flow - old_flow) ** 2).sum() / weight.sum())
    moved = np.sqrt((weight * old_flow**2).sum() / weight.sum())
    assert missed < 0.5 * moved
    np.testing.assert_allclose(model.beta.pooled.mean.sum(axis=1), 1, atol=0.3)


def test_adaptation_brings_the_movement_nearer(two_persons, adapted):
    """Of the clips adapted to, for both streams, and no method is worse than none on them."""
    model, second = adapted[1], two_persons.second
    errors = dict.fromkeys(("pooled", "trained", *model.alternatives), 0.0)
    for clip in second.clips:
        labels = open_corpus([clip], second.alignments)[0].labels
        found = analyse_clip(model, clip)
        for kind in errors:
            alpha, beta = trajectories(model, labels, kind=kind)
            errors[kind] += ((alpha - found.alpha) ** 2).mean() + ((beta - found.beta) ** 2).mean()
    assert errors["trained"] < 0.9 * errors["pooled"]
    assert max(errors.values()) <= errors["pooled"]


def test_other_methods_are_kept_for_comparison(two_persons, adapted):
    model = adapted[1]
    assert set(model.alternatives) == set(METHODS) - {"none", "gdlr"}
    again = load(adapted[0])
    for kind in ("pooled", "trained", *model.alternatives):
        for a, b in zip(phonemes_of(model, kind), phonemes_of(again, kind), strict=True):
            np.testing.assert_array_equal(a.mean, b.mean)
            np.testing.assert_array_equal(a.variance, b.variance)
    second = two_persons.second
    judged = evaluate(model, second.clips, second.alignments, pictures=True)
    for stream in ("alpha", "beta"):
        found = judged[stream]["speech"]
        assert set(found["rms"]) == {"pooled", "trained", "shift", "map", "mllr"}
        assert set(found["rms_gain_over"]) == {"shift", "map", "mllr"}
        for kind in found["rms_gain_over"]:
            gain = found["rms"][kind]["mean"] - found["rms"]["trained"]["mean"]
            assert found["rms_gain_over"][kind]["mean"] == pytest.approx(gain)
    psnr = judged["mouth_psnr_db_speech"]
    assert psnr["gain"]["mean"] == pytest.approx(psnr["trained"]["mean"] - psnr["pooled"]["mean"])
    assert psnr["trained"]["mean"] > 20


def test_what_was_tried_is_kept(adapted):
    found = adapted[1].notes["adaptation"]
    for stream in ("alpha", "beta"):
        curves = found["curves"][stream]
        assert set(curves) == {*METHODS, OTHER_STEP}
        assert {own["rule"] for own in curves[OTHER_STEP]["candidates"]} == {"paper"}
        for curve in curves.values():
            assert len(curve["candidates"]) == len(curve["training"]) == len(curve["validation"])
            best = curve["candidates"].index(curve["chosen"])
            assert curve["validation"][best] <= 1.01 * min(curve["validation"])
    members = [label for group in found["classes"] for label in group]
    assert sorted(members) == sorted(adapted[1].alpha.trained.labels)
    coverage = found["coverage"]
    assert coverage["frames"]["SIL"] > 0
    assert coverage["frames"]["IY"] > 0
    assert "ZH" in coverage["phones_not_seen"]
    assert "IY" not in coverage["phones_not_seen"]
    assert sum(coverage["frames"].values()) / 40 == pytest.approx(coverage["frames_per_phone"])


def test_clips_known_from_transfer_are_neither_tracked_nor_analysed_again(
    two_persons, before, adapted, tmp_path, monkeypatch
):
    """It is as if they were: the same bytes come of it."""
    done = {}

    def spy(folder, prepare, shared, step, label, pieces):
        done[step] = [piece.name for piece in pieces]
        for_all(folder, prepare, shared, step, label, pieces)

    for_all = corpus_steps.for_all
    monkeypatch.setattr(corpus_steps, "for_all", spy)
    out, clips = tmp_path / "a.mmm", two_persons.second.clips
    take_style(two_persons, before, out)
    assert set(before.tracked) == {clip.name for clip in clips}
    assert done["track"] == []
    assert not any(name.startswith("prototypes") for name in done["analysis"])
    assert out.read_bytes() == adapted[0].read_bytes()
    one = {clips[0].name: before.tracked[clips[0].name]}
    take_style(two_persons, replace(before, tracked=one), out)
    assert done["track"] == [clip.name for clip in clips[1:]]
    assert done["analysis"][-2:] == ["prototypes-0", "prototypes-1"]
    assert out.read_bytes() == adapted[0].read_bytes()


def test_steps_are_not_taken_up_for_another_face(before):
    basis, head = before.basis, before.reference.head
    name, clip = next(iter(before.tracked.items()))
    moved = replace(clip, track=replace(clip.track, poses=clip.track.poses + 1e-9))
    others = [
        replace(before, basis=replace(basis, images=basis.images[::-1])),
        replace(before, basis=replace(basis, w_t=basis.w_t / 2)),
        replace(
            before, reference=replace(before.reference, head=replace(head, to_frame=np.eye(3)))
        ),
        replace(before, tracked=before.tracked | {name: moved}),
    ]
    assert len({_face(model) for model in (before, replace(before, notes={}), *others)}) == 5


def test_an_interrupted_adaptation_continues_to_the_same_bytes(
    two_persons, before, adapted, tmp_path, monkeypatch
):
    out = tmp_path / "again.mmm"
    calls = interrupt_second_step(monkeypatch)
    strange = replace(before, tracked={})
    with pytest.raises(KeyboardInterrupt):
        take_style(two_persons, strange, out)
    take_style(two_persons, strange, out)
    assert len(calls[0]) == len(two_persons.second.clips)
    assert calls[2] == []  # nothing is tracked again
    assert out.read_bytes() == adapted[0].read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == [out.name]


@pytest.mark.parametrize(
    ("options", "kept"),
    [
        ({"method": "none"}, {"shift", "map", "mllr", "gdlr"}),
        ({"classes": "paper", "covariance": "full", "step": "paper"}, {"shift", "map", "mllr"}),
    ],
)
def test_choices_are_followed(two_persons, before, tmp_path, options, kept):
    model = take_style(two_persons, before, tmp_path / "m.mmm", **options)
    assert set(model.alternatives) == kept
    full = options.get("covariance") == "full"
    assert (model.alpha.trained.covariance is not None) == full
    if options.get("method") == "none":
        np.testing.assert_array_equal(model.alpha.trained.mean, model.alpha.pooled.mean)
    again = load(tmp_path / "m.mmm")
    for a, b in zip(phonemes_of(model), phonemes_of(again), strict=True):
        np.testing.assert_array_equal(a.covariance, b.covariance)
    labels = ["SIL", "AA", "AA", "M", "SIL"]
    for a, b in zip(trajectories(model, labels), trajectories(again, labels), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"method": "magic"}, r"method: must be one of none, shift, map, mllr, gdlr"),
        ({"classes": "mine"}, r"classes: must be one of broad, kmeans, paper"),
        ({"covariance": "half"}, r"covariance: must be one of diagonal, full"),
        ({"step": "giant"}, r"step: must be one of bounded, paper"),
    ],
)
def test_unknown_choices_are_refused(two_persons, before, tmp_path, options, says):
    with pytest.raises(InputError, match=says):
        take_style(two_persons, before, tmp_path / "m.mmm", **options)
    assert list(tmp_path.iterdir()) == []


def relabelled(two_persons, folder, label_of):
    """The alignments of the second person with other labels, in `folder`."""
    for clip in two_persons.second.clips:
        alignment = read_alignment(clip.with_suffix(".TextGrid"))
        phones = [p._replace(label=label_of(p.label)) for p in alignment.phones]
        changed = Alignment(cover(phones, alignment.duration), (), alignment.duration)
        write_textgrid(changed, folder / f"{clip.stem}.TextGrid")
    return folder


@pytest.mark.parametrize(
    ("label_of", "says"),
    [
        (lambda label: "SIL", "the clips hold no speech; give clips with several phones"),
        (lambda label: label if label == "SIL" else "AA", "hold only the phone AA; give clips"),
    ],
)
def test_too_little_speech_is_refused(two_persons, before, tmp_path, label_of, says):
    folder = relabelled(two_persons, tmp_path, label_of)
    with pytest.raises(InputError, match=says):
        take_style(two_persons, before, tmp_path / "m.mmm", folder=folder)
    assert not list(tmp_path.glob("m.mmm*"))


def test_less_than_a_second_is_refused(two_persons, before, tmp_path):
    name, _ = before.sources[before.basis.reference]
    clip = next(c for c in two_persons.second.clips if c.name == name)
    short = tmp_path / name
    write_video(short, read_frames(clip, stop=20), fps=25, lossless=True)
    alignment = read_alignment(clip.with_suffix(".TextGrid"))
    phones = [p._replace(end=min(p.end, 0.8)) for p in alignment.phones if p.start < 0.8]
    write_textgrid(Alignment(cover(phones, 0.8), (), 0.8), short.with_suffix(".TextGrid"))
    with pytest.raises(InputError, match=r"0\.80 s are too short to adapt to; give 1 s or more"):
        take_style(two_persons, before, tmp_path / "m.mmm", clips=[short], folder=tmp_path)


def test_the_clip_with_the_reference_is_needed(two_persons, before, tmp_path):
    name, _ = before.sources[before.basis.reference]
    clips = [clip for clip in two_persons.second.clips if clip.name != name]
    with pytest.raises(InputError, match=f"{name}: holds the model's reference frame"):
        take_style(two_persons, before, tmp_path / "m.mmm", clips=clips)


def test_another_frame_rate_is_refused(two_persons, before, tmp_path):
    slow = replace(before, fps=Fraction(30))
    with pytest.raises(InputError, match="has 25 frames/s, the model 30"):
        take_style(two_persons, slow, tmp_path / "m.mmm")


def test_a_model_without_phonemes_is_refused(two_persons, before, tmp_path):
    m = before.alpha.trained
    empty = replace(m, labels=(), mean=m.mean[:0], variance=m.variance[:0], count=m.count[:0])
    mute = replace(before, alpha=replace(before.alpha, trained=empty))
    with pytest.raises(InputError, match="no phoneme models; transfer from a trained model"):
        take_style(two_persons, mute, tmp_path / "m.mmm")
