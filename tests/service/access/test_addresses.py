"""OpenIGTLink asks for no key: who may connect is told by its address."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from ultragray.errors import InvalidArgument
from ultragray_service.access.principals import LOCAL, AddressRoles, Principal, Role
from ultragray_service.igtl.contents import Status
from ultragray_service.settings import load_settings

from ..conftest import RunningService, StartService
from ..igtl.conftest import Peer

KEY = "0123456789abcdef"


def test_the_first_network_that_holds_an_address_gives_its_role() -> None:
    roles = AddressRoles(["10.0.0.7=operator", "10.0.0.0/24 = reader", "fd00::/8=admin"])
    assert roles.principal_of("10.0.0.7", asks=True) == Principal("igtl:10.0.0.7", Role.OPERATOR, "igtl")
    assert roles.principal_of("::ffff:10.0.0.8", asks=True) == Principal("igtl:10.0.0.8", Role.READER, "igtl")
    assert roles.principal_of("fd00::1", asks=False) == Principal("igtl:fd00::1", Role.ADMIN, "igtl")
    assert roles.principal_of("10.0.1.1", asks=False) is None


def test_this_machine_reads_and_without_keys_does_everything() -> None:
    assert AddressRoles([]).principal_of("127.0.0.1", asks=True) == Principal("igtl:127.0.0.1", Role.READER, "igtl")
    assert AddressRoles([]).principal_of("::1", asks=False) == LOCAL
    assert AddressRoles([]).principal_of("10.0.0.7", asks=False) is None


@pytest.mark.parametrize("entry", ["10.0.0.7", "10.0.0.7=owner", "10.0.0.1/24=reader", "lab=reader", "=reader"])
def test_entries_that_cannot_be_read_are_refused(entry: str) -> None:
    with pytest.raises(InvalidArgument, match=r"ULTRAGRAY_IGTL_ALLOW.*10.0.0.7=reader"):
        load_settings(igtl_allow=entry)


def address_of(service: RunningService) -> str:
    return next(str(record["igtl"]) for record in service.log() if "igtl" in record)


def ask_status(address: str) -> Status:
    peer = Peer(address)
    with peer.socket:
        peer.send("GET_STATUS")
        return peer.status()


def own_address() -> str | None:
    """An address of this machine that is not loopback's."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("198.51.100.1", 9))  # sends nothing
        except OSError:
            return None
        address = str(probe.getsockname()[0])
    return None if address.startswith(("127.", "0.")) else address


def test_it_stays_with_this_machine_unless_others_are_named(start_service: StartService, tmp_path: Path) -> None:
    service = start_service(artifact_folder=tmp_path, host="0.0.0.0", api_keys=KEY, igtl_port=0)
    assert address_of(service).startswith("127.0.0.1:")
    assert ask_status(address_of(service)).name == "OK"


def test_addresses_that_are_not_named_are_dismissed(start_service: StartService, tmp_path: Path) -> None:
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
