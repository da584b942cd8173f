"""Certificate files, and what is said of those that cannot be used."""

import os

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from ultragray.errors import InvalidArgument
from ultragray_service.settings import load_settings
from ultragray_service.tls.server import CertificateFiles, CertificateWatch
from ultragray_workers.errors import StartupFailed

from ...certificates import AUTHORITY, KEY, RARE_CURVE, SERVER, Mounted


@pytest.fixture
def mounted(tmp_path):
    found = Mounted(tmp_path / "tls")
    found.put(found.issue())
    return found


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
