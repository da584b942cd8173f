"""TLS: certificate files and what is said of them, and both doors of a real service while they are replaced."""

import base64
import os
import re
import socket
import ssl
from contextlib import ExitStack
from functools import partial

import grpc
import httpx
import pytest
import trustme
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from grpc_health.v1 import health_pb2, health_pb2_grpc
from websockets.sync.client import connect

from ultragray.errors import InvalidArgument
from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
from ultragray_service.settings import load_settings
from ultragray_service.tls import CertificateFiles, CertificateWatch
from ultragray_workers.errors import StartupFailed

from ...certificates import AUTHORITY, KEY, RARE_CURVE, SERVER
from ...waiting import wait_until


def load(mounted):
    files = CertificateFiles(mounted.folder / SERVER, mounted.folder / KEY, mounted.folder / AUTHORITY)
    files.load(files.read())


def encrypted_key():
    return ec.generate_private_key(ec.SECP256R1()).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.BestAvailableEncryption(b"secret")
    )


def test_good_files_are_loaded(mounted):
    load(mounted)
    found = CertificateWatch.of(load_settings(**mounted.settings(mutual=True)))
    assert found.current.names == "localhost, 127.0.0.1"
    assert mounted.issue().private_key_pem.bytes().decode() not in repr(found.current)
    assert CertificateWatch.of(load_settings()) is None


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        (SERVER, b"", "tls_certificate cannot be used: .*server.pem holds no certificate in PEM format"),
        (SERVER, None, "tls_certificate cannot be used: .*server.pem cannot be read: No such file"),
        (KEY, None, "tls_key cannot be used: .*server.key cannot be read: No such file"),
        (KEY, b"-----BEGIN", "tls_key cannot be used: .*server.key holds no private key in PEM format"),
        (KEY, encrypted_key(), "tls_key cannot be used: .*server.key is encrypted; decrypt it: openssl pkey"),
        (AUTHORITY, b"\xff", "tls_client_ca cannot be used: .*clients.pem holds no certificate"),
        (AUTHORITY, b"", "tls_client_ca cannot be used: .*clients.pem holds no certificate"),
        (SERVER, RARE_CURVE, "tls_certificate cannot be used: .*server.pem.*Curve 1.3.132.0.9 is not supported"),
        (KEY, b"x" * (2**20 + 1), "tls_key cannot be used: .*server.key is larger than"),
    ],
)
def test_bad_files_are_one_clear_sentence(mounted, name, content, expected):
    path = mounted.folder / name
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(StartupFailed, match=expected) as caught:
        load(mounted)
    assert caught.value.field in str(caught.value)


def test_a_key_that_goes_after_it_was_read(mounted):
    files = CertificateFiles(mounted.folder / SERVER, mounted.folder / KEY, None)
    content = files.read()
    (mounted.folder / KEY).unlink()
    with pytest.raises(StartupFailed, match=r"server.key: No such file or directory"):
        files.load(content)


def test_a_key_of_another_certificate(mounted):
    mounted.put(mounted.issue(), key=mounted.issue().private_key_pem.bytes())
    with pytest.raises(StartupFailed, match=r"server.key is not the key of the certificate in .*server.pem"):
        load(mounted)


def test_certificates_out_of_their_time(mounted):
    mounted.put(mounted.issue(days=-1))
    with pytest.raises(StartupFailed, match=r"server.pem expired at"):
        load(mounted)
    mounted.put(mounted.issue(days=30, from_days=1))
    with pytest.raises(StartupFailed, match=r"server.pem is not valid before"):
        load(mounted)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_a_key_that_may_not_be_read(mounted):
    (mounted.folder / KEY).resolve().chmod(0)
    with pytest.raises(StartupFailed, match=r"server.key cannot be read: Permission denied"):
        load(mounted)


