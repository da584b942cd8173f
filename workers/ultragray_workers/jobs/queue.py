"""The queue: every change of a job's row, each one statement, so that of many workers and services one wins.

    submit → queued ──take──→ running ──finish──→ succeeded, failed
               ↑  ╰──cancel──╮   │ ╰──cancel──→ cancelled
               ╰── put_back ─────╯

A worker holds a job as long as the row names it and its attempt, and the worker gives signs of life (see
`jobs.workers`): `put_back_of_dead` lets others go on with the jobs of one that does not. Whatever a worker writes of a
job holds for its own attempt alone, so that one that was cut off, and comes back, changes nothing any more. What
demands fit which worker is decided by `worker.device.Gate`; here a job is taken by the keys of demands. All functions
block, and raise DatabaseUnavailable where the database is away. Free of torch.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from ultragray.errors import InvalidArgument
from ultragray_workers.jobs.demand import Demand, demand_of_key
from ultragray_workers.jobs.kinds.base import Specification
from ultragray_workers.jobs.owners import Kind, Ownership, claim_of_job, forget_owner
from ultragray_workers.jobs.progress import Files, JobState, Outcome, Progress
from ultragray_workers.jobs.record import COLUMNS, Row
from ultragray_workers.jobs.tables import JOBS, SHARDS, USAGE, WORKERS, insert, read, write

SHARE = "share"  # the kind of a share of a batch
DEAD_AFTER_S = 10.0  # without a sign of life a worker is taken for dead
_QUEUED, _RUNNING = JobState.QUEUED.value, JobState.RUNNING.value
_IS_JOB = JOBS.c.batch.is_(None)  # and no share of one
_IS_UNFINISHED = JOBS.c.state.in_([_QUEUED, _RUNNING])


class SceneTaken(Exception):
    """Another job that waits or runs makes a scene of the same name."""


def submit(engine: sa.Engine, values: dict[str, Any], also: Callable[[sa.Connection], None]) -> bool:
    """Puts a job behind all others of its priority, and does `also` in the same transaction.

    False: there is a job of the id, and nothing changed. Raises SceneTaken, and what `also` raises.
    """
    try:
        with engine.begin() as connection:
            inserted = insert(connection, JOBS).values(state=_QUEUED, created_ms=_now_ms(), **values)
            statement = inserted.on_conflict_do_nothing(index_elements=["id"]).returning(JOBS.c.number)
            if connection.execute(statement).first() is None:
                return False
            also(connection)
    except IntegrityError as error:
        raise SceneTaken from error
    return True


def take(engine: sa.Engine, worker: str, demands: Sequence[str]) -> Row | None:
    """The next job with one of the demands, which is the worker's now; None where there is none.

    A job waits, too, while its owner has as many running as `most_running` says; two workers that look in the same
    instant may start one more.
    """
    if not demands:
        return None
    running = JOBS.alias()
    of_owner = (
        sa.select(sa.func.count())
        .where(running.c.state == _RUNNING, running.c.owner == JOBS.c.owner)
        .correlate(JOBS)
        .scalar_subquery()
    )
    has_room = sa.or_(JOBS.c.most_running.is_(None), of_owner < JOBS.c.most_running)
    following = (
        sa.select(JOBS.c.number)
        .where(JOBS.c.state == _QUEUED, JOBS.c.demand.in_(demands), has_room)
        .order_by(JOBS.c.priority.desc(), JOBS.c.number)
        .limit(1)
        .with_for_update(skip_locked=True, of=JOBS)
    )
    while True:  # on SQLite another worker may take it between the two
        with engine.begin() as connection:
            number = connection.execute(following).scalar()
            if number is None:
                return None
            statement = (
                sa.update(JOBS)
                .where(JOBS.c.number == number, JOBS.c.state == _QUEUED)
                .values(state=_RUNNING, worker=worker, attempt=JOBS.c.attempt + 1, started_ms=_now_ms())
                .returning(*COLUMNS)
            )
            row = connection.execute(statement).one_or_none()
        if row is not None:
            return Row.of(row)


def put_back(engine: sa.Engine, row: Row, *, is_untouched: bool = False) -> bool:
    """Lets a job wait again; False where it is not the attempt of `row` any more.

    `is_untouched`: nothing was done, and the attempt is not counted.
    """
    attempt = JOBS.c.attempt - (1 if is_untouched else 0)
    return _change(engine, row, state=_QUEUED, attempt=attempt)


def put_back_of_dead(engine: sa.Engine) -> list[str]:
    """Lets the jobs wait again that no living worker runs; their ids."""
    living = sa.select(WORKERS.c.name).where(WORKERS.c.seen_at_s > now_s(engine) - DEAD_AFTER_S)
    dead = sa.and_(JOBS.c.state == _RUNNING, JOBS.c.worker.not_in(living))
    return _put_back(engine, dead)


def put_back_of(engine: sa.Engine, worker: str | None = None) -> list[str]:
    """Lets the jobs of a worker wait again that has just begun, and so runs none; None: of all workers."""
    return _put_back(engine, JOBS.c.state == _RUNNING if worker is None else _is_run_by(worker))


def _put_back(engine: sa.Engine, condition: sa.ColumnElement[bool]) -> list[str]:
    if not read(engine, sa.select(JOBS.c.id).where(condition).limit(1)):  # a look locks nothing
        return []
    with engine.begin() as connection:
        changed = sa.update(JOBS).where(condition).values(state=_QUEUED).returning(JOBS.c.id)
        return list(connection.execute(changed).scalars())


def is_held(engine: sa.Engine, row: Row) -> bool:
    return bool(read(engine, sa.select(JOBS.c.number).where(*_holds(row))))


def tell(engine: sa.Engine, row: Row, progress: Progress | None, files: Files) -> bool:
    """Says how far a job is and what there is of it, also of one that was just cancelled: a retry goes on there.

    False where it is not the attempt of `row` any more.
    """
    is_its = JOBS.c.state.in_([_RUNNING, JobState.CANCELLED.value]), JOBS.c.worker == row.worker
    statement = sa.update(JOBS).where(JOBS.c.id == row.id, *is_its, JOBS.c.attempt == row.attempt)
    return write(engine, statement.values(progress=progress, files=files))


def publish(engine: sa.Engine, row: Row, outcome: Outcome, files: Files) -> bool:
    """Decides that the scene of a job is served: from now on it cannot be cancelled, and who takes it over serves it.

    False where it was cancelled first, or is not the attempt of `row` any more.
    """
    return _change(engine, row, published=True, outcome=outcome, files=files)


def finish(engine: sa.Engine, row: Row, outcome: Outcome, files: Files) -> bool:
    """Ends a job, which gives back the name of a scene that it did not make.

    False where it is not the attempt of `row` any more.
    """
    state = JobState.SUCCEEDED if outcome.error is None else JobState.FAILED
    ended = {
        "state": state.value,
        "outcome": outcome,
        "progress": outcome.progress,
        "files": files,
        "finished_ms": _now_ms(),
    }
    with engine.begin() as connection:
        if not connection.execute(sa.update(JOBS).where(*_holds(row)).values(ended)).rowcount:
            return False
        if outcome.error is not None:
            _give_name_back(connection, row)
    return True


def cancel(engine: sa.Engine, job_id: str) -> bool:
    """Cancels a job that waits or runs, with its shares; False where it has ended, or its scene is being served."""
    is_asked = sa.or_(JOBS.c.id == job_id, JOBS.c.batch == job_id)
    ended = {"state": JobState.CANCELLED.value, "finished_ms": _now_ms()}
    changed = sa.update(JOBS).where(is_asked, _IS_UNFINISHED, JOBS.c.published.is_(False)).values(ended)
    with engine.begin() as connection:
        cancelled = connection.execute(
            changed.returning(JOBS.c.id, JOBS.c.kind, JOBS.c.makes_scene, JOBS.c.owner)
        ).all()
        for row in cancelled:
            _give_name_back(connection, row)
    return any(row.id == job_id for row in cancelled)


def _give_name_back(connection: sa.Connection, job: Any) -> None:
    """Frees the name of the scene that a job was to make; one that it serves already stays its owner's."""
    if job.makes_scene is not None and not Specification.member(job.kind).serves_versions:
        forget_owner(connection, Kind.SCENE, job.makes_scene, Ownership(job.owner, claim=claim_of_job(job.id)))


