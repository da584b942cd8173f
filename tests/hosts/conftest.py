"""Several hosts on this machine, which share a PostgreSQL database and a bucket of an S3 server."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ..object_storage import FaultyProxy
from ..postgres import PostgresServer
from .host import Host


@pytest.fixture
def bucket(new_bucket: Callable[[], str]) -> str:
    """The URL of an empty bucket."""
    return new_bucket()


@pytest.fixture
def new_host(
    bucket: str, object_proxy: FaultyProxy, postgres: PostgresServer, tmp_path: Path
) -> Iterator[Callable[[str], Host]]:
    """Makes a host of that name, with a folder of its own."""
    database_url = postgres.create_database()
    hosts: list[Host] = []

    def make(name: str) -> Host:
        hosts.append(Host(tmp_path / name, f"{bucket}/artifacts", database_url))
        return hosts[-1]

    yield make
    for host in hosts:
        host.kill_all()
