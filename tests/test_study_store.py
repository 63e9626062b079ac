import sqlite3
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime, timedelta, timezone

import psycopg
import pytest
from studied import planned

from mmmgpu.errors import InputError
from mmmgpu.study_store import DATABASE, Answer, open_store


@pytest.fixture
def study():
    return planned()


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request):
    return request.getfixturevalue("postgres_url") if request.param == "postgresql" else None


def kept(folder, study, url=None):
    with open_store(folder, study, url=url) as store:
        return [(a.participant, a.pair, a.choice) for a in store.answers()]


def test_answers_are_kept_in_order(tmp_path, study, url):
    with open_store(tmp_path, study, url=url) as store:
        assert store.answers() == []
        assert store.count(1) == 0
        assert store.add(2, 1, "left") == "left"
        assert store.add(1, 2, "undecided") == "undecided"
        assert store.add(1, 1, "right") == "right"
        assert (store.count(1), store.count(2), store.count(3)) == (2, 1, 0)
    assert kept(tmp_path, study, url) == [(1, 1, "right"), (1, 2, "undecided"), (2, 1, "left")]


def test_the_time_is_when_it_was_stored(tmp_path, study, url):
    before = datetime.now(timezone.utc) - timedelta(seconds=1)
    with open_store(tmp_path, study, url=url) as store:
        store.add(1, 1, "left")
        (answer,) = store.answers()
    assert isinstance(answer, Answer)
    assert before <= datetime.fromisoformat(answer.time) <= datetime.now(timezone.utc)


def test_the_first_answer_counts(tmp_path, study, url):
    with open_store(tmp_path, study, url=url) as store:
        store.add(1, 1, "left")
        assert store.add(1, 1, "right") == "left"
        assert store.add(1, 1, "left") == "left"
    assert kept(tmp_path, study, url) == [(1, 1, "left")]


def test_of_simultaneous_answers_one_counts_for_all(tmp_path, study, url):
    start = threading.Barrier(8)
    with open_store(tmp_path, study, url=url) as store, ThreadPoolExecutor(8) as pool:

        def send(number):
            start.wait()
            return [store.add(1, pair, ("left", "right")[number % 2]) for pair in range(1, 11)]

        told = set(map(tuple, pool.map(send, range(8))))
        assert len(told) == 1
        assert [(a.pair, a.choice) for a in store.answers()] == list(enumerate(*told, start=1))


def test_another_study_is_refused(tmp_path, study, url):
    with open_store(tmp_path, study, url=url) as store:
        store.add(1, 1, "left")
    other = replace(study, id="other")
    with (
        pytest.raises(InputError, match="holds the answers to another study"),
        open_store(tmp_path, other, url=url),
    ):
        pass
    assert kept(tmp_path, study, url) == [(1, 1, "left")]


def test_newer_tables_are_refused(tmp_path, study):
    kept(tmp_path, study)
    with sqlite3.connect(tmp_path / DATABASE) as connection:
        connection.execute("UPDATE mmmgpu_study SET version = 2")
    with pytest.raises(InputError, match="newer mmmgpu"):
        kept(tmp_path, study)


def test_sqlite_logs_ahead_and_flushes(tmp_path, study):
    kept(tmp_path, study)
    with sqlite3.connect(tmp_path / DATABASE) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    with open_store(tmp_path, study) as store, store._engine.connect() as connection:
        assert connection.exec_driver_sql("PRAGMA synchronous").scalar_one() == 2  # FULL


def test_two_servers_may_share_a_database(tmp_path, study, url):
    with open_store(tmp_path, study, url=url) as one, open_store(tmp_path, study, url=url) as two:
        one.add(1, 1, "left")
        assert two.add(1, 1, "right") == "left"
        assert two.count(1) == 1


def test_a_file_that_is_no_database_is_refused(tmp_path, study):
    (tmp_path / DATABASE).write_text("no database\n" * 100)
    with pytest.raises(InputError, match=rf"{DATABASE}: .*not a database; check"):
        kept(tmp_path, study)
    assert (tmp_path / DATABASE).read_text().startswith("no database")


def test_a_database_that_cannot_be_written_is_refused(tmp_path, study):
    with pytest.raises(InputError, match=r"answers\.db: .*unable to open"):
        kept(tmp_path / "nowhere", study)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("answers.db", "is no URL"),
        ("mysql://user@host/x", "'mysql' is not supported"),
        ("sqlite:///x.db", "'sqlite' is not supported"),
    ],
)
def test_other_urls_are_refused(tmp_path, study, url, words):
    with pytest.raises(InputError, match=words):
        kept(tmp_path, study, url)
    assert list(tmp_path.iterdir()) == []


def test_a_password_is_not_shown(tmp_path, study):
    url = f"postgresql://ann:secret@/x?host={tmp_path}"
    with pytest.raises(InputError, match="ann:") as refusal:
        kept(tmp_path, study, url)
    assert "secret" not in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_lost_server_is_one_line_and_then_goes_on(tmp_path, study, postgres_url, postgres_server):
    with open_store(tmp_path, study, url=postgres_url) as store:
        store.add(1, 1, "left")
        with psycopg.connect(
            f"host={postgres_server} user=study dbname=postgres", autocommit=True
        ) as admin:
            admin.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                "WHERE pid <> pg_backend_pid() AND backend_type = 'client backend'"
            )
        store.add(1, 2, "right")
    assert kept(tmp_path, study, postgres_url) == [(1, 1, "left"), (1, 2, "right")]
