import csv
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request

import pytest
from commands import assert_refused, run_command
from studied import CONDITIONS, SENTENCES, Person, write_clip, write_clips

from mmmgpu.commands import study as command
from mmmgpu.studies import read_study
from mmmgpu.study_creation import INTRODUCTION, StudyOptions
from mmmgpu.study_store import Answer, _answers, open_store
from mmmgpu.web_pages import LOOPBACK


@pytest.fixture
def mmmgpu(capfd):
    return lambda *args: run_command(capfd, "study", *args)


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"), sentences=SENTENCES[:1])


@pytest.fixture
def folder(study_folder, tmp_path):
    return shutil.copytree(study_folder, tmp_path / "s.study")


def free_port():
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


@pytest.mark.parametrize("name", command.EXAMPLES)
def test_help_has_an_example_and_machine_readable_results(mmmgpu, name):
    ended = mmmgpu(name, "--help")
    assert ended.status == 0
    assert f"mmmgpu study {name}" in ended.out.partition("Example")[2]
    assert "--json FILE" in ended.out


def test_help_names_every_command(mmmgpu):
    words = mmmgpu("--help").out
    assert all(f"\n  {name} " in words for name in command.EXAMPLES)
    assert "..." not in words.partition("Commands:")[2]


def test_the_study_is_among_the_commands(capfd):
    assert "\n  study " in run_command(capfd, "--help").out


def test_create_says_where_the_study_is_and_what(mmmgpu, clips, tmp_path):
    (tmp_path / "intro.txt").write_text("Wählen Sie.\n")
    options = ("--participants", 3, "--pairs", 5, "--checks", 1, "--seed", 7, "--mute")
    options += ("--introduction", tmp_path / "intro.txt", "--json", tmp_path / "facts.json")
    ended = mmmgpu("create", clips, "--out", tmp_path / "s", *options)
    assert (ended.status, ended.out) == (0, f"{tmp_path / 's'}\n")
    plan = read_study(tmp_path / "s")
    assert plan.introduction == "Wählen Sie."
    assert [len(p.pairs) for p in plan.participants] == [6, 6, 6]
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts == {
        "study": str(tmp_path / "s"),
        "id": plan.id,
        "seed": 7,
        "conditions": sorted(CONDITIONS),
        "real": "reality",
        "sentences": ["lay blue"],
        "participants": 3,
        "pairs": 15,
        "checks": 3,
    }


def test_create_has_the_defaults_of_the_library(mmmgpu, clips, tmp_path):
    mmmgpu("create", clips, "--out", tmp_path / "s")
    plan = read_study(tmp_path / "s")
    assert plan.introduction == INTRODUCTION
    assert plan.real == StudyOptions().real
    assert len(plan.participants) == StudyOptions().participants
    assert all(sum(not p.is_check for p in x.pairs) == 12 for x in plan.participants)
    assert all(sum(p.is_check for p in x.pairs) == 2 for x in plan.participants)


def test_create_with_another_real_condition_and_cut_clips(mmmgpu, clips, tmp_path):
    changed = shutil.copytree(clips, tmp_path / "clips")
    shutil.rmtree(changed / "reality")
    write_clip(changed, "slds", SENTENCES[0], frames=6)
    refused = mmmgpu("create", changed, "--out", tmp_path / "s")
    assert_refused(refused, "'reality' is none", "--real", "brand, dpds, slds")
    args = ("create", changed, "--out", tmp_path / "s", "--real", "dpds")
    assert_refused(mmmgpu(*args), "--cut", "6 frames")
    assert not (tmp_path / "s").exists()
    assert mmmgpu(*args, "--cut").status == 0


def test_create_takes_the_conditions_that_are_chosen(mmmgpu, clips, tmp_path):
    args = ("create", clips, "--out", tmp_path / "s", "--conditions")
    refused = mmmgpu(*args, "reality,hmm")
    assert_refused(refused, clips, "no folder 'hmm'", "brand, dpds, reality, slds")
    assert_refused(mmmgpu(*args, "reality"), "two conditions at least")
    assert_refused(mmmgpu(*args, "brand,dpds"), "'reality' is none", "brand, dpds")
    assert mmmgpu(*args, "reality, dpds").status == 0
    plan = read_study(tmp_path / "s")
    assert plan.conditions == ("dpds", "reality")
    assert {clip.condition for clip in plan.clips} == {"dpds", "reality", None}
    assert all(sum(not p.is_check for p in x.pairs) == 2 for x in plan.participants)


