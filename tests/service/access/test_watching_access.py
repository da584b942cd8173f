"""Whose streams a key may watch."""

from __future__ import annotations

import json

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from .conftest import Keyed

POSE = {"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}


@pytest.mark.long
def test_only_the_owner_and_admins_see_a_stream(keyed: Keyed, scene_bytes: bytes) -> None:
    keyed.http("alice", "PUT", "/v1/scenes/hers", content=scene_bytes)
    base = keyed.service.http.replace("http", "ws", 1)
    with connect(f"{base}/v1/scenes/hers/stream?name=arm", additional_headers=keyed.headers("alice")) as robot:
        robot.send(json.dumps({"sequence": 1, "pose": POSE}))
        robot.recv(timeout=120)

        def seen(who: str) -> list[str]:
            return [
                one["id"] for one in keyed.http(who, "GET", "/v1/streams").json()["streams"] if one["name"] == "arm"
            ]

        (stream_id,) = seen("alice")
        assert seen("admin") == [stream_id]
        assert seen("bob") == seen("reader") == []
        with pytest.raises(InvalidStatus) as refused:
            connect(f"{base}/v1/streams/{stream_id}/watch", additional_headers=keyed.headers("bob"))
        assert json.loads(refused.value.response.body)["reason"] == "STREAM_NOT_FOUND"
        with connect(f"{base}/v1/streams/{stream_id}/watch", additional_headers=keyed.headers("alice")):
            pass
