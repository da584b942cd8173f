"""Certificate files as a hospital has them: an authority, what it signed, and their replacement in one step."""

import datetime
import os
import ssl
from itertools import count
from pathlib import Path

import grpc
import trustme

SERVER, KEY, AUTHORITY = "server.pem", "server.key", "clients.pem"
RARE_CURVE = b"""\
-----BEGIN CERTIFICATE-----
MIIBSjCCAQigAwIBAgIUPlwjUR1kL5xGnGPIHZGw13Ikc6cwCgYIKoZIzj0EAwIw
FDESMBAGA1UEAwwJbG9jYWxob3N0MB4XDTI2MTEyMjExNDAwNVoXDTI2MTEyNTEx
NDAwNVowFDESMBAGA1UEAwwJbG9jYWxob3N0MD4wEAYHKoZIzj0CAQYFK4EEAAkD
KgAEwe6P6LZeflimoI3h9b1apiuN+x3e66l4YooZopqkB3TkUiHZi7aHsKNTMFEw
HQYDVR0OBBYEFE/Sfs0kzyRW5xXowPbtFSYwyKtFMB8GA1UdIwQYMBaAFE/Sfs0k
zyRW5xXowPbtFSYwyKtFMA8GA1UdEwEB/wQFMAMBAf8wCgYIKoZIzj0EAwIDMAAw
LQIVAKMoXPqjTHvxPmWHfkWJVlucbOyjAhR7oqmNSf6pshXh1rzS5BiqDIiA5Q==
-----END CERTIFICATE-----
"""  # of the curve secp160k1, which the library of certificates does not know
_number = count()


class Mounted:
    """A folder of certificates that is replaced as Kubernetes does: `..data` is a link that is renamed into place."""

    def __init__(self, folder):
        self.folder = folder
        self.authority = trustme.CA()
        self.root = folder.parent / "root.pem"
        folder.mkdir()
        self.authority.cert_pem.write_to_path(self.root)
        for name in (SERVER, KEY, AUTHORITY):
            (folder / name).symlink_to(Path("..data", name))
        self.put(self.issue())

    def put(self, server, *, clients=None, key=None):
        """Replaces all files in one step. `key` None: that of the certificate."""
        revision = self.folder / f"..{next(_number)}"
        revision.mkdir()
        (revision / SERVER).write_bytes(chain_of(server))
        (revision / KEY).write_bytes(server.private_key_pem.bytes() if key is None else key)
        (revision / AUTHORITY).write_bytes((clients or self.authority).cert_pem.bytes())
        link = self.folder / "..new"
        link.symlink_to(revision.name)
        os.replace(link, self.folder / "..data")
        return server

    def issue(self, *, from_days=-60.0, days=30.0):
        """Signs a certificate for this machine, which is valid from and until so many days from now."""
        now = datetime.datetime.now(datetime.timezone.utc)
        return self.authority.issue_cert(
            "localhost",
            "127.0.0.1",
            not_before=now + datetime.timedelta(days=from_days),
            not_after=now + datetime.timedelta(days=days),
        )

    def settings(self, *, mutual=False):
        """Settings of a service."""
        found = {"tls_certificate": self.folder / SERVER, "tls_key": self.folder / KEY}
        return {**found, "tls_client_ca": self.folder / AUTHORITY} if mutual else found

    def context(self, client=None):
        """What a client needs that speaks HTTP or WebSocket."""
        context = ssl.create_default_context(cadata=self.authority.cert_pem.bytes().decode())
        if client is not None:
            client.configure_cert(context)
        return context

    def credentials(self, client=None):
        """What a client needs that speaks gRPC."""
        root = self.authority.cert_pem.bytes()
        if client is None:
            return grpc.ssl_channel_credentials(root)
        return grpc.ssl_channel_credentials(root, client.private_key_pem.bytes(), chain_of(client))


def chain_of(leaf):
    return b"".join(pem.bytes() for pem in leaf.cert_chain_pems)


def write_client(authority, folder):
    """A client's certificate and its key, in files."""
    folder.mkdir(exist_ok=True)
    leaf, certificate, key = (
        authority.issue_cert("robot@hospital.example"),
        folder / "client.pem",
        folder / "client.key",
    )
    certificate.write_bytes(chain_of(leaf))
    leaf.private_key_pem.write_to_path(key)
    return certificate, key