BAD_INTRODUCTIONS = {"empty": b" \n", "not UTF-8": b"\xff\xfe", "missing": None}


@pytest.mark.parametrize("fault", BAD_INTRODUCTIONS)
def test_a_bad_introduction_is_refused(mmmgpu, clips, tmp_path, fault):
    if BAD_INTRODUCTIONS[fault] is not None:
        (tmp_path / "i.txt").write_bytes(BAD_INTRODUCTIONS[fault])
    ended = mmmgpu("create", clips, "--out", tmp_path / "s", "--introduction", tmp_path / "i.txt")
    assert_refused(ended, tmp_path / "i.txt")
    assert not (tmp_path / "s").exists()


def test_bad_clips_are_one_line_and_leave_nothing(mmmgpu, clips, tmp_path):
    changed = shutil.copytree(clips, tmp_path / "clips")
    write_clip(changed, "slds", "more")
    assert_refused(mmmgpu("create", changed, "--out", tmp_path / "s"), "'more'", "'slds'")
    (changed / "slds" / "more.mp4").unlink()
    (changed / "slds" / f"{SENTENCES[0]}.mp4").write_bytes(b"no video")
    assert_refused(mmmgpu("create", changed, "--out", tmp_path / "s"), "not a readable video")
    assert [p.name for p in tmp_path.iterdir()] == ["clips"]


def test_an_existing_study_is_left_as_it_is(mmmgpu, clips, folder):
    before = (folder / "study.json").read_bytes()
    assert_refused(mmmgpu("create", clips, "--out", folder), folder, "exists already")
    assert (folder / "study.json").read_bytes() == before


@pytest.mark.parametrize("name", ["serve", "results"])
def test_what_is_no_study_is_refused(mmmgpu, tmp_path, name):
    assert_refused(mmmgpu(name, tmp_path), "study.json", "mmmgpu study create")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["serve", "results"])
def test_answers_to_another_study_are_refused(mmmgpu, clips, folder, tmp_path, name):
    with open_store(folder, read_study(folder)):
        mmmgpu("create", clips, "--out", tmp_path / "other", "--participants", 1)
    (folder / "answers.db").rename(tmp_path / "other" / "answers.db")
    assert_refused(mmmgpu(name, tmp_path / "other"), "answers.db", "another study")


@pytest.mark.parametrize("name", ["serve", "results"])
def test_a_missing_extra_is_named(mmmgpu, folder, monkeypatch, name):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert_refused(mmmgpu(name, folder), "pip install 'mmmgpu[web]'")


def test_a_taken_port_is_refused(mmmgpu, folder):
    with socket.create_server((LOOPBACK, 0)) as taken:
        port = taken.getsockname()[1]
        assert_refused(mmmgpu("serve", folder, "--port", port), f"--port {port}", "choose others")