def cancel_shares(engine: sa.Engine, batch: str) -> None:
    """Ends the shares of a batch that is over: those that wait, and those that run within a second."""
    ended = {"state": JobState.CANCELLED.value, "finished_ms": _now_ms()}
    write(engine, sa.update(JOBS).where(JOBS.c.batch == batch, _IS_UNFINISHED).values(ended))


def forget(engine: sa.Engine, job_id: str) -> None:
    """Removes the row of a job, of its shares and of its shards; what it ran stays in the usage of its owner."""
    with engine.begin() as connection:
        connection.execute(sa.delete(JOBS).where(sa.or_(JOBS.c.id == job_id, JOBS.c.batch == job_id)))
        connection.execute(sa.delete(SHARDS).where(SHARDS.c.job == job_id))


def row_of(engine: sa.Engine, job_id: str) -> Row | None:
    return _job(engine, JOBS.c.id == job_id)


def specification_of(engine: sa.Engine, job_id: str) -> dict[str, Any]:
    ((specification,),) = read(engine, sa.select(JOBS.c.specification).where(JOBS.c.id == job_id))
    return dict(specification)


def page(
    engine: sa.Engine,
    *,
    state: JobState | None,
    kind: str | None,
    shown: Callable[[Row], bool],
    page_size: int,
    page_token: str | None,
) -> tuple[list[Row], str | None]:
    """One page of jobs, newest first, of those that are `shown`, and the token of the next; None on the last.

    The token is the number of the last job, so that later jobs move nothing. Raises InvalidArgument for another.
    """
    before = _read_token(page_token)
    chosen = sa.select(*COLUMNS).where(_IS_JOB).order_by(JOBS.c.number.desc()).limit(page_size + 1)
    if state is not None:
        chosen = chosen.where(JOBS.c.state == state.value)
    if kind is not None:
        chosen = chosen.where(JOBS.c.kind == kind)
    jobs: list[Row] = []
    while len(jobs) <= page_size:
        following = chosen if before is None else chosen.where(JOBS.c.number < before)
        rows = [Row.of(row) for row in read(engine, following)]
        jobs += filter(shown, rows)
        if len(rows) <= page_size:
            break
        before = rows[-1].number
    return jobs[:page_size], str(jobs[page_size - 1].number) if len(jobs) > page_size else None


