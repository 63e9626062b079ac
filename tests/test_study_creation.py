import pytest
from studied import CONDITIONS, SENTENCES, write_clips

from mmmgpu.errors import InputError
from mmmgpu.studies import read_study
from mmmgpu.study_creation import INTRODUCTION, StudyOptions, create_study


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"), sentences=SENTENCES[:1])


def conditions_of(study):
    return [[(x.left.condition, x.right.condition) for x in p.pairs] for p in study.participants]


def test_the_folder_holds_the_plan_and_the_clips(study_folder):
    study = read_study(study_folder)
    assert study.conditions == tuple(sorted(CONDITIONS))
    assert {(c.sentence, c.condition) for c in study.clips} == {
        (s, c) for s in SENTENCES for c in (*CONDITIONS, None)
    }
    assert sorted(p.name for p in study_folder.iterdir() if "answers" not in p.name) == [
        "clips",
        "study.json",
    ]
    assert len(list((study_folder / "clips").iterdir())) == len(study.clips)
    assert study.introduction == INTRODUCTION
    assert all(len(p.pairs) == 14 for p in study.participants)


def test_the_seed_decides_the_plan_but_no_name(clips, tmp_path):
    options = StudyOptions(participants=3, seed=5)
    one, two = (create_study(clips, tmp_path / n, options=options) for n in ("one", "two"))
    assert conditions_of(one) == conditions_of(two)
    assert one.seed == 5
    assert one.id != two.id
    assert {p.token for p in one.participants}.isdisjoint(p.token for p in two.participants)
    assert {c.name for c in one.clips}.isdisjoint(c.name for c in two.clips)
    assert all(len(p.token) == 32 for p in one.participants)


def test_without_a_seed_each_plan_is_another_one_and_kept(clips, tmp_path):
    one, two = (create_study(clips, tmp_path / n) for n in ("one", "two"))
    assert conditions_of(one) != conditions_of(two)
    again = StudyOptions(seed=one.seed)
    assert conditions_of(create_study(clips, tmp_path / "x", options=again)) == conditions_of(one)


def test_an_existing_folder_is_left_as_it_is(clips, tmp_path):
    out = tmp_path / "old.study"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        create_study(clips, out)
    assert [p.name for p in tmp_path.iterdir()] == ["old.study"]
    assert (out / "notes.txt").read_text() == "mine"


def test_nothing_is_left_when_a_clip_fails(clips, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise InputError("disk full")

    monkeypatch.setattr("mmmgpu.study_clips.write_video", fail)
    with pytest.raises(InputError, match="disk full"):
        create_study(clips, tmp_path / "s")
    assert list(tmp_path.iterdir()) == []


def test_no_real_condition_is_refused_with_those_there_are(clips, tmp_path):
    with pytest.raises(InputError, match=r"'truth' is none.*--real.*brand, dpds, reality, slds"):
        create_study(clips, tmp_path / "s", options=StudyOptions(real="truth"))


@pytest.mark.parametrize(("name", "value"), [("participants", 0), ("pairs", 0), ("checks", -1)])
def test_numbers_out_of_range_are_refused(clips, tmp_path, name, value):
    with pytest.raises(InputError, match=f"--{name}: must be .* or more, is {value}"):
        create_study(clips, tmp_path / "s", options=StudyOptions(**{name: value}))
