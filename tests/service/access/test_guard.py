from __future__ import annotations

import time

import pytest

from ultragray_service.access.credentials import EnvironmentKeys, Guard
from ultragray_service.access.principals import LOCAL, Principal, Role
from ultragray_service.errors import Unauthenticated

KEY = "0123456789abcdef"


class Listed:
    """A source that knows what it is told."""

    def __init__(self, **principals: Principal) -> None:
        self.principals = principals

    @property
    def is_used(self) -> bool:
        return bool(self.principals)

    def authenticate(self, credential: str) -> Principal | None:
        return self.principals.get(credential)


def test_roles_include_those_before_them() -> None:
    assert [[one.includes(other) for other in Role] for one in Role] == [
        [True, False, False],
        [True, True, False],
        [True, True, True],
    ]


def test_without_a_source_everybody_is_local() -> None:
    assert Guard([EnvironmentKeys(())]).authenticate(None) is LOCAL


def test_the_first_source_that_knows_a_credential_says_whose_it_is() -> None:
    alice = Principal("alice", Role.READER, "0badcafe")
    guard = Guard([Listed(alpha=alice), EnvironmentKeys([KEY])])
    assert guard.authenticate("alpha") is alice
    assert guard.authenticate(KEY) == Principal("environment:1", Role.ADMIN, "environment")


@pytest.mark.parametrize("credential", [None, "", KEY[:-1], KEY + "0", "ключ"])
def test_nobody_passes_without_a_known_credential(credential: str | None) -> None:
    with pytest.raises(Unauthenticated):
        Guard([EnvironmentKeys([KEY])]).authenticate(credential)


def test_a_credential_counts_until_it_expires() -> None:
    def guard(expires_at_s: float) -> Guard:
        return Guard([Listed(alpha=Principal("alice", Role.READER, "0badcafe", expires_at_s))])

    assert guard(time.time() + 60).authenticate("alpha").name == "alice"
    with pytest.raises(Unauthenticated, match="alice has expired"):
        guard(time.time()).authenticate("alpha")


def test_a_source_that_lost_its_credentials_opens_no_door() -> None:
    source = Listed(alpha=Principal("alice", Role.READER, "0badcafe"))
    guard = Guard([source])
    guard.authenticate("alpha")
    source.principals.clear()
    for credential in ("alpha", None):
        with pytest.raises(Unauthenticated):
            guard.authenticate(credential)
