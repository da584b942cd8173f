"""OpenIGTLink, whose clients have no keys: what they see of private scenes, and what the first key changes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from ultragray_service.access.keys import KeyStore
from ultragray_service.access.principals import Role
from ultragray_service.igtl.contents import unpack_status
from ultragray_workers.jobs.database import JobDatabase

from ..conftest import RunningService, StartService
from ..igtl.conftest import Peer, address_of, moved

ALLOWED = "127.0.0.2=admin,127.0.0.3=reader"


@pytest.fixture
def keys(tmp_path: Path) -> Iterator[KeyStore]:
    database = JobDatabase(tmp_path, None)
    yield KeyStore(database.engine)
    database.close()


def serve(start_service: StartService, artifact_folder: Path) -> RunningService:
    return start_service(artifact_folder=artifact_folder, igtl_port=0, igtl_scene="demo", igtl_allow=ALLOWED)


def test_frames_of_private_scenes_go_to_nobody_else(
    start_service: StartService, tmp_path: Path, keys: KeyStore, scene_bytes: bytes
) -> None:
    _, key = keys.create("alice", Role.OPERATOR, None)
    service = serve(start_service, tmp_path)
    headers = {"X-API-Key": key}
    url = f"{service.http}/v1/scenes/kept"
    assert httpx.put(f"{url}?private=true", content=scene_bytes, headers=headers, timeout=60).status_code == 201
    with ExitStack() as opened:
        admin, watching_admin, reader = (Peer(address_of(service), source=f"127.0.0.{host}") for host in (2, 2, 3))
        for peer in (admin, watching_admin, reader):
            opened.callback(peer.socket.close)
        for peer in (watching_admin, reader):
            assert peer.ask("STT_IMAGE", "", bytes(8)).type_name == "RTS_IMAGE"
        admin.send_pose(moved(0.0), "demo")
        for peer in (admin, watching_admin, reader):
            assert peer.receive().device_name == "Image_demo"
        admin.send_pose(moved(1.0), "kept")
        for peer in (admin, watching_admin):
            assert peer.receive().device_name == "Image_kept"
        assert reader.ask("GET_IMAGE", "kept").content == b""
        assert reader.ask("GET_IMAGE", "").content, "the newest that it may see"
        assert reader.ask("GET_TRANSFORM", "kept").content == b""
        assert watching_admin.ask("GET_IMAGE", "kept").content
        assert httpx.delete(url, headers=headers, timeout=60).status_code == 204
        assert reader.ask("GET_IMAGE", "kept").content == b"", "the scene has gone, its frame is private all the same"
        reader.send_pose(moved(0.0), "ProbeToReference")
        assert reader.receive().device_name == "Image_Reference"  # nothing else was sent to it


def test_a_connection_from_before_the_first_key_is_closed(
    start_service: StartService, tmp_path: Path, keys: KeyStore
) -> None:
    service = serve(start_service, tmp_path)
    with ExitStack() as opened:
        local, named = Peer(address_of(service)), Peer(address_of(service), source="127.0.0.3")
        for peer in (local, named):
            opened.callback(peer.socket.close)
            peer.send_pose(moved(0.0))
            assert peer.image().pixels.size
        _, key = keys.create("root", Role.ADMIN, None)
        told = local.receive()
        assert (told.type_name, unpack_status(told.content).name) == ("STATUS", "UNAUTHENTICATED")
        assert local.is_closed()
        again = Peer(address_of(service), source="127.0.0.3")
        opened.callback(again.socket.close)
        again.send_pose(moved(0.0))
        assert again.image().pixels.size
        entries = httpx.get(f"{service.http}/v1/me", headers={"X-API-Key": key}, timeout=60).json()
        assert entries["key_required"]
