import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from importlib import resources

import numpy as np
import pytest
from studied import CONDITIONS, SENTENCES, Person

from mmmgpu.errors import InputError
from mmmgpu.studies import CHOICES, clip_path, read_study
from mmmgpu.study_server import LARGEST_BODY, PAGE_FILES, StudyPage, serving
from mmmgpu.study_store import open_store
from mmmgpu.web_pages import LOOPBACK

PAGE = resources.files("mmmgpu.study_page")


class Served:
    """A study that is being served."""

    def __init__(self, folder, store, port):
        self.study, self.folder, self.store, self.port = read_study(folder), folder, store, port

    def link(self, number=1):
        token = self.study.participants[number - 1].token
        return f"http://{LOOPBACK}:{self.port}/{token}/"

    def person(self, number=1):
        return Person(self.link(number))

    def answers(self):
        return [(a.participant, a.pair, a.choice) for a in self.store.answers()]


@pytest.fixture(scope="module")
def folder(study_folder, tmp_path_factory):
    return shutil.copytree(study_folder, tmp_path_factory.mktemp("served") / "s.study")


@pytest.fixture
def served(folder):
    """A study without any answers, served from the study folder."""
    study = read_study(folder)
    for file in folder.glob("answers.db*"):
        file.unlink()
    with open_store(folder, study) as store:
        page = StudyPage(folder, study, store).application()
        with serving(page, host=LOOPBACK, port=0) as port:
            yield Served(folder, store, port)


@pytest.fixture
def person(served):
    person = served.person()
    yield person
    person.leave()


def test_it_listens_where_it_is_told(served):
    with socket.create_connection((LOOPBACK, served.port), timeout=20) as connection:
        assert connection.getpeername()[0] == LOOPBACK


@pytest.mark.parametrize("path", ["", *PAGE_FILES])
def test_the_page_is_served(person, path):
    status, headers, content = person.ask(path)
    kind = PAGE_FILES.get(path, "text/html")
    assert (status, headers["Content-Type"]) == (200, f"{kind}; charset=utf-8")
    assert content == PAGE.joinpath(path or "study.html").read_bytes()


def test_every_file_of_the_page_is_served():
    shipped = {f.name for f in PAGE.iterdir() if f.name.endswith((".html", ".css", ".js"))}
    assert shipped == {"study.html", *PAGE_FILES}


@pytest.mark.parametrize("name", ["study.html", *PAGE_FILES])
def test_the_page_asks_for_nothing_outside(name):
    assert not re.search(r"\w+://", PAGE.joinpath(name).read_text("utf-8"))


def test_a_link_without_its_last_slash_finds_the_page(served):
    person = Person(served.link().rstrip("/"))
    status, headers, _ = person.ask()
    assert status == 307
    assert headers["Location"] == f"{served.study.participants[0].token}/"
    person.leave()


PATHS = ("", "study.js", "state", "pairs/1/left.mp4", "pairs/99/left.mp4", "nothing")


@pytest.mark.parametrize("path", PATHS)
def test_headers_forbid_what_is_not_needed(person, path):
    headers = person.ask(path)[1]
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "unsafe" not in headers["Content-Security-Policy"]
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["X-Robots-Tag"] == "noindex"
    assert headers["Server"] is None
    assert headers["Access-Control-Allow-Origin"] is None


ROUTES = [(path, "GET") for path in PATHS[:4]] + [("pairs/1/answer", "POST")]


@pytest.mark.parametrize(("path", "method"), ROUTES)
@pytest.mark.parametrize("token", ["x" * 32, "-", "%2e%2e", "\xe4".encode().hex()])
def test_a_wrong_token_is_told_so(served, path, method, token):
    stranger = Person(f"http://{LOOPBACK}:{served.port}/{token}/")
    status, _, content = stranger.ask(
        path, method, {"choice": "left"} if method == "POST" else None
    )
    stranger.leave()
    assert status == 404
    assert b"use the whole link that you were given" in content
    assert content.strip().count(b"\n") == 0
    assert served.answers() == []


