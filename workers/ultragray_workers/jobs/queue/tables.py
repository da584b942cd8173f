"""Our own tables in the database of the jobs, beside those of DBOS: who makes and migrates them, and their version.

Every table of ours is listed here as it is now, and made by the steps below. Free of torch.
"""

from __future__ import annotations

import fcntl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import sqlalchemy as sa

from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.queue.internals import QUEUE_VERSION, SCHEMA, latest_queue_version

TABLES = sa.MetaData(schema=SCHEMA)
WORKERS = sa.Table(
    "ultragray_workers",
    TABLES,
    sa.Column("executor", sa.Text, primary_key=True),
    sa.Column("seen_at_s", sa.Double, nullable=False),  # by the clock of the database
    sa.Column("host", sa.Text),
    sa.Column("pid", sa.Integer),
    sa.Column("device", sa.Text),
    sa.Column("version", sa.Text),
    sa.Column("started_at_s", sa.Double),
    sa.Column("job_id", sa.Text),
    sa.Column("wanted", sa.Text),  # by an administrator; NULL: that it takes jobs
    sa.Column("offer", sa.Text),  # JSON of its devices and labels; NULL: a worker of a release without them
)
KEYS = sa.Table(  # API keys: rows stay when a key is revoked or has expired
    "ultragray_keys",
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
OWNERS = sa.Table(  # of datasets and scenes; jobs keep theirs with their row
    "ultragray_owners",
    TABLES,
    sa.Column("kind", sa.Text, primary_key=True),
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("owner", sa.Text, nullable=False),
    sa.Column("private", sa.Boolean, nullable=False),
    sa.Column("claim", sa.Text),  # what made the row, see `owners`; NULL: it is from before there were claims
)
CHANGES = sa.Table(  # one row: counts the changes of keys, owners and registrations: who has a copy sees when it is old
    "ultragray_changes", TABLES, sa.Column("number", sa.BigInteger, nullable=False)
)
AUDIT = sa.Table(  # append-only
    "ultragray_audit",
    TABLES,
    sa.Column("number", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True),
    sa.Column("at_s", sa.Double, nullable=False, index=True),
    sa.Column("who", sa.Text, nullable=False),
    sa.Column("address", sa.Text, nullable=False),
    sa.Column("what", sa.Text, nullable=False),
    sa.Column("target", sa.Text, nullable=False),
    sa.Column("result", sa.Text, nullable=False),
    sa.Column("facts", sa.Text, nullable=False),  # JSON
)
# One row: the artifact folder's.
FOLDER = sa.Table("ultragray_folder", TABLES, sa.Column("id", sa.Text, nullable=False))
RUNS = sa.Table(  # of jobs that were submitted since there is this table
    "ultragray_runs",
    TABLES,
    sa.Column("job_id", sa.Text, primary_key=True),
    sa.Column("decided", sa.Text),  # PUBLISHED or CANCELLED, whichever came first
    sa.Column("run_s", sa.Double, nullable=False),  # of all its processes
)
USAGE = sa.Table(  # stays when jobs are deleted
    "ultragray_usage",
    TABLES,
    sa.Column("owner", sa.Text, primary_key=True),  # empty: jobs without one
    sa.Column("device", sa.Text, primary_key=True),  # cpu or gpu
    sa.Column("day", sa.Date, primary_key=True),  # UTC
    sa.Column("run_s", sa.Double, nullable=False),
)
SHARDS = sa.Table(  # of render jobs in shards; see jobs.shards.claims
    "ultragray_shards",
    TABLES,
    sa.Column("job_id", sa.Text, primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("frames", sa.Integer, nullable=False),
    sa.Column("done", sa.Boolean, nullable=False),
    sa.Column("share", sa.Text),  # the workflow that is at it; NULL: none
    sa.Column("tries", sa.Integer, nullable=False),  # how often it was taken
    sa.Column("error", sa.Text),  # why it cannot be made; NULL: it can
    sa.Column("reason", sa.Text),
)
REGISTRATIONS = sa.Table(  # of robots and trackers to scenes
    "ultragray_registrations",
    TABLES,
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("scene", sa.Text, nullable=False),
    sa.Column("owner", sa.Text, nullable=False),
    sa.Column("changed_at_s", sa.Double, nullable=False),
    sa.Column("document", sa.Text, nullable=False),  # JSON of an ultragray.geometry.registration.Registration
    sa.Column("private_to", sa.Text),  # the owner of the scene, which was private when this was put; NULL: it was not
)
SCHEMA_VERSION = sa.Table("ultragray_schema", TABLES, sa.Column("version", sa.Integer, nullable=False))

_LOCK_NUMBER = 0x756C7472  # of PostgreSQL's advisory locks
_LOCK_POLL_S = 0.05


def _to_version_1(connection: sa.Connection) -> None:
    """The table of workers, which SQLite files without a version have already."""
    table = sa.Table(
        "ultragray_workers",
        sa.MetaData(schema=SCHEMA),
        sa.Column("executor", sa.Text, primary_key=True),
        sa.Column("seen_at_s", sa.Double, nullable=False),
    )
    connection.execute(sa.schema.CreateTable(table, if_not_exists=True))


def _to_version_2(connection: sa.Connection) -> None:
    """Keys, owners, and the audit log."""
    made = sa.MetaData(schema=SCHEMA)
    sa.Table(
        "ultragray_keys",
        made,
        sa.Column("id", sa.Text, primary_key=True),
        sa.Column("digest", sa.Text, nullable=False, unique=True),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("role", sa.Text, nullable=False),
        sa.Column("created_at_s", sa.Double, nullable=False),
        sa.Column("expires_at_s", sa.Double),
        sa.Column("revoked_at_s", sa.Double),
        sa.Column("last_used_at_s", sa.Double),
    )
    sa.Table(
        "ultragray_owners",
        made,
        sa.Column("kind", sa.Text, primary_key=True),
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("owner", sa.Text, nullable=False),
        sa.Column("private", sa.Boolean, nullable=False),
    )
    changes = sa.Table("ultragray_changes", made, sa.Column("number", sa.BigInteger, nullable=False))
    sa.Table(
        "ultragray_audit",
        made,
        sa.Column("number", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True),
        sa.Column("at_s", sa.Double, nullable=False, index=True),
        sa.Column("who", sa.Text, nullable=False),
        sa.Column("address", sa.Text, nullable=False),
        sa.Column("what", sa.Text, nullable=False),
        sa.Column("target", sa.Text, nullable=False),
        sa.Column("result", sa.Text, nullable=False),
        sa.Column("facts", sa.Text, nullable=False),
    )
    made.create_all(connection, checkfirst=False)
    connection.execute(sa.insert(changes).values(number=0))


def _to_version_3(connection: sa.Connection) -> None:
    """The id of the artifact folder, what was decided about jobs, and how long they ran."""
    made = sa.MetaData(schema=SCHEMA)
    sa.Table("ultragray_folder", made, sa.Column("id", sa.Text, nullable=False))
    sa.Table(
        "ultragray_runs",
        made,
        sa.Column("job_id", sa.Text, primary_key=True),
        sa.Column("decided", sa.Text),
        sa.Column("run_s", sa.Double, nullable=False),
    )
    sa.Table(
        "ultragray_usage",
        made,
        sa.Column("owner", sa.Text, primary_key=True),
        sa.Column("device", sa.Text, primary_key=True),
        sa.Column("day", sa.Date, primary_key=True),
        sa.Column("run_s", sa.Double, nullable=False),
    )
    made.create_all(connection, checkfirst=False)


def _to_version_4(connection: sa.Connection) -> None:
    """Facts about workers, and what is wanted of them."""
    types = {"host": "TEXT", "pid": "INTEGER", "device": "TEXT", "version": "TEXT"}
    types |= {"started_at_s": "DOUBLE PRECISION", "job_id": "TEXT", "wanted": "TEXT"}
    _add_columns(connection, "ultragray_workers", types)


def _to_version_5(connection: sa.Connection) -> None:
    """The limits of a key."""
    _add_columns(connection, "ultragray_keys", {"limits": "TEXT"})


def _to_version_6(connection: sa.Connection) -> None:
    """The claims that rows of owners are from."""
    _add_columns(connection, "ultragray_owners", {"claim": "TEXT"})


def _to_version_7(connection: sa.Connection) -> None:
    """The offers of workers."""
    _add_columns(connection, "ultragray_workers", {"offer": "TEXT"})


def _to_version_8(connection: sa.Connection) -> None:
    """The shards of render jobs."""
    made = sa.MetaData(schema=SCHEMA)
    sa.Table(
        "ultragray_shards",
        made,
        sa.Column("job_id", sa.Text, primary_key=True),
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("frames", sa.Integer, nullable=False),
        sa.Column("done", sa.Boolean, nullable=False),
        sa.Column("share", sa.Text),
        sa.Column("tries", sa.Integer, nullable=False),
        sa.Column("error", sa.Text),
        sa.Column("reason", sa.Text),
    )
    made.create_all(connection, checkfirst=False)


def _to_version_9(connection: sa.Connection) -> None:
    """The registrations of robots and trackers."""
    made = sa.MetaData(schema=SCHEMA)
    sa.Table(
        "ultragray_registrations",
        made,
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("scene", sa.Text, nullable=False),
        sa.Column("owner", sa.Text, nullable=False),
        sa.Column("changed_at_s", sa.Double, nullable=False),
        sa.Column("document", sa.Text, nullable=False),
    )
    made.create_all(connection, checkfirst=False)


def _to_version_10(connection: sa.Connection) -> None:
    """Who may see a registration of a private scene."""
    _add_columns(connection, "ultragray_registrations", {"private_to": "TEXT"})
    registrations, owners = _place(connection, "ultragray_registrations"), _place(connection, "ultragray_owners")
    connection.execute(
        sa.text(
            f"UPDATE {registrations} AS kept SET private_to = "
            f"(SELECT owner FROM {owners} WHERE kind = 'scene' AND name = kept.scene AND private)"
        )
    )


def _add_columns(connection: sa.Connection, table: str, types: dict[str, str]) -> None:
    for name, kind in types.items():
        connection.execute(sa.text(f"ALTER TABLE {_place(connection, table)} ADD COLUMN {name} {kind}"))


def _place(connection: sa.Connection, table: str) -> str:
    return table if connection.dialect.name == "sqlite" else f"{SCHEMA}.{table}"


# Each takes the tables from one version to the next. A step that has been released never changes: it says what it makes
# in full, and takes nothing from the tables above, which go on changing.
STEPS: tuple[Callable[[sa.Connection], None], ...] = (
    _to_version_1,
    _to_version_2,
    _to_version_3,
    _to_version_4,
    _to_version_5,
    _to_version_6,
    _to_version_7,
    _to_version_8,
    _to_version_9,
    _to_version_10,
)
VERSION = len(STEPS)


def migrate(engine: sa.Engine) -> None:
    """Brings our tables to this version, or leaves them as they are.

    The caller holds `one_at_a_time`. Raises StartupFailed for tables of a newer version.
    """
    with engine.begin() as connection:
        found = version(connection)
        if found <= VERSION:
            migrate_to(connection, VERSION)
    _require_known(engine, "tables", found, VERSION)


def require_known_queue(engine: sa.Engine) -> None:
    """Raises StartupFailed where a newer release has migrated the queue's own tables."""
    with engine.connect() as connection:
        schema = None if engine.dialect.name == "sqlite" else SCHEMA
        if not sa.inspect(connection).has_table(QUEUE_VERSION.name, schema=schema):
            return
        found = connection.execute(sa.select(QUEUE_VERSION.c.version)).scalar() or 0
    _require_known(engine, "tables of the queue", found, latest_queue_version(engine.dialect.name))


def _require_known(engine: sa.Engine, what: str, found: int, known: int) -> None:
    if found > known:
        engine.dispose()
        raise StartupFailed(
            f"the database of the jobs has {what} of version {found}, and this release knows them up to version "
            f"{known}: a newer release has used it; start that one, or restore a backup made before it",
            field="database_url",
        )


def version(connection: sa.Connection) -> int:
    """The version of our tables in a database; 0 where they have none, or are not there."""
    schema = None if connection.dialect.name == "sqlite" else SCHEMA
    if not sa.inspect(connection).has_table(SCHEMA_VERSION.name, schema=schema):
        return 0
    return connection.execute(sa.select(SCHEMA_VERSION.c.version)).scalar() or 0


def migrate_to(connection: sa.Connection, target: int) -> None:
    """Brings our tables from an older version to another."""
    connection.execute(sa.schema.CreateTable(SCHEMA_VERSION, if_not_exists=True))
    found = version(connection)
    for step in STEPS[found:target]:
        step(connection)
    if found < target:
        connection.execute(sa.delete(SCHEMA_VERSION))
        connection.execute(sa.insert(SCHEMA_VERSION).values(version=target))


@contextmanager
def one_at_a_time(url: sa.URL) -> Iterator[None]:
    """Keeps other processes from making or migrating tables during the body.

    IF NOT EXISTS does not: two of PostgreSQL's transactions that make the same table collide.
    """
    if url.get_backend_name() == "sqlite":
        with open(f"{url.database}.lock", "wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        return
    engine = sa.create_engine(url, poolclass=sa.NullPool, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:  # its end gives the lock back
        # A statement that waits for the lock would hold up CREATE INDEX CONCURRENTLY of the process that has it.
        while not connection.execute(sa.select(sa.func.pg_try_advisory_lock(_LOCK_NUMBER))).scalar():
            time.sleep(_LOCK_POLL_S)
        yield
