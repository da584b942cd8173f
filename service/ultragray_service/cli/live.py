"""`ultragray live`: frames of a sweep or a scanner go into a recording; a service learns its scene meanwhile."""

from __future__ import annotations

import contextlib
import json as jsons
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from ultragray.contract import to_dict
from ultragray.datasets.source import SourceOptions
from ultragray_service.cli.connection import CHECK_TIMEOUT_S, Connection, route, with_connection
from ultragray_service.cli.jobs import follow
from ultragray_service.cli.options import with_options
from ultragray_service.cli.sweeps import SWEEP_MEANING, read_dataset
from ultragray_service.cli.terminal import Json, argument, counted, examples, option, tell
from ultragray_workers.errors import NotReady

if TYPE_CHECKING:
    from ultragray.learn.sweep import Dataset, Sweep

live_app = typer.Typer(rich_markup_mode="rich")
USUAL_RATE_HZ = 10.0  # of a sweep that does not tell its times
LONGEST_GAP_S = 5.0  # that is waited for between two frames
PATIENCE_S = 60.0  # with a service that is restarted meanwhile
RETRY_S = 1.0
SCANNER = "igtl://"  # what the address of a scanner begins with
_MEANING = f"{SWEEP_MEANING}; or igtl://HOST:PORT, a server of OpenIGTLink that sends IMAGE, such as PLUS."


@live_app.command(
    epilog=examples(
        "ultragray live sweep/ liver --scene liver-live",
        "ultragray live scan.mcap liver --scene liver-live --speed 2 --wait",
        "ultragray live second-sweep/ liver --open  # adds to the recording, and leaves it open",
        "ultragray live igtl://localhost:18944 liver --scene liver-live --transform ProbeToReference  # until Ctrl-C",
    )
)
@with_options
@with_connection
def live(
    connection: Connection,
    sweep: Annotated[str, argument(f"One of: {_MEANING}", metavar="SWEEP")],
    name: Annotated[str, typer.Argument(help="Name of the recording, and of the dataset that it becomes.")],
    scene: Annotated[str | None, option("Scene that is to grow meanwhile, by a live job.", shown="none")] = None,
    speed: Annotated[float, option("Times the sweep's own pace.", min=0.01, max=1000.0)] = 1.0,
    rate_hz: Annotated[
        float | None,
        option("Frames a second, of a scanner at most; else its own, or 10.", min=0.01, max=1000.0, shown="its own"),
    ] = None,
    leave_open: Annotated[bool, option("Do not finish the recording: more frames will follow.", "--open")] = False,
    private: Annotated[bool, option("Others see neither the recording nor the scene.", "--private")] = False,
    wait: Annotated[bool, option("Follow the job to its end.", "--wait")] = False,
    json: Json = False,
    *,
    source: SourceOptions,
) -> None:
    """The frames go at the pace at which they were taken; a recording that is open goes on. A scanner is recorded until
    it ends the connection, or until Ctrl-C.
    """
    is_scanner, total = sweep.startswith(SCANNER), None
    if is_scanner:
        frames = _of_scanner(sweep, source, rate_hz)
    else:
        dataset = read_dataset(sweep, source)
        frames, total = _played(dataset, speed, rate_hz), len(dataset.train) + len(dataset.val)
    first = next(frames)
    settings = {
        "probe": to_dict(first.probe, with_none=False),
        "image_height": first.height,
        "image_width": first.width,
    }
    suffix = "?private=true" if private else ""
    recording = connection.json("PUT", route("recordings", name, suffix=suffix), settings)
    job: dict[str, Any] | None = None
    if scene is not None:
        submission = {"kind": "live", "specification": {"recording": name, "scene": scene}, "private": private}
        job = connection.json("POST", "/v1/jobs", submission)
    ends = (KeyboardInterrupt,) if is_scanner else ()
    with counted(f"recording {name}", total) as report, contextlib.suppress(*ends):
        for number, frame in enumerate(chain([first], frames)):
            head: dict[str, Any] = {
                "pose": {"matrix": frame.poses[0].tolist()},
                "number": recording["next_number"] + number,
            }
            if frame.times_s is not None:
                head["time_s"] = float(frame.times_s[0])
            text = jsons.dumps(head).encode()
            _add(connection, name, len(text).to_bytes(4, "little") + text + frame.images.tobytes())
            report(number + 1)
    if leave_open:
        state = connection.json("GET", route("recordings", name))
        tell(f"{name} is open, with {state['frames']:,} frames", {"recording": state, "job": job}, as_json=json)
        return
    record = connection.json("POST", route("recordings", name, suffix=":finish"), timeout_s=CHECK_TIMEOUT_S)
    counts = f"{record['train_frames']} training and {record['val_frames']} held-out frames"
    job_id = "" if job is None else f"; the job {job['id']} ends its scene"
    tell(f"recorded {name}: {counts}{job_id}", {"dataset": record, "job": job}, as_json=json)
    if wait and job is not None:
        follow(connection, job["id"])


def _played(dataset: Dataset, speed: float, rate_hz: float | None) -> Iterator[Sweep]:
    """The frames of a sweep in the order in which they were taken, one by one, each when it is due."""
    parts = dataset.train, dataset.val
    order = np.arange(len(dataset.train) + len(dataset.val)) if dataset.places is None else np.argsort(dataset.places)
    is_timed = rate_hz is None and all(part.times_s is not None for part in parts if len(part))
    due_s, before_s = time.monotonic(), None
    for place in order:
        part, own = (parts[0], place) if place < len(parts[0]) else (parts[1], place - len(parts[0]))
        frame, gap_s = part.select([own]), 1.0 / (rate_hz or USUAL_RATE_HZ)
        if is_timed:
            assert frame.times_s is not None
            now_s = float(frame.times_s[0])
            gap_s, before_s = 0.0 if before_s is None else min(max(now_s - before_s, 0.0), LONGEST_GAP_S), now_s
        else:
            frame = replace(frame, times_s=None)
        due_s += gap_s / speed
        time.sleep(max(0.0, due_s - time.monotonic()))
        yield frame


def _of_scanner(address: str, source: SourceOptions, rate_hz: float | None) -> Iterator[Sweep]:
    """The frames of a scanner, those left out that come too soon after the one before."""
    from ultragray_service.igtl.scanner import scanned

    due_s = -np.inf
    for frame in scanned(address, source):
        if (now_s := time.monotonic()) >= due_s:
            due_s = now_s + (0.0 if rate_hz is None else 1.0 / rate_hz)
            yield frame
    if due_s == -np.inf:
        raise NotReady(f"{address} closed the connection before a frame had come")


def _add(connection: Connection, name: str, frame: bytes) -> None:
    """Adds a frame; its number makes it safe to do so again where a service is restarted. Raises NotReady."""
    give_up_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            connection.post(route("recordings", name, "frames"), frame)
            return
        except NotReady:
            if time.monotonic() > give_up_s:
                raise
            time.sleep(RETRY_S)