def _read_token(token: str | None) -> int | None:
    if token is None:
        return None
    if not (token.isascii() and token.isdigit() and len(token) < 19):
        raise InvalidArgument(f"page_token must be one that a page gave, got {token[:64]!r}", field="page_token")
    return int(token)


def count_by_state(engine: sa.Engine) -> dict[JobState, int]:
    counted = sa.select(JOBS.c.state, sa.func.count()).where(_IS_JOB).group_by(JOBS.c.state)
    return {JobState(state): count for state, count in read(engine, counted)}


def count_waiting(engine: sa.Engine) -> int:
    return _count(engine, JOBS.c.state == _QUEUED)


def count_of_owner(engine: sa.Engine, owner: str) -> int:
    return _count(engine, sa.and_(_IS_UNFINISHED, JOBS.c.owner == owner))


def _count(engine: sa.Engine, condition: sa.ColumnElement[bool]) -> int:
    ((count,),) = read(engine, sa.select(sa.func.count()).select_from(JOBS).where(_IS_JOB, condition))
    return int(count)


def demands_waiting(engine: sa.Engine) -> list[str]:
    """The keys of the demands that jobs which wait have: one step in an index for each, however many jobs there are."""
    waits, key = JOBS.c.state == _QUEUED, JOBS.c.demand
    keys = sa.select(sa.func.min(key).label("key")).where(waits).cte("found", recursive=True)
    following = sa.select(sa.func.min(key)).where(waits, key > keys.c.key).scalar_subquery()
    keys = keys.union_all(sa.select(following).where(keys.c.key.is_not(None)))
    return [row.key for row in read(engine, sa.select(keys.c.key).where(keys.c.key.is_not(None)))]


def waiting(engine: sa.Engine) -> list[tuple[Demand, int, int]]:
    """Each demand of jobs that wait, how many there are, and when the first was submitted, ms since 1970."""
    grouped = sa.select(JOBS.c.demand, sa.func.count(), sa.func.min(JOBS.c.created_ms)).group_by(JOBS.c.demand)
    rows = read(engine, grouped.where(JOBS.c.state == _QUEUED, _IS_JOB))
    return [(demand_of_key(key), count, oldest_ms) for key, count, oldest_ms in rows]


def find(engine: sa.Engine, *, needs_dataset: str | None = None, makes_scene: str | None = None) -> Row | None:
    """A job that waits or runs, and needs a dataset or makes a scene; None where there is none."""
    chosen = JOBS.c.dataset == needs_dataset if makes_scene is None else JOBS.c.makes_scene == makes_scene
    return _job(engine, chosen, _IS_UNFINISHED, _IS_JOB)


def successor(engine: sa.Engine, job_id: str) -> str | None:
    retry = _job(engine, _IS_UNFINISHED, JOBS.c.retry_of == job_id)
    return None if retry is None else retry.id


def known_ids(engine: sa.Engine, ids: Sequence[str]) -> set[str]:
    """The ids among these that are jobs or shares."""
    return {row.id for row in read(engine, sa.select(JOBS.c.id).where(JOBS.c.id.in_(ids)))}


def ids_of_owner(engine: sa.Engine, owner: str) -> list[str]:
    return [row.id for row in read(engine, sa.select(JOBS.c.id).where(_IS_JOB, JOBS.c.owner == owner))]


