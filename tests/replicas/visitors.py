"""Clients of all kinds behind the proxy, each of one scene; every frame is compared with what the library renders."""

import asyncio
import json
import random
import time
from collections import Counter
from dataclasses import dataclass, field

import httpx
import numpy as np
import numpy.typing as npt
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from ultragray import GaussianScene, render
from ultragray.files import file_sha256
from ultragray_client import AsyncClient, RenderJob, RenderSettings, StreamMode

SIDE = 16  # pixels
POSES = np.tile(np.eye(4), (12, 1, 1))
POSES[:, 0, 3] = np.arange(-2.75, 3.0, 0.5)  # mm
SETTINGS = RenderSettings(height=SIDE, width=SIDE)
PATIENCE_S = 120.0

Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Expected:
    """What a scene must look like."""

    sha256: str
    frames: Pixels  # of POSES, [P, H, W]

    @classmethod
    def of(cls, path):
        rendered = render(GaussianScene.load(path), None, POSES, height=SIDE, width=SIDE).bmode.numpy()
        return cls(file_sha256(path), np.round(np.clip(rendered, 0, 1) * np.float32(255)).astype(np.uint8))


@dataclass
class Seen:
    """What all visitors saw."""

    frames: Counter[str] = field(default_factory=Counter)  # by door
    reconnections: Counter[str] = field(default_factory=Counter)
    resumed_ms: list[float] = field(default_factory=list)  # from sending a pose to its frame over another connection
    wrong: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    jobs: list[str] = field(default_factory=list)


class Visitors:
    """The clients of one run, until `over` is set."""

    def __init__(self, http, grpc, expected, pause_s):
        self._http, self._grpc, self._expected, self._pause_s = http, grpc, expected, pause_s
        self.over = asyncio.Event()
        self.seen = Seen()

    async def visit(self, door, scene):
        """Asks for frames of a scene at a door until all is over."""
        visit = {"ordered": self._stream, "latest": self._stream, "http": self._render, "websocket": self._websocket}
        try:
            await visit[door](door, scene)
        except Exception as error:
            self.seen.errors.append(f"{door} of {scene}: {type(error).__name__}: {error}"[:500])

    async def submit_jobs(self, scenes, every_s):
        """Puts render jobs into the queue, one after another."""
        async with AsyncClient(self._grpc, timeout_s=PATIENCE_S) as client:
            while not self.over.is_set():
                job = RenderJob(scene=random.choice(scenes), poses=POSES, height=SIDE, width=SIDE)
                self.seen.jobs.append((await client.jobs.submit(job)).id)
                await self._pause(every_s)

    async def _pause(self, seconds):
        try:
            await asyncio.wait_for(self.over.wait(), random.uniform(0.5, 1.5) * seconds)
        except asyncio.TimeoutError:
            return

    async def _stream(self, door, scene):
        """Three poses at a time, then their frames."""
        known, last = 0, 0
        async with (
            AsyncClient(self._grpc, timeout_s=PATIENCE_S) as client,
            client.stream(scene, SETTINGS, mode=StreamMode(door)) as stream,
        ):
            while not self.over.is_set():
                asked = {}
                for _ in range(3):
                    index = random.randrange(len(POSES))
                    asked[await stream.send(POSES[index])] = index
                while last < max(asked):
                    frame = await stream.receive()
                    if door == "ordered" and frame.sequence != last + 1:
                        self.seen.wrong.append(f"{scene}: sequence {frame.sequence} after {last}")
                    if frame.sequence <= last:
                        self.seen.wrong.append(f"{scene}: sequence {frame.sequence} came after {last}")
                    last = frame.sequence
                    if stream.reconnections > known:
                        self.seen.reconnections[door] += stream.reconnections - known
                        known = stream.reconnections
                        self.seen.resumed_ms.append(frame.latency_ms or 0.0)
                    self._check(door, scene, frame.scene_sha256, asked[frame.sequence], frame["bmode"])
                await self._pause(self._pause_s)

    async def _render(self, door, scene):
        headers = {"Accept": "application/octet-stream"}
        async with httpx.AsyncClient(base_url=self._http, timeout=PATIENCE_S) as client:
            while not self.over.is_set():
                index = random.randrange(len(POSES))
                answer = await client.post(f"/v1/scenes/{scene}/render", json=_asked(index), headers=headers)
                answer.raise_for_status()
                sha256 = answer.headers["X-Ultragray-Scene-Sha256"]
                self._check(door, scene, sha256, index, np.frombuffer(answer.content, np.uint8).reshape(SIDE, SIDE))
                await self._pause(self._pause_s)

    async def _websocket(self, door, scene):
        """As a page does: connects again where the service is gone, and asks for the newest frame."""
        address = f"{self._http.replace('http', 'ws', 1)}/v1/scenes/{scene}/stream"
        while not self.over.is_set():
            try:
                async with connect(address, compression=None, max_size=None, open_timeout=PATIENCE_S) as stream:
                    await stream.send(json.dumps({"settings": {"height": SIDE, "width": SIDE}}))
                    sequence = 0
                    while not self.over.is_set():
                        sequence, index = sequence + 1, random.randrange(len(POSES))
                        pose = {"matrix": POSES[index].tolist()}
                        await stream.send(json.dumps({"sequence": sequence, "pose": pose}))
                        answer = await asyncio.wait_for(stream.recv(), PATIENCE_S)
                        if isinstance(answer, str):  # refused, because it stops: it will close
                            continue
                        end = 4 + int.from_bytes(answer[:4], "little")
                        header = json.loads(answer[4:end])
                        if header["sequence"] != sequence:
                            self.seen.wrong.append(f"{scene}: sequence {header['sequence']}, asked for {sequence}")
                        pixels = np.frombuffer(answer[end:], np.uint8).reshape(SIDE, SIDE)
                        self._check(door, scene, header["scene_sha256"], index, pixels)
                        await self._pause(self._pause_s)
            except (ConnectionClosed, InvalidStatus, OSError):
                self.seen.reconnections[door] += 1
                await asyncio.sleep(0.1)

    def _check(self, door, scene, sha256, index, pixels):
        expected = self._expected[scene]
        self.seen.frames[door] += 1
        if sha256 != expected.sha256 or not np.array_equal(pixels, expected.frames[index]):
            self.seen.wrong.append(f"{door}: pose {index} of {scene} looks different")


def _asked(index):
    return {"pose": {"matrix": POSES[index].tolist()}, "height": SIDE, "width": SIDE}


async def finished(grpc, jobs, within_s):
    """How many jobs ended in which state, or stand in it when the time has passed."""
    states = Counter()
    end = time.monotonic() + within_s
    async with AsyncClient(grpc, timeout_s=PATIENCE_S) as client:
        for job in jobs:
            try:
                state = (await client.jobs.wait(job, timeout_s=max(end - time.monotonic(), 1.0))).state
            except TimeoutError:
                state = (await client.jobs.get(job)).state
            states[state.value] += 1
    return states
