"""Registrations of private scenes: nobody sees them but the owner of the scene and admins."""

from __future__ import annotations

import pytest

from .conftest import MATRIX, Keyed
from .test_ownership import names

ARM = "/v1/registrations/alices-arm"


def seen(keyed: Keyed) -> dict[str, tuple[int, bool]]:
    """The status of asking for it, and whether it is in the list."""
    return {
        who: (keyed.http(who, "GET", ARM).status_code, "alices-arm" in names(keyed, who, "registrations"))
        for who in ("alice", "admin", "bob", "reader")
    }


@pytest.mark.parametrize("private", ["true", "false"])
def test_it_stays_private_when_its_scene_is_deleted_and_another_takes_the_name(
    keyed: Keyed, scene_bytes: bytes, private: str
) -> None:
    scene = "/v1/scenes/patient-42"
    assert keyed.http("alice", "PUT", f"{scene}?private=true", content=scene_bytes).status_code == 201
    body = {"scene": "patient-42", "base_to_scene": MATRIX, "probe_to_flange": MATRIX}
    assert keyed.http("alice", "PUT", ARM, json=body).status_code == 200
    as_before = {"alice": (200, True), "admin": (200, True), "bob": (404, False), "reader": (404, False)}
    assert seen(keyed) == as_before
    assert keyed.http("alice", "DELETE", scene).status_code == 204
    assert seen(keyed) == as_before
    request = {"pose": {"matrix": MATRIX}, "registration": "alices-arm"}
    refused = keyed.http("bob", "POST", "/v1/scenes/demo/render", json=request)
    assert (refused.status_code, refused.json()["reason"]) == (404, "REGISTRATION_NOT_FOUND")
    assert "patient-42" not in refused.text
    assert keyed.http("bob", "PUT", f"{scene}?private={private}", content=scene_bytes).status_code == 201
    assert seen(keyed) == as_before
    if private == "false":
        assert keyed.http("alice", "POST", f"{scene}/render", json=request).status_code == 200
    refused = keyed.http("bob", "POST", f"{scene}/render", json=request)
    assert (refused.status_code, refused.json()["reason"]) == (404, "REGISTRATION_NOT_FOUND")
    assert keyed.http("alice", "DELETE", ARM).status_code == 204
    assert keyed.http("bob", "DELETE", scene).status_code == 204


def test_one_that_an_admin_puts_for_a_private_scene_is_for_its_owner_too(keyed: Keyed, scene_bytes: bytes) -> None:
    scene = "/v1/scenes/patient-43"
    assert keyed.http("alice", "PUT", f"{scene}?private=true", content=scene_bytes).status_code == 201
    body = {"scene": "patient-43", "base_to_scene": MATRIX, "probe_to_flange": MATRIX}
    assert keyed.http("admin", "PUT", ARM, json=body).status_code == 200
    assert seen(keyed) == {"alice": (200, True), "admin": (200, True), "bob": (404, False), "reader": (404, False)}
    assert keyed.http("admin", "DELETE", ARM).status_code == 204
    assert keyed.http("alice", "DELETE", scene).status_code == 204


def test_an_admin_who_replaces_one_for_a_private_scene_takes_it_from_its_first_owner(
    keyed: Keyed, scene_bytes: bytes
) -> None:
    scene = "/v1/scenes/patient-44"
    assert keyed.http("alice", "PUT", f"{scene}?private=true", content=scene_bytes).status_code == 201
    body = {"scene": "demo", "base_to_scene": MATRIX, "probe_to_flange": MATRIX}
    assert keyed.http("bob", "PUT", ARM, json=body).status_code == 200
    assert keyed.http("admin", "PUT", ARM, json={**body, "scene": "patient-44"}).status_code == 200
    assert seen(keyed) == {"alice": (200, True), "admin": (200, True), "bob": (404, False), "reader": (404, False)}
    assert keyed.http("alice", "GET", ARM).json()["owner"] == "admin"
    assert keyed.http("bob", "DELETE", ARM).status_code == 404
    assert keyed.http("bob", "PUT", ARM, json=body).status_code == 403
    assert keyed.http("admin", "DELETE", ARM).status_code == 204
    assert keyed.http("alice", "DELETE", scene).status_code == 204


def test_one_of_a_scene_that_all_may_see_is_seen_by_all(keyed: Keyed) -> None:
    body = {"scene": "demo", "base_to_scene": MATRIX, "probe_to_flange": MATRIX}
    assert keyed.http("alice", "PUT", ARM, json=body).status_code == 200
    assert set(seen(keyed).values()) == {(200, True)}
    assert keyed.http("alice", "DELETE", ARM).status_code == 204