def start(folder, *options):
    """Serve the study in a process of its own; the process and its links."""
    args = [sys.executable, "-m", "mmmgpu", "study", "serve", folder, *map(str, options)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    server = subprocess.Popen(args, text=True, **pipes)
    return server, [server.stdout.readline().strip() for _ in range(50)]


def test_a_study_is_served_until_it_is_interrupted(mmmgpu, folder, tmp_path):
    port = free_port()
    server, links = start(folder, "--port", port, "--json", tmp_path / "s.json")
    tokens = [p.token for p in read_study(folder).participants]
    assert links == [f"http://{LOOPBACK}:{port}/{token}/" for token in tokens]
    assert json.loads((tmp_path / "s.json").read_text())["links"] == links
    with urllib.request.urlopen(links[2], timeout=20) as page:
        assert b"Which one is real?" in page.read()
    person = Person(links[2])
    assert person.answer(1, "left")[0] == 200
    server.send_signal(signal.SIGINT)
    out, err = server.communicate(timeout=30)
    person.leave()
    assert server.returncode == 130
    assert out == ""
    assert f"the study is at http://{LOOPBACK}:{port}/ (Ctrl-C ends" in err
    assert "Traceback" not in err
    ended = mmmgpu("results", folder, "--json", tmp_path / "r.json")
    assert ended.status == 0
    assert json.loads((tmp_path / "r.json").read_text())["participants"]["begun"] == 1


def test_links_begin_with_the_public_address(folder):
    server, links = start(folder, "--port", 0, "--address", "https://example.org/lips/")
    server.kill()
    server.communicate()
    assert links[0] == f"https://example.org/lips/{read_study(folder).participants[0].token}/"


def answered(folder, url=None):
    """Let everybody answer: dpds, reality, brand, slds is the order, of one in five reversed."""
    plan, rows = read_study(folder), []
    with open_store(folder, plan, url=url) as store:
        for number, participant in enumerate(plan.participants, start=1):
            for n, pair in enumerate(participant.pairs, start=1):
                ranks = ["slds", "brand", "reality", "dpds"]
                rank = {c: ranks.index(c) for c in CONDITIONS} | {None: -1}
                left = rank[pair.left.condition] > rank[pair.right.condition]
                left = left != (number % 5 == 1 and not pair.is_check)
                choice = "left" if left else "right"
                rows.append(Answer(number, n, choice, "2026-01-01T00:00:00+00:00"))
        with store._engine.begin() as connection:  # at once: 700 commits take their time
            connection.execute(_answers.insert(), [vars(row) for row in rows])
    return plan


def test_results_are_shown_and_written(mmmgpu, folder, tmp_path):
    answered(folder)
    out = tmp_path / "r.json"
    ended = mmmgpu("results", folder, "--json", out, "--csv", tmp_path / "tables")
    assert ended.status == 0
    found = json.loads(out.read_text())
    assert found["scale"]["order"] == "dpds > reality > brand > slds"
    assert "dpds > reality > brand > slds" in ended.out
    assert "50 invited, 50 begun, 50 finished" in ended.out
    assert "failed attention checks: nobody" in ended.out
    with (tmp_path / "tables" / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["a"], r["b"], int(r["prefer_a"]), int(r["prefer_b"])) for r in rows] == [
        (r["a"], r["b"], r["prefer_a"], r["prefer_b"]) for r in found["table"]
    ]
    assert sum(int(r["prefer_a"]) + int(r["prefer_b"]) for r in rows) == 600


def test_results_come_from_postgresql(mmmgpu, folder, postgres_url, tmp_path):
    answered(folder, postgres_url)
    args = ("results", folder, "--database", postgres_url, "--json", tmp_path / "r.json")
    assert mmmgpu(*args).status == 0
    assert json.loads((tmp_path / "r.json").read_text())["participants"]["finished"] == 50
    assert not (folder / "answers.db").exists()


def test_results_with_errors_and_without_the_careless(mmmgpu, folder, tmp_path):
    plan = answered(folder)
    check = next(n for n, p in enumerate(plan.participants[49].pairs, start=1) if p.is_check)
    with open_store(folder, plan) as store, store._engine.begin() as connection:
        own = (_answers.c.participant == 50) & (_answers.c.pair == check)
        connection.execute(_answers.update().where(own).values(choice="undecided"))
    lines = [f"{c},{s},L1,{i}" for i, c in enumerate(CONDITIONS) for s in SENTENCES]
    (tmp_path / "e.csv").write_text("condition,sentence,metric,value\n" + "\n".join(lines))
    args = ("results", folder, "--errors", tmp_path / "e.csv", "--exclude-failed")
    ended = mmmgpu(*args, "--csv", tmp_path / "t")
    assert "failed attention checks: 50; left out" in ended.out
    assert "the clip of lower L1 was chosen" in ended.out
    assert len((tmp_path / "t" / "errors.csv").read_text().splitlines()) == 5


def test_a_bad_table_of_errors_is_refused(mmmgpu, folder, tmp_path):
    (tmp_path / "e.csv").write_text("condition,sentence,metric,value\nnobody,x,L1,1\n")
    ended = mmmgpu("results", folder, "--errors", tmp_path / "e.csv")
    assert_refused(ended, "e.csv", "none of the study's conditions")


def test_results_before_anybody_has_answered(mmmgpu, folder):
    ended = mmmgpu("results", folder)
    assert ended.status == 0
    assert "no ranking: brand was never chosen" in ended.out
    assert re.search(r"50 invited, 0 begun", ended.out)


def test_serving_is_not_started_by_loading_the_command():
    program = "import sys, mmmgpu.cli; print(*{m.partition('.')[0] for m in sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, env=dict(os.environ)
    )
    assert {"starlette", "uvicorn", "sqlalchemy", "psycopg"} & set(
        done.stdout.decode().split()
    ) == set()
