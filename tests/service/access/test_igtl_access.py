"""OpenIGTLink, whose clients have no keys: who may connect is told by its address."""

import socket
from contextlib import ExitStack

import httpx
import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray_service.access.keys import KeyStore
from ultragray_service.access.principals import LOCAL, AddressRoles, Principal, Role
from ultragray_service.igtl.contents import unpack_status
from ultragray_service.settings import load_settings
from ultragray_workers.jobs.database import JobDatabase

from ..igtl.conftest import Peer, address_of, moved
from ..igtl.test_igtl_commands import ask, command

KEY = "0123456789abcdef"


def test_the_first_network_that_holds_an_address_gives_its_role():
    roles = AddressRoles(["10.0.0.7=operator", "10.0.0.0/24 = reader", "fd00::/8=admin"])
    assert roles.principal_of("10.0.0.7", asks=True) == Principal("igtl:10.0.0.7", Role.OPERATOR, "igtl")
    assert roles.principal_of("::ffff:10.0.0.8", asks=True) == Principal("igtl:10.0.0.8", Role.READER, "igtl")
    assert roles.principal_of("fd00::1", asks=False) == Principal("igtl:fd00::1", Role.ADMIN, "igtl")
    assert roles.principal_of("10.0.1.1", asks=False) is None


def test_this_machine_reads_and_without_keys_does_everything():
    assert AddressRoles([]).principal_of("127.0.0.1", asks=True) == Principal("igtl:127.0.0.1", Role.READER, "igtl")
    assert AddressRoles([]).principal_of("::1", asks=False) == LOCAL
    assert AddressRoles([]).principal_of("10.0.0.7", asks=False) is None


@pytest.mark.parametrize("entry", ["10.0.0.7", "10.0.0.7=owner", "10.0.0.1/24=reader", "lab=reader", "=reader"])
def test_entries_that_cannot_be_read_are_refused(entry):
    with pytest.raises(InvalidArgument, match=r"ULTRAGRAY_IGTL_ALLOW.*10.0.0.7=reader"):
        load_settings(igtl_allow=entry)


def ask_status(address):
    peer = Peer(address)
    with peer.socket:
        peer.send("GET_STATUS")
        return peer.status()


def own_address():
    """An address of this machine that is not loopback's."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("198.51.100.1", 9))  # sends nothing
        except OSError:
            return None
        address = str(probe.getsockname()[0])
    return None if address.startswith(("127.", "0.")) else address


def test_it_stays_with_this_machine_unless_others_are_named(start_service, tmp_path):
    service = start_service(artifact_folder=tmp_path, host="0.0.0.0", api_keys=KEY, igtl_port=0)
    assert address_of(service).startswith("127.0.0.1:")
    assert ask_status(address_of(service)).name == "OK"


def test_addresses_that_are_not_named_are_dismissed(start_service, tmp_path):
    address = own_address()
    if address is None:
        pytest.skip("this machine has no address but loopback's to connect from")
    service = start_service(
        artifact_folder=tmp_path, host="0.0.0.0", api_keys=KEY, igtl_port=0, igtl_allow="203.0.113.0/24=reader"
    )
    port = address_of(service).rpartition(":")[2]
    refusal = ask_status(f"{address}:{port}")
    assert (refusal.code, refusal.name) == (5, "PERMISSION_DENIED")
    assert ask_status(f"127.0.0.1:{port}").name == "OK"


ALLOWED = "127.0.0.2=admin,127.0.0.3=reader"


@pytest.fixture
def keys(tmp_path):
    database = JobDatabase(tmp_path, None)
    yield KeyStore(database.engine)
    database.close()


def serve(start_service, artifact_folder):
    return start_service(artifact_folder=artifact_folder, igtl_port=0, igtl_scene="demo", igtl_allow=ALLOWED)


def test_frames_of_private_scenes_go_to_nobody_else(start_service, tmp_path, keys, scene_bytes):
    _, key = keys.create("alice", Role.OPERATOR, None)
    service = serve(start_service, tmp_path)
    headers = {"X-API-Key": key}
    url = f"{service.http}/v1/scenes/kept"
    assert httpx.put(f"{url}?private=true", content=scene_bytes, headers=headers, timeout=300).status_code == 201
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
        assert httpx.delete(url, headers=headers, timeout=300).status_code == 204
        assert reader.ask("GET_IMAGE", "kept").content == b"", "the scene has gone, its frame is private all the same"
        reader.send_pose(moved(0.0), "ProbeToReference")
        assert reader.receive().device_name == "Image_Reference"  # nothing else was sent to it


def test_a_connection_from_before_the_first_key_is_closed(start_service, tmp_path, keys):
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
        entries = httpx.get(f"{service.http}/v1/me", headers={"X-API-Key": key}, timeout=300).json()
        assert entries["key_required"]


def test_registrations_of_private_scenes_are_not_there_for_others(start_service, tmp_path, keys, scene_bytes):
    """Neither a choice of a parameter nor a pose that is led by it shows a reader that there is one."""
    _, alice = keys.create("alice", Role.OPERATOR, None)
    service = serve(start_service, tmp_path)

    def put(path, **body):
        answer = httpx.put(f"{service.http}/v1/{path}", headers={"X-API-Key": alice}, timeout=300, **body)
        assert answer.status_code in (200, 201), answer.text

    put("scenes/kept?private=true", content=scene_bytes)
    put("registrations/alices-arm", json={"scene": "kept", "base_to_scene": np.eye(4).tolist()})
    put("registrations/open-arm", json={"scene": "demo", "base_to_scene": np.eye(4).tolist()})
    with ExitStack() as opened:
        reader, admin = (Peer(address_of(service), source=f"127.0.0.{host}") for host in (3, 2))
        for peer in (reader, admin):
            opened.callback(peer.socket.close)
        for name in ("alices-arm", "nobodys-arm"):
            reply = ask(reader, command("SetUsParameter", ("Registration", name)))
            assert reply.get("Status") != "SUCCESS"
            assert f"there is no registration '{name}'" in str(reply.get("Error"))
            assert "kept" not in str(reply.attrib)
        for name in ("kept", "nothing"):
            reply = ask(reader, command("SetUsParameter", ("Scene", name)))
            assert reply.get("Status") != "SUCCESS"
            assert f"there is no scene '{name}'" in str(reply.get("Error")).replace("called ", "")
            reader.send_pose(moved(0.0), name, version=2)
            assert reader.receive().metadata["scene"] == "demo"
        assert ask(reader, command("SetUsParameter", ("Registration", "open-arm"))).get("Status") == "SUCCESS"
        assert ask(admin, command("SetUsParameter", ("Registration", "alices-arm"))).get("Status") == "SUCCESS"
        admin.send_pose(moved(0.0), "ProbeToTracker", version=2)
        assert admin.receive().metadata["scene"] == "kept"