@pytest.mark.parametrize(
    ("given", "missing"),
    [
        ({"tls_certificate": "a"}, "tls_key"),
        ({"tls_key": "a"}, "tls_certificate"),
        ({"tls_client_ca": "a"}, "tls_client_ca"),
    ],
)
def test_settings_that_belong_together(given, missing):
    with pytest.raises(InvalidArgument, match=f"ULTRAGRAY_{missing.upper()}") as caught:
        load_settings(**given)
    assert caught.value.field == missing


LIVE = "/v1/health/live"


@pytest.fixture
def serving(start_service, mounted):
    return start_service(**mounted.settings())


def address_of(url):
    host, _, port = url.rpartition("/")[2].partition(":")
    return host, int(port)


def serial_offered(address, context):
    """The number of the certificate that a door shows to a client that gives no server name."""
    with (
        socket.create_connection(address, timeout=300) as plain,
        context.wrap_socket(plain, server_hostname=address[0]) as connection,
    ):
        shown = connection.getpeercert(binary_form=True)
        return x509.load_der_x509_certificate(shown).serial_number


def shows(address, context, leaf):
    expected = x509.load_pem_x509_certificate(leaf.cert_chain_pems[0].bytes())
    return serial_offered(address, context) == expected.serial_number


def check_health(service, credentials):
    """Raises grpc.RpcError. Each call has a connection of its own."""
    options = [("grpc.use_local_subchannel_pool", 1)]
    with grpc.secure_channel(service.grpc, credentials, options=options) as channel:
        health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=300)


def errors_in(service):
    return [record["message"] for record in service.log() if record["level"] == "error"]


def test_both_doors_speak_tls_and_nothing_else(serving, mounted, pose_body, pose_message):
    assert serving.http.startswith("https://")
    with httpx.Client(base_url=serving.http, verify=mounted.context(), timeout=300) as client:
        assert client.post("/v1/scenes/demo/render", json={"pose": pose_body}).status_code == 200
        assert client.get("/v1/scenes").json()["scenes"]
        certificate = x509.load_pem_x509_certificate((mounted.folder / SERVER).read_bytes())
        (told,) = re.findall(
            r"^ultragray_certificate_expires_timestamp_seconds (.*)$", client.get("/metrics").text, re.M
        )
        assert float(told) == certificate.not_valid_after_utc.timestamp()
    stream = f"{serving.http.replace('https', 'wss')}/v1/scenes/demo/stream"
    with connect(stream, ssl=mounted.context(), max_size=None, open_timeout=300) as connection:
        connection.send('{"sequence": 7, "pose": {"matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}}')
        assert '"sequence":7' in str(connection.recv(timeout=300)).replace(" ", "")
    with grpc.secure_channel(serving.grpc, mounted.credentials()) as channel:
        request = rendering_pb2.RenderRequest(settings=rendering_pb2.RenderSettings(scene="demo"), pose=pose_message)
        assert rendering_pb2_grpc.RenderServiceStub(channel).Render(request, timeout=300).data
    with pytest.raises(httpx.TransportError):
        httpx.get(serving.http.replace("https", "http") + LIVE, timeout=300)
    with serving.channel() as plain, pytest.raises(grpc.RpcError):
        health_pb2_grpc.HealthStub(plain).Check(health_pb2.HealthCheckRequest(), timeout=300)


def test_versions_before_1_2_are_refused(serving, mounted):
    for address in (address_of(serving.http), address_of(serving.grpc)):
        assert serial_offered(address, mounted.context())
        old = mounted.context()
        old.set_ciphers("DEFAULT:@SECLEVEL=0")
        with pytest.warns(DeprecationWarning, match="TLSv1"):
            old.minimum_version, old.maximum_version = ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1
        with pytest.raises(OSError, match=r"PROTOCOL_VERSION|reset by peer|EOF"):
            serial_offered(address, old)


