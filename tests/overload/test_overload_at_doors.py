"""Ten times as much as can be rendered, at each door: what can be rendered still is, soon, and for everybody."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ultragray import GaussianScene
from ultragray_studies.bench.report import measured

from ..service.conftest import DEMO_PROBE, RunningService, StartService, make_scene, service_starter
from ..surroundings import ROOT
from ..waiting import at_this_load
from .doors import DOORS, GRPC_CONNECTIONS, SCENE, Open, Place
from .load import Connection, Seen, ask_at

pytestmark = pytest.mark.long

SECONDS = float(os.environ.get("ULTRAGRAY_OVERLOAD_SECONDS", "6"))
RECORD = os.environ.get("ULTRAGRAY_OVERLOAD_RECORD")
IS_MEASURED = RECORD is not None  # on a machine that does nothing else
TIMES = 10
CAPACITY_CONNECTIONS, GREEDY_CONNECTIONS = 4, 120
GREEDY, POLITE = "127.0.0.1", "127.0.0.2"  # where the clients come from
POLITE_SHARE = 0.25  # of the capacity, which two clients share; of gRPC, whose clients have one address here, below
POLITE_SHARE_AMONG_CONNECTIONS = 0.8 / (GRPC_CONNECTIONS + 1)
LEAST_GOODPUT, LEAST_GOODPUT_AT_ANY_LOAD = 0.95, 0.4
LEAST_POLITE = 0.9  # of what the polite client asks for
MOST_P99_S, MOST_RECOVERY_S = 2.0, 2.0
GAUSSIANS = 1_000


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    """A service with one scene, of which a frame takes about 30 ms of one core."""
    folder = tmp_path_factory.mktemp("heavy")
    made = make_scene(GAUSSIANS, probe=DEMO_PROBE)
    heavy = replace(made.info, image_height=512, image_width=512)
    GaussianScene.from_splats(made.splats, info=heavy).save(folder / f"{SCENE}.ugr")
    starter = service_starter(tmp_path_factory, folder)
    start: StartService = next(starter)
    yield start(cold=True, data_folder=folder, igtl_port=0, igtl_scene=SCENE, max_footprint_pixels=2**62)
    starter.close()


@contextlib.asynccontextmanager
async def opened(door: Open, service: RunningService, count: int, address: str) -> AsyncIterator[list[Connection]]:
    """Connections of one client."""
    place = Place(address)
    connections = [await door(service, place) for _ in range(count)]
    yield connections
    await asyncio.gather(*(connection.close() for connection in connections))
    await place.close()


async def capacity_of(door: Open, service: RunningService, seconds: float) -> float:
    """Frames a second that a few connections get, each of which asks again as soon as it has got one."""
    async with opened(door, service, CAPACITY_CONNECTIONS, GREEDY) as connections:
        warm, seen = Seen(), Seen()
        await asyncio.gather(*(ask_at(one, 0, time.monotonic() + 1.0, warm) for one in connections))
        began = time.monotonic()
        await asyncio.gather(*(ask_at(one, 0, began + seconds, seen) for one in connections))
        assert seen.frames
        return seen.frames / (time.monotonic() - began)


async def overload(door: Open, service: RunningService, seconds: float, polite_share: float) -> dict[str, Any]:
    """The capacity before and after, and what came back meanwhile."""
    before = await capacity_of(door, service, seconds / 4)
    got, wanted = Seen(), Seen()
    async with opened(door, service, GREEDY_CONNECTIONS, GREEDY) as greedy:
        async with opened(door, service, 1, POLITE) as (polite,):
            rate, until = TIMES * before / len(greedy), time.monotonic() + seconds
            await asyncio.gather(
                *(one.pour(rate, until, got) for one in greedy), ask_at(polite, polite_share * before, until, wanted)
            )
        ended = time.monotonic()
        async with opened(door, service, 1, POLITE) as (lone,):
            first = Seen()
            while not first.frames:
                await ask_at(lone, 0, time.monotonic() + 1e-3, first)
            recovery_s = time.monotonic() - ended
    after = await capacity_of(door, service, seconds / 4)
    capacity = (before + after) / 2
    return {
        "capacity_per_s": round(capacity, 2),
        "offered_per_s": round((got.asked + wanted.asked) / seconds, 1),
        "goodput": round((got.frames + wanted.frames) / seconds / capacity, 3),
        "p99_s": round(max(got.p99_s, wanted.p99_s), 3),
        "recovery_s": round(recovery_s, 3),
        "polite": round(wanted.frames / max(1, wanted.asked), 3),
        "polite_asked_per_s": round(wanted.asked / seconds, 2),
        "polite_p99_s": round(wanted.p99_s, 3),
        "refusals": dict(got.refusals + wanted.refusals),
    }


@pytest.mark.parametrize("door", DOORS)
def test_ten_times_the_capacity(service: RunningService, door: str) -> None:
    polite_share = POLITE_SHARE_AMONG_CONNECTIONS if "grpc" in door else POLITE_SHARE
    found = asyncio.run(overload(DOORS[door], service, SECONDS, polite_share))
    if RECORD is not None:
        keep(ROOT / RECORD, door, found)
    assert found["goodput"] >= (LEAST_GOODPUT if IS_MEASURED else LEAST_GOODPUT_AT_ANY_LOAD), found
    assert found["p99_s"] <= at_this_load(MOST_P99_S), found
    assert found["recovery_s"] <= at_this_load(MOST_RECOVERY_S), found
    assert found["polite"] >= LEAST_POLITE, found
    before, traceback, after = service.log_path.read_text().partition("Traceback")
    assert not traceback, before[-1000:] + traceback + after[:4000]


def keep(path: Path, door: str, figures: dict[str, Any]) -> None:
    """Adds the figures of a door to the file of the run."""
    document = json.loads(path.read_text()) if path.exists() else {}
    document[door] = {"measured": measured(os.cpu_count() or 1), **figures}
    path.write_text(json.dumps(document, indent=1) + "\n")
