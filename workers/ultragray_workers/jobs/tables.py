"""The tables in the database of the jobs: what each row says, who makes them, and their version.

`jobs` holds the one record of every job, from its submission to its end; see `jobs.queue` for the ways in which a row
changes. Keys, owners, audit and registrations are the service's, which keeps them beside the jobs so that one
transaction can change both. Free of torch.
"""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.progress import Files, Outcome, Progress, from_json, to_json

SCHEMA = "ultragray"  # on PostgreSQL; none on SQLite
VERSION = 1
_NUMBER = sa.BigInteger().with_variant(sa.Integer, "sqlite")  # which SQLite counts on by itself


class Json(sa.types.TypeDecorator[Any]):
    """A column of text with JSON of a class of `jobs.progress`, or of plain values."""

    impl, cache_ok = sa.Text, True

    def __init__(self, kind: type) -> None:
        super().__init__()
        self.kind = kind

    def process_bind_param(self, value: Any, dialect: sa.Dialect) -> str | None:
        return None if value is None else to_json(value)

    def process_result_value(self, value: str | None, dialect: sa.Dialect) -> Any:
        return None if value is None else from_json(self.kind, value)


TABLES = sa.MetaData(schema=SCHEMA)
JOBS = sa.Table(
    "jobs",
    TABLES,
    sa.Column("number", _NUMBER, sa.Identity(), primary_key=True),  # in the order of submission
    sa.Column("id", sa.Text, nullable=False, unique=True),
    sa.Column("kind", sa.Text, nullable=False),  # "share" for a share of a batch, which users do not see
    sa.Column("state", sa.Text, nullable=False),  # of jobs.record.JobState
    sa.Column("priority", sa.Integer, nullable=False),  # higher ones first
    # What was asked for.
    sa.Column("owner", sa.Text),
    sa.Column("private", sa.Boolean, nullable=False),
    sa.Column("request_id", sa.Text),
    sa.Column("asked", sa.Text, nullable=False),  # hash of the specification and its surroundings as they were sent
    sa.Column("retry_of", sa.Text),
    sa.Column("batch", sa.Text),  # of a share: the job that it helps
    sa.Column("summary", Json(dict), nullable=False),  # the specification, of poses only their number
    sa.Column("specification", Json(dict), nullable=False),  # whole
    sa.Column("dataset", sa.Text),  # which the job needs
    sa.Column("makes_scene", sa.Text),
    sa.Column("demand", sa.Text, nullable=False),  # key of the demand for a worker
    sa.Column("most_running", sa.Integer),  # jobs of the owner at once; NULL: any number
    sa.Column("trace", Json(dict), nullable=False),
    sa.Column("created_ms", sa.BigInteger, nullable=False),
    # Who does it. Each attempt of a worker has a number, and what it writes holds for that attempt alone.
    sa.Column("worker", sa.Text),
    sa.Column("attempt", sa.Integer, nullable=False, default=0),
    sa.Column("started_ms", sa.BigInteger),
    sa.Column("run_s", sa.Double, nullable=False, default=0.0),  # of all its processes
    # What has come of it.
    sa.Column("progress", Json(Progress)),
    sa.Column("files", Json(Files)),
    sa.Column("published", sa.Boolean, nullable=False, default=False),  # its scene is served: no cancellation any more
    sa.Column("outcome", Json(Outcome)),
    sa.Column("finished_ms", sa.BigInteger),
)
sa.Index("jobs_waiting", JOBS.c.state, JOBS.c.demand, JOBS.c.priority, JOBS.c.number)
sa.Index("jobs_of_owner", JOBS.c.owner, JOBS.c.state)
sa.Index("jobs_retry_of", JOBS.c.retry_of)
sa.Index("jobs_batch", JOBS.c.batch)
sa.Index("jobs_finished", JOBS.c.finished_ms)
sa.Index(  # two jobs never make a scene of one name
    "jobs_scene_made",
    JOBS.c.makes_scene,
    unique=True,
    sqlite_where=sa.text("state IN ('queued', 'running') AND batch IS NULL"),
    postgresql_where=sa.text("state IN ('queued', 'running') AND batch IS NULL"),
)
SHARDS = sa.Table(  # of batches; see jobs.kinds.shards_run
    "shards",
    TABLES,
    sa.Column("job", sa.Text, primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("frames", sa.Integer, nullable=False),
    sa.Column("done", sa.Boolean, nullable=False),
    sa.Column("share", sa.Text),  # the job or share that is at it; NULL: none
    sa.Column("tries", sa.Integer, nullable=False),  # how often it was taken
    sa.Column("error", sa.Text),  # why it cannot be made; NULL: it can
    sa.Column("reason", sa.Text),
)
USAGE = sa.Table(  # stays when jobs are deleted
    "usage",
    TABLES,
    sa.Column("owner", sa.Text, primary_key=True),  # empty: jobs without one
    sa.Column("device", sa.Text, primary_key=True),  # cpu or gpu
    sa.Column("day", sa.Date, primary_key=True),  # UTC
    sa.Column("run_s", sa.Double, nullable=False),
)
WORKERS = sa.Table(
    "workers",
    TABLES,
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("seen_at_s", sa.Double, nullable=False),  # by the clock of the database
    sa.Column("host", sa.Text),
    sa.Column("pid", sa.Integer),
    sa.Column("device", sa.Text),
    sa.Column("offer", sa.Text),  # JSON of its devices and labels
    sa.Column("version", sa.Text),
    sa.Column("started_at_s", sa.Double),
    sa.Column("job", sa.Text),
    sa.Column("wanted", sa.Text),  # by an administrator; NULL: that it takes jobs
)
STORE = sa.Table("store", TABLES, sa.Column("id", sa.Text, nullable=False))  # one row: see jobs.database
KEYS = sa.Table(  # API keys: rows stay when a key is revoked or has expired
    "keys",
    TABLES,
    sa.Column("id", sa.Text, primary_key=True),
    sa.Column("digest", sa.Text, nullable=False, unique=True),  # hex SHA-256 of the key
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("role", sa.Text, nullable=False),
    sa.Column("created_at_s", sa.Double, nullable=False),
    sa.Column("expires_at_s", sa.Double),
    sa.Column("revoked_at_s", sa.Double),
    sa.Column("last_used_at_s", sa.Double),
    sa.Column("limits", sa.Text),  # JSON of those that are its own; NULL: none
)
OWNERS = sa.Table(  # of datasets and scenes; jobs and registrations keep theirs in their rows
    "owners",
    TABLES,
    sa.Column("kind", sa.Text, primary_key=True),
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("owner", sa.Text, nullable=False),
    sa.Column("private", sa.Boolean, nullable=False),
    sa.Column("claim", sa.Text),  # what made the row, see jobs.owners
)
CHANGES = sa.Table(  # one row: counts the changes of keys, owners and registrations: who has a copy sees when it is old
    "changes", TABLES, sa.Column("number", sa.BigInteger, nullable=False)
)
AUDIT = sa.Table(  # append-only
    "audit",
    TABLES,
    sa.Column("number", _NUMBER, primary_key=True),
    sa.Column("at_s", sa.Double, nullable=False, index=True),
    sa.Column("who", sa.Text, nullable=False),
    sa.Column("address", sa.Text, nullable=False),
    sa.Column("what", sa.Text, nullable=False),
    sa.Column("target", sa.Text, nullable=False),
    sa.Column("result", sa.Text, nullable=False),
    sa.Column("facts", sa.Text, nullable=False),  # JSON
)
REGISTRATIONS = sa.Table(  # of robots and trackers to scenes
    "registrations",
    TABLES,
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("scene", sa.Text, nullable=False),
    sa.Column("owner", sa.Text, nullable=False),
    sa.Column("changed_at_s", sa.Double, nullable=False),
    sa.Column("document", sa.Text, nullable=False),  # JSON of an ultragray.geometry.registration.Registration
    sa.Column("private_to", sa.Text),  # the owner of the scene, which was private when this was put; NULL: it was not
)
SCHEMA_VERSION = sa.Table("schema_version", TABLES, sa.Column("version", sa.Integer, nullable=False))


def insert(place: sa.Engine | sa.Connection, table: sa.Table) -> Any:
    """An insertion that may say what it does where the row is there already."""
    return (sqlite if place.dialect.name == "sqlite" else postgresql).insert(table)


def read(engine: sa.Engine, question: sa.Select[Any]) -> Sequence[Any]:
    with engine.connect() as connection:
        return connection.execute(question).all()


def write(engine: sa.Engine, change: sa.Update | sa.Insert | sa.Delete) -> bool:
    """Whether it changed any row."""
    with engine.begin() as connection:
        return bool(connection.execute(change).rowcount)


_LOCK_NUMBER = 0x756C7472  # of PostgreSQL's advisory locks
_LOCK_POLL_S = 0.05


def make_tables(engine: sa.Engine) -> None:
    """Makes the tables where there are none. The caller holds `one_at_a_time`.

    Raises StartupFailed for those of another release.
    """
    with engine.begin() as connection:
        current = version(connection)
        if current is None:
            if connection.dialect.name != "sqlite":
                connection.execute(sa.schema.CreateSchema(SCHEMA, if_not_exists=True))
            TABLES.create_all(connection, checkfirst=False)
            connection.execute(sa.insert(SCHEMA_VERSION).values(version=VERSION))
            connection.execute(sa.insert(CHANGES).values(number=0))
        elif current != VERSION:
            raise StartupFailed(
                f"the database of the jobs has tables of version {current}, and this release knows version {VERSION}: "
                "another release has used it; start that one, or restore a backup that this one made",
                field="database_url",
            )


def version(connection: sa.Connection) -> int | None:
    schema = None if connection.dialect.name == "sqlite" else SCHEMA
    if not sa.inspect(connection).has_table(SCHEMA_VERSION.name, schema=schema):
        return None
    return connection.execute(sa.select(SCHEMA_VERSION.c.version)).scalar() or 0


@contextmanager
def one_at_a_time(url: sa.URL) -> Iterator[None]:
    """Keeps other processes from making tables during the body.

    IF NOT EXISTS does not: two of PostgreSQL's transactions that make the same table collide.
    """
    if url.get_backend_name() == "sqlite":
        with open(f"{url.database}.lock", "wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        return
    engine = sa.create_engine(url, poolclass=sa.NullPool, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:  # its end gives the lock back
        while not connection.execute(sa.select(sa.func.pg_try_advisory_lock(_LOCK_NUMBER))).scalar():
            time.sleep(_LOCK_POLL_S)
        yield
