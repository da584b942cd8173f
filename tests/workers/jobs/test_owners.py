"""Names in the table of owners: taken by the first, and forgotten only by whose they are."""

import pytest

from ultragray_workers.jobs.owners import (
    NOBODYS,
    Kind,
    Ownership,
    add_owner,
    forget_owner,
    read_owner,
    read_owners,
)


@pytest.fixture
def database_url(new_database):
    return new_database()


def test_a_name_is_the_firsts_until_that_one_forgets_it(jobs):
    alice, bob = Ownership("alice", True, "a"), Ownership("bob", False, "b")
    with jobs.engine.begin() as connection:
        assert add_owner(connection, Kind.SCENE, "liver", alice)
        assert not add_owner(connection, Kind.SCENE, "liver", bob)
        assert add_owner(connection, Kind.DATASET, "liver", bob)
        assert read_owners(connection) == {(Kind.SCENE, "liver"): alice, (Kind.DATASET, "liver"): bob}
        forget_owner(connection, Kind.SCENE, "liver", alice)
        assert read_owner(connection, Kind.SCENE, "liver") == NOBODYS


@pytest.mark.parametrize("earlier", [Ownership("alice", True, "a"), Ownership("alice", True, None)])
def test_a_late_deletion_forgets_no_later_owner(jobs, earlier):
    with jobs.engine.begin() as connection:
        for later in (Ownership("bob", True, "b"), Ownership("alice", True, "c")):
            assert add_owner(connection, Kind.SCENE, "liver", earlier)
            forget_owner(connection, Kind.SCENE, "liver", earlier)
            assert add_owner(connection, Kind.SCENE, "liver", later)
            forget_owner(connection, Kind.SCENE, "liver", earlier)
            assert read_owner(connection, Kind.SCENE, "liver") == later
            forget_owner(connection, Kind.SCENE, "liver", later)
