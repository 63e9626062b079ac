import http.client
import json
import re
import socket
import threading
from importlib import resources
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from marked import shown_frames

from mmmgpu.errors import InputError
from mmmgpu.marking import Session, warped_onto
from mmmgpu.marking_server import LARGEST_BODY, PAGE_FILES, MarkingServer, serving
from mmmgpu.points import read_points
from mmmgpu.web_pages import LOOPBACK

PAGE = resources.files("mmmgpu.marking_page")


@pytest.fixture
def server(tmp_path):
    with serving(Session(tmp_path / "points.json", shown_frames())) as server:
        yield server


@pytest.fixture
def ask(server):
    """Send a request to the server; its status, headers and content."""

    def ask(path, method="GET", body=None, *, token=None, host=None, headers=()):
        parts = urlsplit(server.address)
        connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=20)
        path = f"/{server.token if token is None else token}/{path}"
        sent = {"Host": host or parts.netloc, **dict(headers)}
        body = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        connection.request(method, path, body, sent)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, answer.headers, content

    return ask


def value(answer):
    return json.loads(answer[2])


def state_of(ask):
    return value(ask("state"))


def picture_in(answer):
    status, headers, content = answer
    assert (status, headers["Content-Type"]) == (200, "image/png")
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_it_listens_to_this_computer_alone(server):
    assert server.server_address[0] == LOOPBACK
    assert server.socket.getsockname()[0] == LOOPBACK
    assert socket.inet_ntoa(socket.INADDR_LOOPBACK.to_bytes(4, "big")) == LOOPBACK
    assert server.address == f"http://{LOOPBACK}:{server.server_port}/{server.token}/"


def test_token_is_long_and_new_each_time(server, tmp_path):
    other = MarkingServer(Session(tmp_path / "other.json", shown_frames()))
    other.server_close()
    assert len(server.token) >= 32
    assert other.token != server.token


ROUTES = [
    ("", "GET"),
    ("state", "GET"),
    ("picture/closed/a", "GET"),
    ("warped/closed", "GET"),
    ("folded/closed", "GET"),
    ("mark.js", "GET"),
    ("points/closed", "PUT"),
    ("save", "POST"),
    ("finish", "POST"),
]


@pytest.mark.parametrize(("path", "method"), ROUTES)
@pytest.mark.parametrize(
    "wrong",
    [
        {"token": "x" * 32},
        {"token": ""},
        {"host": "evil.example"},
        {"host": f"{LOOPBACK}:1"},
        {"host": f"evil.example:{80}"},
    ],
    ids=["token", "no token", "host", "port", "host and port"],
)
def test_wrong_token_or_host_is_forbidden(ask, server, tmp_path, path, method, wrong):
    body = {"revision": 0, "points": []} if method != "GET" else None
    status, _, content = ask(path, method, body, **wrong)
    assert status == 403
    assert set(json.loads(content)) == {"error"}
    assert server.session.describe()["revision"] == 0
    assert not server.finished.is_set()
    assert list(tmp_path.iterdir()) == []


def test_the_bare_host_is_forbidden(server):
    connection = http.client.HTTPConnection(LOOPBACK, server.server_port, timeout=20)
    connection.request("GET", "/")
    assert connection.getresponse().status == 403
    connection.request("GET", f"/{server.token}")
    assert connection.getresponse().status == 403
    connection.close()


def test_an_odd_token_is_forbidden(server):
    with socket.create_connection((LOOPBACK, server.server_port), timeout=20) as connection:
        connection.sendall(f"GET /\xe9\xff/ HTTP/1.1\r\nHost: {LOOPBACK}\r\n\r\n".encode("latin-1"))
        assert connection.recv(12) == b"HTTP/1.0 403"


def test_localhost_is_its_own_name(ask, server):
    assert ask("state", host=f"localhost:{server.server_port}")[0] == 200


@pytest.mark.parametrize("name", PAGE_FILES)
def test_page_is_served(ask, name):
    file, kind = PAGE_FILES[name]
    status, headers, content = ask(name)
    assert (status, headers["Content-Type"]) == (200, kind)
    assert content == PAGE.joinpath(file).read_bytes()


def test_every_file_of_the_page_is_served():
    shipped = {f.name for f in PAGE.iterdir() if f.name.endswith((".html", ".css", ".js"))}
    assert shipped == {file for file, _ in PAGE_FILES.values()}


@pytest.mark.parametrize("name", PAGE_FILES)
def test_page_asks_for_nothing_outside(name):
    file, _ = PAGE_FILES[name]
    text = PAGE.joinpath(file).read_text("utf-8")
    assert set(re.findall(r"\w+://[^\s\"')]+", text)) <= {"http://www.w3.org/2000/svg"}
    assert not re.search(r"""(?:src|href|url)\s*[=(]\s*["']?//""", text)


def test_headers_forbid_what_is_not_needed(ask):
    for path in ("", "state", "picture/open/b"):
        headers = ask(path)[1]
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "unsafe" not in headers["Content-Security-Policy"]
        assert headers["Cache-Control"] == "no-store"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "no-referrer"
        assert headers["Access-Control-Allow-Origin"] is None


@pytest.mark.parametrize("kind", ["closed", "open"])
@pytest.mark.parametrize("side", [0, 1])
def test_pictures_are_exact(ask, kind, side):
    seen = picture_in(ask(f"picture/{kind}/{'ab'[side]}"))
    np.testing.assert_array_equal(seen, shown_frames()[kind][side].picture)