def test_the_state_is_what_the_page_needs_and_no_more(served, person):
    assert person.get("state") == {
        "introduction": served.study.introduction,
        "pairs": 14,
        "answered": 0,
    }
    person.answer(1, "left")
    assert person.get("state")["answered"] == 1


def test_clips_are_those_of_the_plan(served):
    for number in (1, 2, 50):
        person = served.person(number)
        for n, pair in enumerate(served.study.participants[number - 1].pairs, start=1):
            for side in ("left", "right"):
                status, headers, content = person.ask(f"pairs/{n}/{side}.mp4")
                assert (status, headers["Content-Type"]) == (200, "video/mp4")
                file = clip_path(served.folder, getattr(pair, side))
                assert content == file.read_bytes()
        person.leave()


def test_clips_come_in_ranges(served, person):
    path = "pairs/3/right.mp4"
    whole = person.ask(path)[2]
    for asked, part in (
        ("bytes=0-", whole),
        ("bytes=0-0", whole[:1]),
        ("bytes=100-299", whole[100:300]),
        ("bytes=-50", whole[-50:]),
        (f"bytes={len(whole) - 9}-", whole[-9:]),
    ):
        status, headers, content = person.ask(path, Range=asked)
        assert (status, content) == (206, part)
        assert headers["Content-Length"] == str(len(part))
        assert headers["Content-Range"].endswith(f"/{len(whole)}")
    status, headers, content = person.ask(path, "HEAD")
    assert (status, headers["Accept-Ranges"], content) == (200, "bytes", b"")
    assert person.ask(path, Range=f"bytes={len(whole)}-")[0] == 416
    assert person.ask(path, Range="bytes=x")[0] == 400


def test_no_header_tells_the_sides_of_a_pair_apart(served, person):
    for n, pair in enumerate(served.study.participants[0].pairs, start=1):
        assert pair.left.condition != pair.right.condition
        seen = []
        for side in ("left", "right"):
            headers = dict(person.ask(f"pairs/{n}/{side}.mp4")[1])
            seen.append({name.lower(): headers[name] for name in headers if name != "date"})
        assert seen[0] == seen[1]
        assert {"etag", "last-modified", "content-disposition"}.isdisjoint(seen[0])


def test_nothing_that_is_sent_names_a_condition_or_a_clip(served, person):
    names = [*CONDITIONS, *SENTENCES, *(clip.name for clip in served.study.clips), "condition"]
    person.answer(1, "left")
    for path in ("", *PAGE_FILES, "state", "pairs/0/left.mp4", "pairs/2/up.mp4"):
        _, headers, content = person.ask(path)
        sent = (str(headers) + content.decode()).lower()
        assert [name for name in names if name.lower() in sent.replace("condition}", "")] == []
    _, told = person.answer(1, "right")
    assert [name for name in names if name in json.dumps(told)] == []


def test_answers_are_stored_in_order(served, person):
    for pair in range(1, 15):
        choice = CHOICES[pair % 3]
        assert person.answer(pair, choice) == (200, {"answered": pair})
    assert served.answers() == [(1, pair, CHOICES[pair % 3]) for pair in range(1, 15)]
    status, told = person.answer(15, "left")
    assert (status, told) == (404, {"error": "there is no pair 15"})


def test_the_same_answer_again_is_confirmed_and_another_one_refused(served, person):
    assert person.answer(1, "left") == (200, {"answered": 1})
    assert person.answer(1, "left") == (200, {"answered": 1})
    line = "pair 1 is answered already: the first answer counts"
    assert person.answer(1, "right") == (409, {"error": line, "answered": 1})
    person.answer(2, "undecided")
    assert person.answer(1, "undecided") == (409, {"error": line, "answered": 2})
    assert served.answers() == [(1, 1, "left"), (1, 2, "undecided")]


def test_no_pair_is_skipped(served, person):
    line = "pair 2 is not shown yet: pair 1 comes first"
    assert person.answer(2, "left") == (409, {"error": line, "answered": 0})
    assert person.answer(14, "left")[0] == 409
    assert served.answers() == []