def test_mutual_tls_lets_in_only_clients_of_the_authority(start_service, mounted):
    serving = start_service(**mounted.settings(mutual=True))
    client = mounted.authority.issue_cert("robot@hospital.example")
    stranger = trustme.CA().issue_cert("robot@hospital.example")
    assert httpx.get(serving.http + LIVE, verify=mounted.context(client), timeout=300).status_code == 200
    check_health(serving, mounted.credentials(client))
    for other in (None, stranger):
        with pytest.raises(httpx.TransportError):
            httpx.get(serving.http + LIVE, verify=mounted.context(other), timeout=300)
        with pytest.raises(grpc.RpcError) as caught:
            check_health(serving, mounted.credentials(other))
        assert caught.value.code() is grpc.StatusCode.UNAVAILABLE


def test_replaced_files_are_used_by_new_connections(serving, mounted):
    doors = (address_of(serving.http), address_of(serving.grpc))
    with httpx.Client(base_url=serving.http, verify=mounted.context(), timeout=300) as open_before:
        assert open_before.get(LIVE).status_code == 200
        for _ in range(3):
            new = mounted.put(mounted.issue())
            for door in doors:
                wait_until(partial(shows, door, mounted.context(), new))
            assert open_before.get(LIVE).status_code == 200
    check_health(serving, mounted.credentials())


def test_files_that_cannot_be_used_leave_the_old_ones(serving, mounted):
    doors = (address_of(serving.http), address_of(serving.grpc))
    good = serial_offered(doors[0], mounted.context())

    def stays(complaint):
        wait_until(lambda: any(complaint in message for message in errors_in(serving)))
        for door in doors:
            assert serial_offered(door, mounted.context()) == good

    mounted.put(mounted.issue(), key=mounted.issue().private_key_pem.bytes())
    stays("is not the key of the certificate")
    mounted.put(mounted.issue(days=-1))
    stays("expired at")
    assert len(errors_in(serving)) == 2, "each is told once"
    new = mounted.put(mounted.issue())
    for door in doors:
        wait_until(partial(shows, door, mounted.context(), new))


def test_another_authority_shuts_out_the_clients_of_the_one_before(start_service, mounted):
    serving = start_service(**mounted.settings(mutual=True))
    before = mounted.authority.issue_cert("robot@hospital.example")
    after_authority = trustme.CA()
    after = after_authority.issue_cert("robot@hospital.example")
    assert httpx.get(serving.http + LIVE, verify=mounted.context(before), timeout=300).status_code == 200
    new = mounted.put(mounted.issue(), clients=after_authority)
    for door in (address_of(serving.http), address_of(serving.grpc)):
        wait_until(partial(shows, door, mounted.context(after), new))
    assert httpx.get(serving.http + LIVE, verify=mounted.context(after), timeout=300).status_code == 200
    check_health(serving, mounted.credentials(after))
    with pytest.raises(httpx.TransportError):
        httpx.get(serving.http + LIVE, verify=mounted.context(before), timeout=300)
    with pytest.raises(grpc.RpcError):
        check_health(serving, mounted.credentials(before))


def test_a_client_that_stalls_in_its_handshake_is_cut_off_and_holds_up_nobody(serving, mounted):
    with ExitStack() as opened:
        doors = (address_of(serving.http), address_of(serving.grpc))
        stalled = [
            opened.enter_context(socket.create_connection(door, timeout=300)) for door in doors for _ in range(4)
        ]
        for one in stalled:
            one.sendall(base64.b16decode("16030102"))  # the begin of a ClientHello
        assert httpx.get(serving.http + LIVE, verify=mounted.context(), timeout=300).status_code == 200
        check_health(serving, mounted.credentials())
        assert [one.recv(4096) for one in stalled] == [b""] * 8


def test_files_that_cannot_be_used_stop_the_start(start_service, mounted):
    mounted.put(mounted.issue(), key=b"nothing")
    service = start_service(wait=False, **mounted.settings())
    assert service.process.wait(300) == 1
    said = service.log_path.read_text()
    assert f"tls_key cannot be used: {mounted.folder / KEY} holds no private key" in said.splitlines()[-1]
    assert "Traceback" not in said
