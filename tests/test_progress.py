import io
import sys
import time

import pytest

from mmmgpu.progress import progress, progress_bar


class Clock:
    """Stands still until told."""

    now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    return clock


class Terminal(io.StringIO):
    def isatty(self):
        return True


def open_terminal(monkeypatch):
    """Put a terminal in place of the standard error (inside the test: pytest puts its own back)."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    return terminal


def test_items_pass_unchanged():
    assert list(progress([3, 1, 2], "Reading")) == [3, 1, 2]
    assert list(progress(iter("abc"), "Reading", total=3)) == ["a", "b", "c"]
    assert list(progress(iter("abc"), "Reading")) == ["a", "b", "c"]
    assert list(progress([], "Reading")) == []


def test_lines_come_now_and_then_with_the_time_left(clock, capsys):
    for _ in progress(range(100), "Reading clips"):
        clock.now += 2
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert lines[0] == "Reading clips: 3/100, 3:14 left"
    assert lines[1] == "Reading clips: 6/100, 3:08 left"
    assert len(lines) == 34  # every 6 s of 200 s, and the end
    assert lines[-1] == "Reading clips: done in 3:20"


def test_without_a_total_the_count_and_the_time_so_far(clock, capsys):
    for _ in progress(iter(range(3)), "Reading"):
        clock.now += 3000
    assert capsys.readouterr().err.splitlines() == [
        "Reading: 1, 50:00 so far",
        "Reading: 2, 1:40:00 so far",
        "Reading: 3, 2:30:00 so far",
        "Reading: done in 2:30:00",
    ]


def test_short_jobs_print_nothing(clock, capsys):
    for _ in progress(range(4), "Reading"):
        clock.now += 1
    assert capsys.readouterr() == ("", "")


def test_quiet_prints_nothing(clock, capsys):
    for _ in progress(range(100), "Reading", quiet=True):
        clock.now += 100
    assert capsys.readouterr() == ("", "")


def test_a_bar_on_a_terminal_and_nothing_on_the_output(monkeypatch, capsys):
    terminal = open_terminal(monkeypatch)
    for outer in progress(["a", "b"], "Clips [red]"):
        for _ in progress(range(3), f"Frames of {outer}"):
            print("a result")
    shown = terminal.getvalue()
    assert capsys.readouterr().out == "a result\n" * 6
    for words in ("Clips [red]", "0/2", "Frames of a", "Frames of b", "0/3"):
        assert words in shown
    assert "\x1b[2K\x1b[1A\x1b[2K" in shown  # two lines are redrawn as one display


@pytest.mark.parametrize("on_terminal", [True, False])
def test_exceptions_pass_and_the_terminal_is_restored(on_terminal, monkeypatch, clock, capsys):
    terminal = open_terminal(monkeypatch) if on_terminal else None

    def interrupted():
        for k in progress(range(5), "Reading"):
            clock.now += 7
            if k == 2:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    text = terminal.getvalue() if terminal else capsys.readouterr().err
    assert "Reading" in text
    assert "done" not in text
    assert not terminal or text.rfind("\x1b[?25h") > text.rfind("\x1b[?25l") >= 0  # the cursor


def test_interrupting_the_source_reaches_the_caller():
    def source():
        yield 1
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(progress(source(), "Reading"))


def test_jobs_that_are_no_loop(clock, capsys):
    with progress_bar(10, "Encoding") as advance:
        clock.now += 6
        advance(5)
    assert capsys.readouterr().err.splitlines() == [
        "Encoding: 5/10, 0:06 left",
        "Encoding: done in 0:06",
    ]
