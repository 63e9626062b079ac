import json
import queue
import signal
import threading
import urllib.request
import webbrowser

import pytest
import typer
from marked import shown_frames

from mmmgpu import model_files, reference_pairs
from mmmgpu.commands.mark import mark, wait_for_person
from mmmgpu.errors import InputError
from mmmgpu.marking import Session
from mmmgpu.points import read_points


@pytest.fixture
def frames_without_video(monkeypatch):
    """The command finds the drawn frames; the list of what it asked for."""
    asked = []

    def choose(clips, *, region, sync, given):
        asked.append((clips, region, sync, given))
        return {kind: b for kind, (_, b) in shown_frames().items()}

    monkeypatch.setattr(model_files, "load", lambda path: path)
    monkeypatch.setattr(
        reference_pairs,
        "source_references",
        lambda _: {k: a for k, (a, _) in shown_frames().items()},
    )
    monkeypatch.setattr(reference_pairs, "choose_references", choose)
    return asked


def press_finish(address):
    request = urllib.request.Request(f"{address}finish", b"{}", method="POST")
    urllib.request.urlopen(request, timeout=20).close()
    return True


@pytest.fixture
def person(monkeypatch):
    """A browser in which somebody presses "Save & finish" at once; the addresses it was given."""
    opened = []

    def open_page(address):
        opened.append(address)
        return press_finish(address)

    monkeypatch.setattr(webbrowser, "open", open_page)
    return opened


@pytest.fixture
def files(tmp_path):
    model, clip = tmp_path / "ann.mmm", tmp_path / "ben.mkv"
    for file in (model, clip):
        file.write_bytes(b"x")
    return model, clip, tmp_path / "points.json"


def call(files, **options):
    model, clip, out = files
    given = {"port": 0, "browser": True, "region": None, "sync": 0.0, "json": None, **options}
    mark(model, [clip], out=out, **given)


def test_points_are_written_and_their_path_is_the_result(
    files, frames_without_video, person, capsys, tmp_path
):
    call(files, region="1,2,30,40", sync=-0.25, json=tmp_path / "facts.json")
    out, err = capsys.readouterr()
    assert out == f"{files[2]}\n"
    assert f"the page is at {person[0]}\n" in err
    assert frames_without_video == [([files[1]], (1, 2, 30, 40), -0.25, {})]
    assert [len(pair.names) for pair in read_points(files[2])] == [38, 38]
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["points"] == str(files[2])
    assert [(p["kind"], p["points"], p["b"]["frame"]) for p in facts["pairs"]] == [
        ("closed", 38, 7),
        ("open", 38, 8),
    ]


def test_without_a_browser_the_address_is_only_said(files, person, monkeypatch):
    said = queue.Queue()
    monkeypatch.setattr("mmmgpu.commands.mark.say", said.put)
    options = {"port": 0, "browser": False}
    session = Session(files[2], shown_frames())
    thread = threading.Thread(target=wait_for_person, args=(session,), kwargs=options, daemon=True)
    thread.start()
    line = said.get(timeout=60)
    assert line.endswith(" (open it in a browser)")
    press_finish(line.split()[4])
    thread.join(60)
    assert not thread.is_alive()
    assert person == []


def test_a_bad_points_file_is_said_before_the_search_for_frames(files, frames_without_video):
    files[2].write_text("{}")
    with pytest.raises(InputError, match="is no file of points"):
        call(files)
    assert frames_without_video == []
    assert files[2].read_text() == "{}"


def test_points_may_not_replace_a_clip(files, frames_without_video):
    with pytest.raises(InputError, match="would replace what is read"):
        call((files[0], files[1], files[1]))
    assert files[1].read_bytes() == b"x"


def test_interrupted_marking_says_what_happens_to_changes(files, capsys, monkeypatch):
    session = Session(files[2], shown_frames())
    monkeypatch.setattr(webbrowser, "open", lambda _: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        wait_for_person(session, port=0, browser=True)
    assert "is not saved; changes come back with the same command" in capsys.readouterr().err
    session.save()
    with pytest.raises(KeyboardInterrupt):
        wait_for_person(session, port=0, browser=True)
    assert "is not saved" not in capsys.readouterr().err


def test_a_person_may_choose_the_frames(files, frames_without_video, person):
    call(files, closed="some/ben: 1.mkv:7", opened="ben.mkv:0")
    assert frames_without_video[0][3] == {"closed": ("ben: 1.mkv", 7), "open": ("ben.mkv", 0)}


@pytest.mark.parametrize("text", ["ben.mkv", "ben.mkv:", ":3", "ben.mkv:-1", "ben.mkv:x"])
def test_a_frame_is_a_name_and_a_number(files, frames_without_video, text):
    with pytest.raises(typer.BadParameter, match=r"must be the name of a clip and a frame"):
        call(files, closed=text)
    assert frames_without_video == []
