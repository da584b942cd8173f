"""The commands of docs/tls.md."""

from __future__ import annotations

import re
import shutil
import ssl
import subprocess
from pathlib import Path

import httpx
import pytest

from ..service.conftest import StartService, data_folder, demo_scene, start_service

__all__ = ["data_folder", "demo_scene", "start_service"]

DOCUMENT = (Path(__file__).resolve().parents[2] / "docs" / "tls.md").read_text()


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_certificates_of_the_document_open_a_service(start_service: StartService, tmp_path: Path) -> None:
    (commands,) = re.findall(r"```bash\n(.*?)```", DOCUMENT, flags=re.DOTALL)
    subprocess.run(["bash", "-ec", commands], cwd=tmp_path, check=True, capture_output=True)
    service = start_service(
        tls_certificate=tmp_path / "server.pem", tls_key=tmp_path / "server.key", tls_client_ca=tmp_path / "ca.pem"
    )
    context = ssl.create_default_context(cafile=str(tmp_path / "ca.pem"))
    context.verify_flags |= ssl.VERIFY_X509_STRICT  # the default from Python 3.13 on
    context.load_cert_chain(tmp_path / "client.pem", tmp_path / "client.key")
    assert httpx.get(f"{service.http}/v1/scenes", verify=context, timeout=60).status_code == 200
