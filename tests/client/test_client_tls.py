"""Both clients over TLS against a real service, and what is said where the two sides do not fit."""

import warnings

import numpy as np
import pytest
import trustme

from ultragray_client import Tls, errors
from ultragray_client.connection import warn_of_open_key

from ..certificates import Mounted, write_client
from .conftest import KEY


@pytest.fixture(scope="module")
def mounted(tmp_path_factory):
    return Mounted(tmp_path_factory.mktemp("certificates") / "tls")


@pytest.fixture(scope="module")
def tls_service(start_service, mounted):
    return start_service(**mounted.settings())


@pytest.fixture(scope="module")
def mutual_service(start_service, mounted):
    return start_service(**mounted.settings(mutual=True))


def test_frames_come_over_tls(tls_service, mounted, make_client):
    client = make_client(tls_service.grpc, tls=Tls(root_certificates=mounted.root), timeout_s=300.0)
    assert client.render("demo", np.eye(4))["bmode"].any()
    with client.stream("demo") as stream:
        stream.send(np.eye(4))
        assert stream.receive().sequence == 1


def test_mutual_tls_takes_a_certificate_and_its_key(mutual_service, mounted, make_client, tmp_path):
    certificate, key = write_client(mounted.authority, tmp_path)
    tls = Tls(root_certificates=mounted.root, certificate=certificate, key=key)
    assert make_client(mutual_service.grpc, tls=tls, timeout_s=300.0).scenes.list()
    without = make_client(mutual_service.grpc, tls=Tls(root_certificates=mounted.root), timeout_s=1.0)
    with pytest.raises(errors.Unreachable, match="may want TLS, or a client's certificate"):
        without.scenes.list()


def test_a_name_of_the_certificate_in_place_of_the_address(start_service, make_client, tmp_path):
    elsewhere = Mounted(tmp_path / "tls")
    elsewhere.put(elsewhere.authority.issue_cert("ultragray.hospital.example"))
    service = start_service(**elsewhere.settings())
    roots = elsewhere.root
    with pytest.raises(errors.TlsFailed, match=r"certificate of another name.*tls.server_name"):
        make_client(service.grpc, tls=Tls(root_certificates=roots)).scenes.list()
    tls = Tls(root_certificates=roots, server_name="ultragray.hospital.example")
    assert make_client(service.grpc, tls=tls, timeout_s=300.0).scenes.list()


def test_sides_that_do_not_fit_are_told_at_once(tls_service, client_service, mounted, make_client, tmp_path):
    own = Tls(root_certificates=mounted.root)
    with pytest.raises(errors.TlsFailed, match="does not speak TLS: leave out tls"):
        make_client(client_service.grpc, tls=own).scenes.list()
    stranger = tmp_path / "stranger.pem"
    trustme.CA().cert_pem.write_to_path(stranger)
    for tls in (Tls(root_certificates=stranger), Tls()):
        with pytest.raises(errors.TlsFailed, match="no trusted authority signed: give its authority"):
            make_client(tls_service.grpc, tls=tls).scenes.list()
    with pytest.raises(errors.Unreachable, match="may want TLS"):
        make_client(tls_service.grpc, timeout_s=1.0).scenes.list()


def test_files_and_addresses_that_cannot_be_used(mounted, make_client, tmp_path):
    certificate, _ = write_client(mounted.authority, tmp_path)
    _, other = write_client(mounted.authority, tmp_path / "other")
    empty = tmp_path / "empty.pem"
    empty.touch()
    for tls, expected in (
        (Tls(root_certificates=tmp_path / "none.pem"), r"tls.root_certificates: .*none.pem cannot be read"),
        (Tls(root_certificates=empty), r"tls.root_certificates: .*empty.pem cannot be used"),
        (Tls(certificate=certificate), r"tls.certificate and tls.key must be given together"),
        (Tls(certificate=certificate, key=other), r"tls.certificate: .* cannot be used \(KEY_VALUES_MISMATCH\)"),
    ):
        with pytest.raises(errors.InvalidArgument, match=expected):
            make_client("localhost:1", tls=tls)
    for address, tls in (("https://localhost:1/v1", None), ("http://localhost:1", Tls()), ("", None)):
        with pytest.raises(errors.InvalidArgument, match=r"address must be HOST:PORT .* https:// with it"):
            make_client(address, tls=tls)


def test_an_address_may_be_a_url(client_service, tls_service, make_client):
    assert make_client(f"http://{client_service.grpc}", api_key=KEY).scenes.list()
    with pytest.raises(errors.TlsFailed, match="no trusted authority signed"):  # TLS by the system's authorities
        make_client(f"https://{tls_service.grpc}").scenes.list()
    with pytest.raises(errors.Unreachable, match=r"is a port of HTTP: give that of gRPC"):
        make_client(client_service.http, timeout_s=1.0).scenes.list()


@pytest.mark.parametrize(
    "address",
    [
        "localhost:1",
        "127.0.0.1:50051",
        "[::1]:1",
        "dns:///localhost:1",
        "ipv4:127.0.0.2:1",
        "unix:/run/ultragray",
        "localhost",
    ],
)
def test_a_key_may_travel_openly_within_a_machine(address):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_open_key(address)


@pytest.mark.parametrize(
    "address", ["192.0.2.1:1", "scanner:50051", "[2001:db8::1]:1", "dns:///scanner:1", "localhost.evil:1"]
)
def test_a_key_that_travels_openly_to_another_machine_is_told(address, make_client):
    with pytest.warns(UserWarning, match="API key travels unencrypted"):
        make_client(address, api_key="0123456789abcdef")
    make_client(address)
    make_client(address, api_key="0123456789abcdef", tls=Tls())
