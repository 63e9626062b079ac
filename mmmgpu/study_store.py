"""The answers to a study in a database: SQLite in the study folder, or PostgreSQL by URL.

An answer is one row, written and committed by one statement before the participant is told that it
is stored. Its key is (participant, pair), so that the database itself refuses a second one, whoever
sends it, at the same moment or later. SQLite keeps a write-ahead log (WAL) and flushes it at every
commit: what was stored outlives the process being killed, and the power going off.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from sqlalchemy.dialects import postgresql, sqlite

from mmmgpu.errors import InputError
from mmmgpu.studies import Study

DATABASE = "answers.db"  # in the study folder
VERSION = 1  # of the tables
PATIENCE_S = 30.0  # how long a statement waits for those before it

_tables = sql.MetaData()
_study = sql.Table(
    "mmmgpu_study",
    _tables,
    sql.Column("row", sql.Integer, primary_key=True, autoincrement=False),  # always 1
    sql.Column("id", sql.String(64), nullable=False),
    sql.Column("version", sql.Integer, nullable=False),
)
_answers = sql.Table(
    "mmmgpu_answers",
    _tables,
    sql.Column("participant", sql.Integer, primary_key=True, autoincrement=False),
    sql.Column("pair", sql.Integer, primary_key=True, autoincrement=False),
    sql.Column("choice", sql.String(16), nullable=False),
    sql.Column("time", sql.String(32), nullable=False),
)


@dataclass(frozen=True)
class Answer:
    """One answer: `participant` and `pair` count from 1, in the order of the plan.

    choice: one of `mmmgpu.studies.CHOICES`. time: when it was stored, UTC, ISO 8601.
    """

    participant: int
    pair: int
    choice: str
    time: str


class AnswerStore:
    """The answers to one study. May be used from several threads."""

    def __init__(self, engine: sql.Engine, name: str):
        """Use the database behind `engine`, which errors call `name`; see `open_store`."""
        self._engine = engine
        self._name = name

    def add(self, participant: int, pair: int, choice: str) -> str:
        """Store a choice, unless the participant has answered the pair; the one that is stored.

        Raises:
            InputError: The database cannot be reached or written.
        """
        time = datetime.now(timezone.utc).isoformat(timespec="seconds")
        row = {"participant": participant, "pair": pair, "choice": choice, "time": time}
        key = (_answers.c.participant == participant) & (_answers.c.pair == pair)
        with self._errors():
            with self._engine.begin() as connection:
                connection.execute(_insert(self._engine, _answers, row))
            with self._engine.connect() as connection:
                return str(
                    connection.execute(sql.select(_answers.c.choice).where(key)).scalar_one()
                )

    def count(self, participant: int) -> int:
        """How many pairs the participant has answered.

        Raises:
            InputError: The database cannot be read.
        """
        rows = sql.select(sql.func.count()).where(_answers.c.participant == participant)
        with self._errors(), self._engine.connect() as connection:
            return int(connection.execute(rows).scalar_one())

    def answers(self) -> list[Answer]:
        """Every answer, by participant and pair.

        Raises:
            InputError: The database cannot be read.
        """
        rows = sql.select(_answers).order_by(_answers.c.participant, _answers.c.pair)
        with self._errors(), self._engine.connect() as connection:
            return [Answer(*row) for row in connection.execute(rows)]

    def claim(self, study: Study) -> None:
        """Make the tables, where there are none, and make sure that they belong to `study`.

        Raises:
            InputError: They belong to another study, or are newer.
        """
        row = {"row": 1, "id": study.id, "version": VERSION}
        with self._errors():
            with self._engine.begin() as connection:
                _tables.create_all(connection)
                connection.execute(_insert(self._engine, _study, row))
            with self._engine.connect() as connection:
                identity, version = connection.execute(
                    sql.select(_study.c.id, _study.c.version)
                ).one()
        if identity != study.id:
            raise InputError(
                f"{self._name}: holds the answers to another study; give this one its own database"
            )
        if version > VERSION:
            raise InputError(f"{self._name}: was written by a newer mmmgpu; update mmmgpu")

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Whatever the database says becomes an InputError of one line."""
        try:
            yield
        except sql.exc.SQLAlchemyError as error:
            origin = getattr(error, "orig", None) or error
            reason = " ".join(str(origin).split()) or type(origin).__name__
            raise InputError(f"{self._name}: {reason}; check the database") from error


def _insert(engine: sql.Engine, table: sql.Table, row: dict[str, Any]) -> sql.Executable:
    """The statement that adds a row, unless there is one of that key."""
    if engine.dialect.name == "postgresql":
        return postgresql.insert(table).values(row).on_conflict_do_nothing()
    return sqlite.insert(table).values(row).on_conflict_do_nothing()


@contextmanager
def open_store(
    folder: str | os.PathLike[str], study: Study, *, url: str | None = None
) -> Iterator[AnswerStore]:
    """The answers to `study`, for the time of the block.

    url: of a PostgreSQL database, as in postgresql://user@host/name; by default they are kept in
        the study folder `folder`, in SQLite.

    Raises:
        InputError: The database cannot be opened, or holds the answers to another study.
    """
    engine, name = _sqlite(Path(folder) / DATABASE) if url is None else _postgresql(url)
    store = AnswerStore(engine, name)
    try:
        store.claim(study)
        yield store
    finally:
        store.close()


def _sqlite(path: Path) -> tuple[sql.Engine, str]:
    url = sql.URL.create("sqlite+pysqlite", database=str(path))
    engine = sql.create_engine(url, connect_args={"timeout": PATIENCE_S})

    @sql.event.listens_for(engine, "connect")
    def prepare(connection: Any, _record: Any) -> None:
        for setting in ("journal_mode = WAL", "synchronous = FULL"):
            connection.execute(f"PRAGMA {setting}").close()

    return engine, str(path)


def _postgresql(text: str) -> tuple[sql.Engine, str]:
    try:
        url = sql.make_url(text)
    except sql.exc.ArgumentError as error:
        raise InputError("--database: is no URL; write postgresql://user@host/name") from error
    if url.drivername not in ("postgresql", "postgres", "postgresql+psycopg"):
        raise InputError(
            f"--database: '{url.drivername}' is not supported; write postgresql://user@host/name, "
            "or leave it out for SQLite in the study folder"
        )
    name = url.render_as_string(hide_password=True)
    try:
        engine = sql.create_engine(
            url.set(drivername="postgresql+psycopg"),
            connect_args={"connect_timeout": round(PATIENCE_S)},
            pool_pre_ping=True,
        )
    except ImportError as error:
        raise InputError("PostgreSQL needs psycopg; run pip install 'mmmgpu[postgres]'") from error
    return engine, name