@pytest.mark.parametrize(
    ("path", "body", "status", "words"),
    [
        ("pairs/1/answer", {"choice": "reality"}, 400, "must be one of left, undecided, right"),
        ("pairs/1/answer", {"choice": ["left"]}, 400, "must be one of"),
        ("pairs/1/answer", {"choice": None}, 400, "must be one of"),
        ("pairs/1/answer", {}, 400, "must be one of"),
        ("pairs/1/answer", ["left"], 400, "must be one of"),
        ("pairs/1/answer", b"left", 400, "is not JSON"),
        ("pairs/1/answer", b"", 400, "is not JSON"),
        ("pairs/1/answer", b"\xff", 400, "is not JSON"),
        ("pairs/1/answer", b"[" * (LARGEST_BODY - 1), 400, "is not JSON"),
        ("pairs/1/answer", b" " * (LARGEST_BODY + 1), 413, "too large"),
        ("pairs/0/answer", {"choice": "left"}, 404, "there is no pair 0"),
        ("pairs/15/answer", {"choice": "left"}, 404, "there is no pair 15"),
        (f"pairs/{10**30}/answer", {"choice": "left"}, 404, "there is no pair 1000"),
        ("pairs/-1/answer", {"choice": "left"}, 404, ""),
        ("pairs/x/answer", {"choice": "left"}, 404, ""),
        ("answer", {"choice": "left"}, 405, ""),
        ("state", {"answered": 14}, 405, ""),
    ],
)
def test_a_form_that_was_tampered_with_is_refused(served, person, path, body, status, words):
    found, _, content = person.ask(path, "POST", body)
    assert found == status
    assert words in content.decode()
    assert content.strip().count(b"\n") == 0
    assert served.answers() == []
    assert person.answer(1, "left")[0] == 200


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH"])
def test_answers_cannot_be_changed_or_deleted(served, person, method):
    person.answer(1, "left")
    assert person.ask("pairs/1/answer", method, {"choice": "right"})[0] == 405
    assert served.answers() == [(1, 1, "left")]


@pytest.mark.parametrize(
    "path", ["pairs/1/middle.mp4", "pairs/1/left.mp3", "pairs/0/left.mp4", "study.json", "x.js"]
)
def test_there_is_nothing_else(person, path):
    assert person.ask(path)[0] == 404


def status_of(served, path):
    connection = http.client.HTTPConnection(LOOPBACK, served.port, timeout=20)
    try:
        connection.request("GET", path)
        return connection.getresponse().status
    finally:
        connection.close()


@pytest.mark.parametrize("path", ["/", "//", "/study.json", "/clips/", "/x/y/z"])
def test_there_is_nothing_without_a_token(served, path):
    assert status_of(served, path) == 404


def test_paths_lead_nowhere_else(served):
    token = served.study.participants[0].token
    for path in (f"/{token}/../study.json", f"/{token}/pairs/1/..%2f..%2fstudy.json"):
        assert status_of(served, path) == 404


def test_participants_do_not_meet(served):
    one, two = served.person(1), served.person(2)
    one.answer(1, "left")
    assert two.get("state")["answered"] == 0
    two.answer(1, "right")
    assert served.answers() == [(1, 1, "left"), (2, 1, "right")]
    one.leave()
    two.leave()


def test_a_failing_database_is_said_and_nothing_counted(served, person, monkeypatch):
    def fail(*_):
        raise InputError("answers.db: disk full")

    monkeypatch.setattr(served.store, "add", fail)
    status, _, content = person.ask("pairs/1/answer", "POST", {"choice": "left"})
    assert status == 503
    assert json.loads(content) == {"error": "the answers cannot be stored or read at the moment"}
    monkeypatch.undo()
    assert person.answer(1, "left") == (200, {"answered": 1})


def test_a_taken_port_is_refused(served):
    with (
        pytest.raises(InputError, match=rf"--host .* --port {served.port}: .*choose others"),
        serving(None, host=LOOPBACK, port=served.port),
    ):
        pass


