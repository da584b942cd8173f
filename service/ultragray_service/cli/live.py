"""`ultragray live`: a sweep is played into a recording of a running service, which learns its scene meanwhile."""

from __future__ import annotations

import json as jsons
import time
from typing import Annotated, Any

import numpy as np
import typer

from ultragray.contract import to_dict
from ultragray.datasets.source import SourceOptions
from ultragray_service.cli.connection import Connection, route, with_connection
from ultragray_service.cli.jobs import follow
from ultragray_service.cli.options import with_options
from ultragray_service.cli.sweeps import SweepArgument, read_dataset
from ultragray_service.cli.terminal import Json, counted, examples, option, tell
from ultragray_workers.errors import NotReady

live_app = typer.Typer(rich_markup_mode="rich")
USUAL_RATE_HZ = 10.0  # of a sweep that does not tell its times
LONGEST_GAP_S = 5.0  # that is waited for between two frames
PATIENCE_S = 60.0  # with a service that is restarted meanwhile
RETRY_S = 1.0


@live_app.command(
    epilog=examples(
        "ultragray live sweep/ liver --scene liver-live",
        "ultragray live scan.mcap liver --scene liver-live --speed 2 --wait",
        "ultragray live second-sweep/ liver --open  # adds to the recording, and leaves it open",
    )
)
@with_options
@with_connection
def live(
    connection: Connection,
    sweep: SweepArgument,
    name: Annotated[str, typer.Argument(help="Name of the recording, and of the dataset that it becomes.")],
    scene: Annotated[str | None, option("Scene that is to grow meanwhile, by a live job.", shown="none")] = None,
    speed: Annotated[float, option("Times the sweep's own pace.", min=0.01, max=1000.0)] = 1.0,
    rate_hz: Annotated[
        float | None, option("Frames a second, whatever the sweep tells.", min=0.01, max=1000.0, shown="its own, or 10")
    ] = None,
    leave_open: Annotated[bool, option("Do not finish the recording: more frames will follow.", "--open")] = False,
    private: Annotated[bool, option("Others see neither the recording nor the scene.", "--private")] = False,
    wait: Annotated[bool, option("Follow the job to its end.", "--wait")] = False,
    json: Json = False,
    *,
    source: SourceOptions,
) -> None:
    """The frames go at the pace at which they were taken; a recording that is open goes on."""
    dataset = read_dataset(sweep, source)
    order = np.arange(len(dataset.train) + len(dataset.val)) if dataset.places is None else np.argsort(dataset.places)
    parts = dataset.train, dataset.val
    images, poses = (np.concatenate([getattr(part, kind) for part in parts])[order] for kind in ("images", "poses"))
    times_s = None
    if rate_hz is None and all(part.times_s is not None for part in parts if len(part)):
        told = [part.times_s for part in parts if part.times_s is not None]
        times_s = np.concatenate(told)[order]
    gaps_s = np.full(len(images), 1.0 / (rate_hz or USUAL_RATE_HZ))
    if times_s is not None:
        gaps_s = np.clip(np.diff(times_s, prepend=times_s[:1]), 0.0, LONGEST_GAP_S)
    settings = {
        "probe": to_dict(dataset.probe, with_none=False),
        "image_height": images.shape[1],
        "image_width": images.shape[2],
    }
    suffix = "?private=true" if private else ""
    begun = connection.json("PUT", route("recordings", name, suffix=suffix), settings)
    job: dict[str, Any] | None = None
    if scene is not None:
        asked = {"kind": "live", "specification": {"recording": name, "scene": scene}, "private": private}
        job = connection.json("POST", "/v1/jobs", asked)
    first, due_s = begun["next_number"], time.monotonic()
    with counted(f"recording {name}", len(images)) as report:
        for number, (image, pose, gap_s) in enumerate(zip(images, poses, gaps_s, strict=True)):
            due_s += gap_s / speed
            time.sleep(max(0.0, due_s - time.monotonic()))
            head: dict[str, Any] = {"pose": {"matrix": pose.tolist()}, "number": first + number}
            if times_s is not None:
                head["time_s"] = float(times_s[number])
            text = jsons.dumps(head).encode()
            _add(connection, name, len(text).to_bytes(4, "little") + text + image.tobytes())
            report(number + 1)
    if leave_open:
        state = connection.json("GET", route("recordings", name))
        tell(f"{name} is open, with {state['frames']:,} frames", {"recording": state, "job": job}, as_json=json)
        return
    record = connection.json("POST", route("recordings", name, suffix=":finish"))
    frames = f"{record['train_frames']} training and {record['val_frames']} held-out frames"
    job_id = "" if job is None else f"; the job {job['id']} ends its scene"
    tell(f"recorded {name}: {frames}{job_id}", {"dataset": record, "job": job}, as_json=json)
    if wait and job is not None:
        follow(connection, job["id"])


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
