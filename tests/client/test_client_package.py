"""The package: what an import of it takes, and the names that it exports."""

from __future__ import annotations

import subprocess
import sys

import ultragray_client


def test_an_import_takes_no_more_than_it_needs() -> None:
    program = "import sys, ultragray_client; print(*{name.split('.')[0] for name in sys.modules})"
    told = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert {"ultragray_client", "ultragray_proto", "grpc", "numpy"} <= set(told.split())
    assert not {"torch", "ultragray", "ultragray_service", "ultragray_workers", "pydantic"} & set(told.split())


def test_exported_names_exist() -> None:
    assert len(set(ultragray_client.__all__)) == len(ultragray_client.__all__)
    for name in ultragray_client.__all__:
        assert hasattr(ultragray_client, name)