def test_a_host_that_is_not_ours_is_refused():
    with (
        pytest.raises(InputError, match=r"--host nowhere\.invalid --port 0: .*choose others"),
        serving(None, host="nowhere.invalid", port=0),
    ):
        pass


def test_nothing_is_left_running(folder, served):
    study = served.study
    page = StudyPage(folder, study, served.store).application()
    with serving(page, host=LOOPBACK, port=0) as port:
        socket.create_connection((LOOPBACK, port), timeout=5).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((LOOPBACK, port), timeout=5)
    assert sum(thread.name == "study" for thread in threading.enumerate()) == 1


# ---- many at once, and a server that dies ----------------------------------------------------


def take_part(link, seed, *, watching, impatient):
    """Answer every pair, as the page does; what was confirmed, in order.

    watching: gets the clips before. impatient: sends every answer twice. A lost server is asked
    again until it is back.
    """
    rng = np.random.default_rng(seed)
    person = Person(link)

    def insist(request):
        while True:
            try:
                return request()
            except (OSError, http.client.HTTPException):
                waiting.wait(0.2)

    waiting = threading.Event()
    confirmed = []
    for pair in range(1, insist(lambda: person.get("state"))["pairs"] + 1):
        for side in ("left", "right") if watching else ():
            path = f"pairs/{pair}/{side}.mp4"
            assert insist(lambda path=path: person.ask(path, Range="bytes=0-"))[0] == 206
        choice = CHOICES[rng.integers(3)]
        for _ in range(1 + impatient):
            told = insist(lambda p=pair, c=choice: person.answer(p, c))
            assert told == (200, {"answered": pair})
        confirmed.append(choice)
    person.leave()
    return confirmed


def test_fifty_participants_at_once(folder, served):
    count_everyone(served, watching=True)


def test_fifty_participants_at_once_in_postgresql(folder, postgres_url):
    study = read_study(folder)
    with open_store(folder, study, url=postgres_url) as store:
        page = StudyPage(folder, study, store).application()
        with serving(page, host=LOOPBACK, port=0) as port:
            count_everyone(Served(folder, store, port), watching=False)


def count_everyone(served, *, watching):
    with ThreadPoolExecutor(50) as pool:
        numbers = range(1, 51)
        runs = [
            pool.submit(take_part, served.link(n), n, watching=watching, impatient=n % 5 == 0)
            for n in numbers
        ]
        confirmed = [run.result(timeout=300) for run in runs]
    expected = [(n, pair, c) for n in numbers for pair, c in enumerate(confirmed[n - 1], start=1)]
    assert len(expected) == 50 * 14
    assert served.answers() == expected
    assert min(Counter(choice for _, _, choice in expected).values()) > 100


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_server_killed_in_the_middle_loses_nothing(folder, kind, request):
    for file in folder.glob("answers.db*"):
        file.unlink()
    url = request.getfixturevalue("postgres_url") if kind == "postgresql" else None
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "mmmgpu", "study", "serve", folder, "--port", str(port)]
    command += [] if url is None else ["--database", url]
    study = read_study(folder)
    links = [f"http://{LOOPBACK}:{port}/{p.token}/" for p in study.participants[:5]]
    with ThreadPoolExecutor(5) as pool, open_store(folder, study, url=url) as store:
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        runs = [
            pool.submit(take_part, link, n, watching=False, impatient=n < 2)
            for n, link in enumerate(links)
        ]
        for kills in (1, 2):
            while len(store.answers()) < 20 * kills:
                assert server.poll() is None
                threading.Event().wait(0.05)
            os.kill(server.pid, signal.SIGKILL)
            server.wait()
            server.stdout.close()
            server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        confirmed = [run.result(timeout=300) for run in runs]
        server.kill()
        server.communicate()
        answers = [(a.participant, a.pair, a.choice) for a in store.answers()]
    people = enumerate(confirmed, start=1)
    assert answers == [(n, p, c) for n, own in people for p, c in enumerate(own, start=1)]
    assert len(answers) == 5 * 14