def test_warped_picture_is_that_of_the_points(ask, server):
    before = picture_in(ask("warped/closed"))
    a = shown_frames()["closed"][0].picture
    np.testing.assert_array_equal(before, warped_onto(server.session.pair("closed"), a))
    state = state_of(ask)
    points = state["pairs"][0]["points"]
    for point in points:
        point["b"] = [point["b"][0] + 5, point["b"][1]]
    assert ask("points/closed", "PUT", {"revision": 0, "points": points})[0] == 200
    after = picture_in(ask("warped/closed"))
    inside = np.s_[40:140, 40:140]
    difference = after[:, 5:][inside].astype(float) - before[:, :-5][inside]
    assert np.abs(difference).mean() < 2
    assert np.abs(after.astype(float) - before).mean() > 2


def test_folds_are_named(ask):
    assert value(ask("folded/closed")) == {"points": []}
    points = state_of(ask)["pairs"][0]["points"]
    points[7]["b"], points[14]["b"] = points[14]["b"], points[7]["b"]
    ask("points/closed", "PUT", {"revision": 0, "points": points})
    assert points[7]["name"] in value(ask("folded/closed"))["points"]


def test_points_are_kept_saved_and_finished(ask, server, tmp_path):
    points = state_of(ask)["pairs"][0]["points"]
    points[0]["a"] = [50.5, 60.25]
    status, _, content = ask("points/closed", "PUT", {"revision": 0, "points": points})
    assert status == 200
    assert json.loads(content) == {"revision": 1, "saved": False, "problems": []}
    assert state_of(ask)["pairs"][0]["points"] == points
    assert value(ask("save", "POST", {})) == {"revision": 1, "saved": True}
    assert read_points(tmp_path / "points.json")[0].points_a[0].tolist() == [50.5, 60.25]
    assert not server.finished.is_set()
    assert ask("finish", "POST", {})[0] == 200
    assert server.finished.wait(20)


def test_unpaired_points_are_not_saved_and_named(ask, server, tmp_path):
    points = state_of(ask)["pairs"][1]["points"]
    points[3]["b"] = None
    state = value(ask("points/open", "PUT", {"revision": 0, "points": points}))
    assert state["problems"][0]["point"] == "nose_4"
    for path in ("save", "finish"):
        status, _, content = ask(path, "POST", {})
        assert status == 409
        assert "'nose_4' is unpaired" in json.loads(content)["error"]
    assert ask("warped/open")[0] == ask("folded/open")[0] == 409
    assert ask("warped/closed")[0] == 200
    assert not server.finished.is_set()
    assert not (tmp_path / "points.json").exists()


def test_an_old_page_is_told_so(ask):
    points = state_of(ask)["pairs"][0]["points"]
    ask("points/closed", "PUT", {"revision": 0, "points": points[1:]})
    status, _, content = ask("points/closed", "PUT", {"revision": 0, "points": points[2:]})
    assert status == 409
    assert "another window" in json.loads(content)["error"]
    assert state_of(ask)["pairs"][0]["points"] == points[1:]


@pytest.mark.parametrize(
    ("path", "method", "body", "status"),
    [
        ("nothing", "GET", None, 404),
        ("../points.py", "GET", None, 404),
        ("mark.html", "GET", None, 404),
        ("picture/half/a", "GET", None, 404),
        ("picture/closed/c", "GET", None, 404),
        ("warped/half", "GET", None, 404),
        ("points/half", "PUT", {}, 404),
        ("points/closed", "GET", None, 404),
        ("state", "POST", {}, 404),
        ("points/closed", "DELETE", None, 501),
        ("points/closed", "PUT", b"{", 400),
        ("points/closed", "PUT", b"[" * 100_000, 400),
        ("points/closed", "PUT", [1], 400),
        ("points/closed", "PUT", {"revision": 0}, 409),
        ("points/closed", "PUT", {"revision": 0, "points": [{"name": 3}]}, 409),
    ],
)
def test_other_requests_are_refused(ask, path, method, body, status):
    before = state_of(ask)
    assert ask(path, method, body)[0] == status
    assert state_of(ask) == before


@pytest.mark.parametrize(
    ("length", "status"), [("x", 411), ("-1", 411), (str(LARGEST_BODY + 1), 413)]
)
def test_the_length_of_a_request_is_checked_before_it_is_read(ask, length, status):
    assert ask("save", "POST", b"", headers={"Content-Length": length})[0] == status


def test_a_defect_is_said_and_the_server_goes_on(ask, server, monkeypatch):
    def fail():
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(server.session, "save", fail)
    status, _, content = ask("save", "POST", {})
    assert status == 500
    assert json.loads(content)["error"].startswith("ZeroDivisionError: oh (this is a defect")
    assert ask("state")[0] == 200


def test_a_full_disk_is_said_and_the_points_stay(ask, server, monkeypatch):
    def full(*_):
        raise InputError("cannot write points.json: the disk is full")

    monkeypatch.setattr("mmmgpu.marking.write_points", full)
    status, _, content = ask("save", "POST", {})
    assert (status, json.loads(content)["error"]) == (
        409,
        "cannot write points.json: the disk is full",
    )
    assert not server.session.saved


def test_a_taken_port_is_refused(server, tmp_path):
    session = Session(tmp_path / "other.json", shown_frames())
    with pytest.raises(InputError, match=f"--port {server.server_port}: .*choose another"):
        MarkingServer(session, port=server.server_port)


def test_a_wanted_port_is_taken(tmp_path):
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    with serving(Session(tmp_path / "p.json", shown_frames()), port=port) as server:
        assert server.server_port == port


def test_nothing_is_left_running(tmp_path):
    before = set(threading.enumerate())
    with serving(Session(tmp_path / "p.json", shown_frames())) as server:
        port = server.server_port
    assert {t for t in set(threading.enumerate()) - before if t.is_alive()} == set()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((LOOPBACK, port), timeout=5)
