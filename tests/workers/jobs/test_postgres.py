"""One queue in PostgreSQL under workers of several hosts, and what is told where the database cannot be used."""

import logging

import pytest
import sqlalchemy as sa

from ultragray_workers.errors import DatabaseUnavailable, StartupFailed
from ultragray_workers.jobs.database import JobDatabase, checked_url
from ultragray_workers.jobs.store import JobStore

from ...postgres import PASSWORD


@pytest.fixture
def database_url(postgres):
    return postgres.create_database()


def test_database_that_cannot_be_used_is_told_in_one_sentence(postgres, database_url, tmp_path, caplog):
    name = database_url.rpartition("/")[2]
    refused = {
        postgres.url("absent"): 'database "absent" does not exist',
        postgres.url(name, password="wrong!"): "password authentication failed",
        f"postgresql://me:{PASSWORD}@127.0.0.1:1/jobs": "must be postgresql://",
        "postgresql://me:s3cret@127.0.0.1:1/jobs": "Connection refused",
        f"mysql://me:s3cret@127.0.0.1/{name}": "must be postgresql://",
        "postgresql://me:s3cret@127.0.0.1": "must be postgresql://",
    }
    for url, told in refused.items():
        with pytest.raises(StartupFailed, match=told) as caught:
            JobStore(tmp_path, url)
        assert "\n" not in caught.value.detail
        assert caught.value.field == "database_url"
        for secret in ("s3cret", "wrong!"):
            assert secret not in caught.value.detail + caplog.text
    assert caplog.text == ""


def test_statement_that_takes_too_long(postgres, database_url, tmp_path):
    assert "statement_timeout" in checked_url(database_url, tmp_path)
    jobs = JobDatabase(tmp_path, f"{database_url}?options=-c%20statement_timeout%3D300")
    with pytest.raises(DatabaseUnavailable), jobs.engine.begin() as connection:
        connection.execute(sa.text("SELECT pg_sleep(20)"))
    jobs.close()


def test_role_that_sees_no_other_database_is_enough(postgres, database_url, tmp_path, caplog):
    name = database_url.rpartition("/")[2]
    postgres.execute("CREATE ROLE modest LOGIN PASSWORD 'modest'")
    postgres.execute("REVOKE CONNECT ON DATABASE postgres FROM PUBLIC")
    with pytest.raises(StartupFailed, match="permission denied"):
        JobStore(tmp_path, postgres.url(name, user="modest", password="modest"))
    postgres.execute(f"GRANT CREATE ON DATABASE {name} TO modest")
    with caplog.at_level(logging.WARNING):
        JobStore(tmp_path, postgres.url(name, user="modest", password="modest")).close()
    assert caplog.text == ""
