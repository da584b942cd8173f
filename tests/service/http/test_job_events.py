"""Events of a job over a real connection that breaks: who comes back goes on, without a gap and without a repeat."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from ultragray_service.core.jobs import TAIL_BYTES
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.record import Files, Piece
from ultragray_workers.jobs.tables import JOBS
from ultragray_workers.storage.local import LocalStorage

from ..conftest import RunningService, StartService

WAIT_S = 60.0


@dataclass(frozen=True)
class Event:
    name: str
    id: str
    data: str


def read_events(lines: Iterator[str]) -> Iterator[Event]:
    fields: dict[str, list[str]] = {}
    for line in lines:
        name, _, value = line.partition(": ")
        if line:
            fields.setdefault(name, []).append(value)
            continue
        if "event" in fields:
            yield Event(fields["event"][0], fields["id"][0], "\n".join(fields["data"]))
        fields = {}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "artifacts"


@pytest.fixture
def service(start_service: StartService, folder: Path) -> RunningService:
    return start_service(artifact_folder=folder)


@pytest.fixture
def job(service: RunningService) -> str:
    specification = {"scene": "demo", "poses": [np.eye(4).tolist()], "height": 16, "width": 16}
    body = {"kind": "render", "specification": specification}
    answer = httpx.post(f"{service.http}/v1/jobs", json=body, timeout=WAIT_S)
    assert answer.status_code == 201, answer.text
    job_id: str = answer.json()["id"]
    return job_id


class ToldLog:
    """The log of a job, as a worker tells it."""

    def __init__(self, folder: Path, job: str) -> None:
        self._folder, self._job = folder, job
        self._storage, self._pieces = LocalStorage(folder), list[Piece]()
        self.text = ""

    def write(self, text: str) -> None:
        piece = Piece(f"jobs/{self._job}/1-1/log-{len(self._pieces):05d}", len(text.encode()))
        self._storage.write(piece.key, text.encode())
        self._pieces.append(piece)
        jobs = JobDatabase(self._folder, None)
        with jobs.engine.begin() as connection:
            files = Files(log=tuple(self._pieces)).to_json()
            connection.execute(sa.update(JOBS).where(JOBS.c.id == self._job).values(files=files))
        jobs.close()
        self.text += text


@pytest.fixture
def log(folder: Path, job: str) -> ToldLog:
    return ToldLog(folder, job)


def follow(service: RunningService, job: str, last: str, wanted: int | None = None) -> list[Event]:
    """The events after `last`, until the job ends, or until `wanted` came and the connection is cut."""
    headers = {"Last-Event-ID": last} if last else {}
    told: list[Event] = []
    with httpx.stream("GET", f"{service.http}/v1/jobs/{job}/events", headers=headers, timeout=WAIT_S) as answer:
        assert answer.status_code == 200
        for event in read_events(answer.iter_lines()):
            told.append(event)
            if len(told) == wanted:
                break
    return told


def log_of(events: list[Event]) -> str:
    return "".join(f"{event.data}\n" for event in events if event.name == "log")


def test_a_client_that_comes_back_again_and_again_has_every_line_once(
    service: RunningService, job: str, log: ToldLog
) -> None:

    def write() -> None:
        for begin in range(0, 40_000, 2000):
            log.write("".join(f"step {begin + number:06d}: ähnlich wie vorher\n" for number in range(2000)))
            stop.wait(0.1)

    stop = threading.Event()
    told = follow(service, job, "", wanted=1)
    assert [event.name for event in told] == ["progress"]
    writing = threading.Thread(target=write)
    writing.start()
    try:
        while log_of(told).count("\n") < 40_000:
            told += follow(service, job, told[-1].id, wanted=1)
    finally:
        stop.set()
        writing.join(WAIT_S)
    httpx.post(f"{service.http}/v1/jobs/{job}:cancel", timeout=WAIT_S)
    told += follow(service, job, told[-1].id)
    assert log_of(told) == log.text
    states = [json.loads(event.data)["state"] for event in told if event.name == "progress"]
    assert states == ["queued", "cancelled"]
    assert follow(service, job, told[-1].id) == []


def test_who_names_no_event_or_an_unknown_one_begins_with_the_job_and_the_last_lines(
    service: RunningService, job: str, log: ToldLog
) -> None:
    log.write("".join(f"line {number}\n" for number in range(5000)))
    for last in ("", "7", "of another service", "9" * 40 + "-", "-1-"):
        told = follow(service, job, last, wanted=2)
        assert [event.name for event in told] == ["log", "progress"]
        lines = log_of(told)
        assert log.text.endswith(lines)
        assert TAIL_BYTES - 20 < len(lines) <= TAIL_BYTES


def test_a_slow_reader_loses_no_line(service: RunningService, job: str, log: ToldLog) -> None:
    told: list[Event] = []
    with httpx.stream("GET", f"{service.http}/v1/jobs/{job}/events", timeout=WAIT_S) as answer:
        events = read_events(answer.iter_lines())
        told.append(next(events))
        log.write("".join(f"{number} {'x' * 100}\n" for number in range(100_000)))  # more than sockets hold
        httpx.post(f"{service.http}/v1/jobs/{job}:cancel", timeout=WAIT_S)
        told += events
    assert log_of(told) == log.text
    final: dict[str, Any] = json.loads(told[-1].data)
    assert final["state"] == "cancelled"


def test_lines_that_end_with_a_carriage_return_are_told_as_lines(
    service: RunningService, job: str, log: ToldLog
) -> None:
    log.write("one\r\ntwo\r\n\r\nthree 1 %\rthree 2 %\r\n")
    assert log_of(follow(service, job, "", wanted=1)) == "one\ntwo\n\nthree 1 %\nthree 2 %\n"