def finished_ago(engine: sa.Engine, age_s: float, but: set[str], limit: int) -> list[str]:
    """Jobs that ended so long ago and that no unfinished one goes on from, without `but`.

    The clock is the database's: a host whose own is wrong would remove what others still need.
    """
    other = JOBS.alias()
    goes_on = sa.select(other.c.id).where(other.c.retry_of == JOBS.c.id, other.c.state.in_([_QUEUED, _RUNNING]))
    old = sa.select(JOBS.c.id).where(_IS_JOB, JOBS.c.finished_ms < 1000 * (now_s(engine) - age_s), ~goes_on.exists())
    return [row.id for row in read(engine, old.where(JOBS.c.id.not_in(but)).limit(limit))]


def add_share(engine: sa.Engine, batch: str, share: str) -> None:
    """Puts a share of a batch into the queue, unless one waits there."""
    waits = sa.select(JOBS.c.id).where(JOBS.c.batch == batch, JOBS.c.state == _QUEUED).limit(1)
    copied = ("priority", "owner", "private", "asked", "summary", "specification", "dataset", "demand", "most_running")
    values = {
        **{name: JOBS.c[name] for name in (*copied, "trace")},
        "id": sa.literal(share),
        "kind": sa.literal(SHARE),
        "state": sa.literal(_QUEUED),
        "batch": sa.literal(batch),
        "created_ms": sa.literal(_now_ms(), sa.BigInteger),
        "attempt": sa.literal(0),
        "run_s": sa.literal(0.0),
        "published": sa.false(),
    }
    if not read(engine, waits):
        of_batch = sa.select(*values.values()).where(JOBS.c.id == batch, _IS_UNFINISHED)
        write(engine, sa.insert(JOBS).from_select(list(values), of_batch, include_defaults=False))


def blame_shard(engine: sa.Engine, share: Row, outcome: Outcome) -> None:
    """Blames the first shard that a job or share had at hand for the end of its work; nothing where it had none."""
    mine = SHARDS.c.job == (share.batch or share.id), SHARDS.c.share == share.id, ~SHARDS.c.done
    values = {"share": None, "error": outcome.error, "reason": outcome.reason or outcome.error}
    with engine.begin() as connection:
        number = connection.execute(sa.select(sa.func.min(SHARDS.c.number)).where(*mine)).scalar()
        connection.execute(sa.update(SHARDS).where(*mine, SHARDS.c.number == number).values(values))


def add_run_time(engine: sa.Engine, row: Row, device: str, seconds: float) -> None:
    """Counts time that a job's process ran, for the job and for its owner."""
    key: dict[str, Any] = {
        "owner": row.owner or "",
        "device": "cpu" if device == "cpu" else "gpu",
        "day": datetime.now(timezone.utc).date(),
    }
    with engine.begin() as connection:
        of_job = sa.update(JOBS).where(JOBS.c.id == row.id).values(run_s=JOBS.c.run_s + seconds)
        connection.execute(of_job)
        counted = insert(connection, USAGE).values(**key, run_s=seconds)
        more = {"run_s": USAGE.c.run_s + seconds}
        connection.execute(counted.on_conflict_do_update(index_elements=list(key), set_=more))


def usage_s(engine: sa.Engine, owner: str | None, since: datetime) -> dict[str, float]:
    """Seconds that the jobs of an owner ran since the day of `since` (UTC), by device: cpu, gpu."""
    chosen = sa.and_(USAGE.c.owner == (owner or ""), USAGE.c.day >= since.astimezone(timezone.utc).date())
    summed = sa.select(USAGE.c.device, sa.func.sum(USAGE.c.run_s)).where(chosen).group_by(USAGE.c.device)
    return {"cpu": 0.0, "gpu": 0.0} | dict(read(engine, summed))


def now_s(engine: sa.Engine) -> sa.ColumnElement[float]:
    """The time by the clock of the database, which all hosts share."""
    if engine.dialect.name == "sqlite":  # days since noon of a day long ago
        return (sa.func.julianday("now", type_=sa.Double) - 2440587.5) * 86400.0
    return sa.cast(sa.func.extract("epoch", sa.func.clock_timestamp()), sa.Double)


def _change(engine: sa.Engine, row: Row, **values: Any) -> bool:
    return write(engine, sa.update(JOBS).where(*_holds(row)).values(values))


def _job(engine: sa.Engine, *conditions: sa.ColumnElement[bool]) -> Row | None:
    rows = read(engine, sa.select(*COLUMNS).where(*conditions).limit(1))
    return Row.of(rows[0]) if rows else None


def _holds(row: Row) -> tuple[sa.ColumnElement[bool], ...]:
    return JOBS.c.id == row.id, _is_run_by(row.worker), JOBS.c.attempt == row.attempt


def _is_run_by(worker: str | None) -> sa.ColumnElement[bool]:
    return sa.and_(JOBS.c.state == _RUNNING, JOBS.c.worker == worker)


def _now_ms() -> int:
    return int(time.time() * 1000)
