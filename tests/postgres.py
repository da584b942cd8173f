"""A PostgreSQL server of Debian's package, started by the tests that need one and ended with them."""

import itertools
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path
from urllib.parse import quote

import psycopg
import pytest
from psycopg import sql

from .waiting import Deadline

PASSWORD = "s3cret/with@signs"
_START_TIMEOUT_S = 300.0
_UNPRIVILEGED = "nobody"  # PostgreSQL refuses to run as root


class PostgresServer:
    """A server on a free port of 127.0.0.1, with the role `postgres`, which has a password."""

    def __init__(self):
        """Skips the test where PostgreSQL is not installed."""
        self._programs = _program_folder()
        self._numbers = itertools.count()
        self._folder = Path(tempfile.mkdtemp(prefix="ultragray-postgres-"))  # pytest's are not open to other users
        self._user = _UNPRIVILEGED if os.geteuid() == 0 else None
        if self._user is not None:
            shutil.chown(self._folder, self._user)
        password = self._folder / "password"
        password.write_text(PASSWORD)
        self._log = self._folder / "log"
        self._process = None
        options = ["--no-sync", "--no-locale", "--encoding=UTF8", "--username=postgres", "--auth=scram-sha-256"]
        with self._log.open("ab") as log:
            subprocess.run(
                [self._programs / "initdb", *options, f"--pwfile={password}", self._folder / "data"],
                stdout=log,
                stderr=log,
                cwd=self._folder,
                user=self._user,
                check=True,
            )
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.start()

    def start(self):
        """Returns once connections are answered."""
        settings = [
            f"port={self.port}",
            "listen_addresses=127.0.0.1",
            f"unix_socket_directories={self._folder}",
            "fsync=off",
            "full_page_writes=off",
        ]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [self._programs / "postgres", "-D", self._folder / "data", *(f"--{setting}" for setting in settings)],
                stdout=log,
                stderr=log,
                cwd=self._folder,
                user=self._user,
            )
        end = Deadline(_START_TIMEOUT_S)
        while True:
            try:
                self._connect().close()
                return
            except psycopg.OperationalError:
                assert self._process.poll() is None, self._log.read_text()
                assert not end.passed, self._log.read_text()
                time.sleep(0.05)

    def stop(self):
        """Ends all connections, as a restart of the server does."""
        self._process.send_signal(signal.SIGINT)
        self._process.wait(300)

    def pause(self):
        """Whoever is connected hears nothing any more, and is not told why."""
        self._signal_all(signal.SIGSTOP)

    def resume(self):
        """Goes on as if nothing had been."""
        self._signal_all(signal.SIGCONT)

    def _signal_all(self, number):
        os.kill(self._process.pid, number)  # first: then there are no new children
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text()
        for pid in children.split():
            os.kill(int(pid), number)

    def execute(self, statement):
        """Runs one statement as the server's owner."""
        with self._connect() as connection:
            connection.execute(statement)

    def set_read_only(self, url, value):
        """Lets the transactions of a database change nothing, as those of a standby, or change what they like again."""
        name = url.rpartition("/")[2]
        statement = sql.SQL("ALTER DATABASE {} SET default_transaction_read_only = {}")
        with self._connect() as connection:
            connection.execute(statement.format(sql.Identifier(name), sql.Literal(value)))
            # Connections take it when they are made.
            connection.execute("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s", [name])

    def create_database(self):
        """The URL of a new database."""
        name = f"jobs_{next(self._numbers)}"
        with self._connect() as connection:
            connection.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(name)))
        return self.url(name)

    def url(self, database, *, user="postgres", password=PASSWORD):
        """As an operator writes it."""
        return f"postgresql://{user}:{quote(password, safe='')}@127.0.0.1:{self.port}/{database}"

    def remove(self):
        """Nothing is left of it."""
        if self._process is not None and self._process.poll() is None:
            self.stop()
        shutil.rmtree(self._folder)

    def _connect(self):
        return psycopg.connect(
            host="127.0.0.1",
            port=self.port,
            user="postgres",
            password=PASSWORD,
            dbname="postgres",
            autocommit=True,
            connect_timeout=300,
        )


@pytest.fixture(scope="session")
def postgres():
    """One server for all tests: they make databases of their own in it."""
    server = PostgresServer()
    yield server
    server.remove()


@pytest.fixture(params=["sqlite", "postgresql"])
def new_database(request):
    """Makes the URL of an empty database; None: a SQLite file in the artifact folder."""
    if request.param == "sqlite":
        return lambda: None
    server = request.getfixturevalue("postgres")
    return server.create_database


def _program_folder():
    """Debian keeps the server's programs out of PATH."""
    found = shutil.which("initdb")
    candidates = [*Path("/usr/lib/postgresql").glob("*/bin/initdb"), *([Path(found)] if found else [])]
    if not candidates:
        pytest.skip("PostgreSQL is not installed: on Debian, apt-get install postgresql")
    return candidates[-1].resolve().parent
