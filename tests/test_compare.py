"""The command ``mmmgpu compare``, with features that were saved."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, run_command
from pairs import write_landmarks

from mmmgpu.commands.compare import _learning
from mmmgpu.corpora import open_corpus
from mmmgpu.dynamics import FIVE


@pytest.fixture
def mmmgpu(capfd):
    return lambda *args: run_command(capfd, *args)


@pytest.fixture(scope="module")
def saved(world, tmp_path_factory):
    """A folder with features of the clips: two numbers that follow the phones."""
    folder = tmp_path_factory.mktemp("features ü")
    for i, clip in enumerate(open_corpus(world.clips, world.alignments)):
        rng = np.random.default_rng(i)
        level = [[len(label), ord(label[0]) / 20] for label in clip.labels]
        y = np.array(level) + 0.3 * rng.normal(size=(len(level), 2))
        np.savez(folder / f"{clip.path.stem}.npz", features=y)
    return folder


def asked(world, saved, out, *more):
    given = ("--alignments", world.alignments, "--features", saved, "--out", out)
    return ("compare", *world.clips, *given, "--folds", "2", *more)


def test_compare(mmmgpu, world, saved, tmp_path):
    out = tmp_path / "new" / "figure 4"
    ended = mmmgpu(*asked(world, saved, out, "--json", tmp_path / "results.json"))
    assert ended.status == 0
    names = ["compare.csv", "compare.json", "figure4.png", "figure4.svg"]
    assert sorted(path.name for path in out.iterdir()) == names
    results = json.loads((tmp_path / "results.json").read_text())
    assert results == json.loads((out / "compare.json").read_text())
    assert list(results["models"]) == list(FIVE)
    assert set(results["not_comparable"]) == {"brand", "egp02"}
    assert "no distribution of the features" in results["not_comparable"]["brand"]
    assert "log-likelihood not comparable: brand, egp02 (no" in " ".join(ended.out.split())
    assert "4 sentences, 2 folds" in ended.out
    assert "hmm - brand" in ended.out
    assert ended.err.count("warning: ") == bool(results["stand_ins"])


def test_compare_some_models_with_features_of_ones_own_choice(mmmgpu, world, tmp_path):
    """The models and the appearance model that were asked for, through processes."""
    write_landmarks(world)
    chosen = ("--landmarks", world.alignments, "--parameters", 3, "--models", "slds-full, hmm")
    ended = mmmgpu(*asked(world, "aam", tmp_path, *chosen))
    assert ended.status == 0
    results = json.loads((tmp_path / "compare.json").read_text())
    assert list(results["models"]) == ["slds-full", "hmm"]
    assert {one["first"] for one in results["tests"]} == {"slds-full"}
    assert results["not_comparable"] == {}
    assert "not comparable" not in ended.out


def test_compare_with_alpha_and_beta(mmmgpu, world, tmp_path):
    """A morphable model is learned in every fold, through processes."""
    few = ("--prototypes", 3, "--models", "hmm", "--videos", tmp_path / "videos")
    args = asked(world, "mmm", tmp_path / "out", *few)
    args = [arg for arg in args if arg not in world.clips[2:]]
    ended = mmmgpu(*args)
    assert ended.status == 0, ended.err
    results = json.loads((tmp_path / "out" / "compare.json").read_text())
    names = [clip.stem for clip in world.clips[:2]]
    assert sorted(results["sentences"]) == names
    assert results["models"]["hmm"]["l1"]["folds"] == 2
    made = {path.relative_to(tmp_path / "videos") for path in tmp_path.glob("videos/*/*")}
    wanted = itertools.product(("hmm", "reality"), names)
    assert made == {Path(condition) / f"{name}.mp4" for condition, name in wanted}


def test_options_reach_the_features(mmmgpu, world, tmp_path):
    write_landmarks(world)
    args = asked(world, "aam", tmp_path / "a", "--landmarks", world.alignments)
    ended = mmmgpu(*args, "--parameters", 900)
    assert ended.status == 1
    assert "features: 90 labelled frame(s) are too few for 900 parameters" in ended.err
    assert _learning("aam", 0.5, {"parameters": None, "region": None}) == {}
    chosen = {"parameters": 4, "all_points": True}
    assert _learning("aam", 0.5, chosen) == {"parameters": 4, "rows": None}
    chosen = {"region": (1, 2, 3, 4), "prototypes": None}
    assert _learning("mmm", 0.5, chosen) == {"sync": 0.5, "region": (1, 2, 3, 4)}


USES = [
    ("mmm", ("--parameters", 3), "aam"),
    ("mmm", ("--all-points",), "aam"),
    ("aam", ("--prototypes", 4), "mmm"),
    ("aam", ("--region", "1,2,3,4"), "mmm"),
    (".", ("--region", "1,2,3,4"), "mmm"),
    (".", ("--parameters", 3), "aam"),
]


@pytest.mark.parametrize(("features", "more", "kind"), USES)
def test_options_of_other_features_are_refused(mmmgpu, world, tmp_path, features, more, kind):
    ended = mmmgpu(*asked(world, features, tmp_path / "a", *more))
    assert ended.status == 2
    assert f"Invalid value for {more[0]}: is for --features {kind}" in ended.err
    assert not (tmp_path / "a").exists()


def test_what_cannot_be_compared_is_refused(mmmgpu, world, saved, tmp_path):
    videos = ("--videos", tmp_path / "videos")
    assert_refused(mmmgpu(*asked(world, saved, tmp_path / "a", *videos)), "--videos", "pictures")
    assert_refused(mmmgpu(*asked(world, "aam", tmp_path / "a")), "--landmarks")
    assert_refused(mmmgpu(*asked(world, tmp_path / "none", tmp_path / "a")), "none")
    assert_refused(mmmgpu(*asked(world, saved, tmp_path / "a", "--folds", "5")), "4", "5")
    for names in ("hmm,sdls", "hmm,hmm", ""):
        ended = mmmgpu(*asked(world, saved, tmp_path / "a", "--models", names))
        assert_refused(ended, "models must be some of hmm, brand, slds", repr(names))
    assert list(tmp_path.rglob("*.*")) == []
