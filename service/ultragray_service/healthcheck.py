"""The health check of containers: `python -m ultragray_service.healthcheck` ends with 0 where the service is ready.

It asks the service of its own environment, over loopback and so without regard to the names of its certificate. To a
service that asks for certificates of its clients it shows ULTRAGRAY_CLIENT_CERTIFICATE, as the command line does.
Standard library only: it runs every few seconds beside the service.
"""

from __future__ import annotations

import os
import ssl
import sys
import urllib.request
from collections.abc import Mapping

TIMEOUT_S = 2.0
DEFAULT_HTTP_PORT = "8000"
_EVERYWHERE = ("", "0.0.0.0", "::")


def ready_url(environment: Mapping[str, str]) -> str:
    host = environment.get("ULTRAGRAY_HOST", "")
    host = "127.0.0.1" if host in _EVERYWHERE else f"[{host}]" if ":" in host else host
    scheme = "https" if environment.get("ULTRAGRAY_TLS_CERTIFICATE") else "http"
    return f"{scheme}://{host}:{environment.get('ULTRAGRAY_HTTP_PORT', DEFAULT_HTTP_PORT)}/v1/health/ready"


def main() -> int:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    url = ready_url(os.environ)
    try:
        if certificate := os.environ.get("ULTRAGRAY_CLIENT_CERTIFICATE"):
            context.load_cert_chain(certificate, os.environ.get("ULTRAGRAY_CLIENT_KEY"), password="")
        urllib.request.urlopen(url, timeout=TIMEOUT_S, context=context).close()
    except OSError as error:  # HTTP's statuses are among them
        sys.stderr.write(f"{url}: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
