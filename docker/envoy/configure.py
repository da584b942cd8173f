"""Writes envoy.yaml for replicas that are named one by one: `python docker/envoy/configure.py --help`. Needs PyYAML.

What stands in the file holds: policies, checks, retries. Addresses, ports and hot scenes take the place of its own.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

TEMPLATE = Path(__file__).resolve().parent / "envoy.yaml"
_HOT_SCENES = "local replicas_of = {}"


class Replica(NamedTuple):
    """One service, by the host and the ports of its doors."""

    host: str
    http_port: int
    grpc_port: int

    @classmethod
    def read(cls, text: str) -> Replica:
        """From HOST:HTTP_PORT:GRPC_PORT. Raises ValueError."""
        host, http_port, grpc_port = text.rsplit(":", 2)
        return cls(host, int(http_port), int(grpc_port))

    def __str__(self) -> str:
        return f"{self.host}:{self.http_port}"


def configured(
    replicas: Sequence[Replica],
    *,
    address: str = "0.0.0.0",
    http_port: int = 8000,
    grpc_port: int = 50051,
    admin_port: int = 9901,
    hot_scenes: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """The configuration as envoy.yaml has it, for these replicas; `hot_scenes`: how many of them share each.

    Both doors of a replica have one place on the ring: a scene has the same home for HTTP and for gRPC.
    """
    whole: dict[str, Any] = yaml.safe_load(TEMPLATE.read_text())
    resources = whole["static_resources"]
    whole["admin"]["address"]["socket_address"]["port_value"] = admin_port
    for listener, port in zip(resources["listeners"], (http_port, grpc_port), strict=True):
        listener["address"]["socket_address"] = {"address": address, "port_value": port}
    for cluster in resources["clusters"]:
        is_http = cluster["name"].startswith("http")
        endpoints = [
            {
                "endpoint": {
                    "address": {
                        "socket_address": {
                            "address": one.host,
                            "port_value": one.http_port if is_http else one.grpc_port,
                        }
                    }
                },
                "metadata": {"filter_metadata": {"envoy.lb": {"hash_key": str(one)}}},
            }
            for one in replicas
        ]
        cluster["load_assignment"]["endpoints"] = [{"lb_endpoints": endpoints}]
    hot = ", ".join(f"[{_lua(scene)}] = {count}" for scene, count in (hot_scenes or {}).items())
    for listener in resources["listeners"]:
        (affinity, _) = listener["filter_chains"][0]["filters"][0]["typed_config"]["http_filters"]
        source = affinity["typed_config"]["default_source_code"]
        source["inline_string"] = source["inline_string"].replace(_HOT_SCENES, f"{_HOT_SCENES[:-1]}{hot}}}")
    return whole


def _lua(text: str) -> str:
    """A string as Lua writes it."""
    return '"' + "".join(f"\\{byte}" for byte in text.encode()) + '"'


def _hot(text: str) -> tuple[str, int]:
    scene, _, count = text.rpartition("=")
    return scene, int(count)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--replica", type=Replica.read, action="append", required=True, metavar="HOST:HTTP:GRPC")
    parser.add_argument("--hot", type=_hot, action="append", default=[], metavar="SCENE=REPLICAS")
    parser.add_argument("--address", default="0.0.0.0", help="to listen on (default: 0.0.0.0)")
    parser.add_argument("--http-port", type=int, default=8000)
    parser.add_argument("--grpc-port", type=int, default=50051)
    parser.add_argument("--admin-port", type=int, default=9901)
    given = vars(parser.parse_args())
    made = configured(given.pop("replica"), hot_scenes=dict(given.pop("hot")), **given)
    yaml.safe_dump(made, sys.stdout, sort_keys=False)


if __name__ == "__main__":
    main()
