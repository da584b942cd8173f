"""A robot that finds a vessel in the demo scene and keeps it in the middle of the image while the patient moves.

    ultragray serve &
    python examples/robot_servo.py --seconds 20

The robot carries the probe to and fro along the spine. Across it, image-based control alone decides: a template (a
dark disc in a bright ring) is correlated with each frame, and a P-controller with limits of speed and acceleration
takes the probe to where it fits. The patient sways sideways, and only the images tell. The loop sends its pose at a
fixed rate over a stream with the mode `latest`: when the service cannot keep up, frames are dropped, but none is late.
It needs numpy and ultragray_client only.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import time
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ultragray_client import AsyncClient, AsyncFrameStream, Frame, LinearProbe, RenderSettings
from ultragray_client.errors import ClientError, DeadlineExceeded, StreamEnded

Floats = npt.NDArray[np.float64]

IMAGE_SIDE = 128
SETTINGS = RenderSettings(height=IMAGE_SIDE, width=IMAGE_SIDE)
VESSEL_RADIUS_MM, WALL_MM = 2.4, 1.0
FIND_CORRELATION = 0.68  # with the template: the vessel has 0.73, what else is in the scene at most 0.63
KEEP_CORRELATION, WINDOW_MM = 0.5, 6.0  # once found, it is looked for this far around

START_X_MM = -14.0  # the vessel is out of sight there
SWEEP_Y_MM, SWEEP_MM_PER_S = 20.0, 8.0
SEARCH_MM_PER_S = 25.0
GAIN_PER_S = 8.0
MAX_MM_PER_S, MAX_MM_PER_S2 = 40.0, 400.0
SWAY_MM, SWAY_HZ = 3.0, 0.2
SETTLING_S = 1.0
POSE_TIMEOUT_S = 0.1
FIRST_ANSWER_S = 1.0  # where nobody answers within this time, there is no service


class VesselFinder:
    """Finds a dark disc in a bright ring by normalised correlation."""

    def __init__(self, probe: LinearProbe) -> None:
        self._column_mm = probe.width_mm / IMAGE_SIDE
        self._row_mm = (probe.far_mm - probe.near_mm) / IMAGE_SIDE
        self._depth_mm = (np.arange(IMAGE_SIDE) + 0.5) * self._row_mm + probe.near_mm
        self._lateral_mm = (np.arange(IMAGE_SIDE) + 0.5) * self._column_mm - probe.width_mm / 2
        radius_mm = np.hypot(*np.meshgrid(self._around(self._row_mm), self._around(self._column_mm), indexing="ij"))
        inside = radius_mm < VESSEL_RADIUS_MM
        support = radius_mm < VESSEL_RADIUS_MM + WALL_MM
        template = np.where(support, np.where(inside, -1.0 / inside.sum(), 1.0 / (support & ~inside).sum()), 0.0)
        self._template = np.conj(np.fft.rfft2(template / np.linalg.norm(template)))
        self._support = np.conj(np.fft.rfft2(support))
        self._pixels = support.sum()

    def find(self, image: npt.NDArray[np.uint8], near: tuple[float, float] | None) -> tuple[float, float] | None:
        """Its centre (lateral, depth) in mm, in an image [H, W]; `near` such a place, if it is known about where."""
        scores, least = self._scores(image / 255.0), FIND_CORRELATION
        if near is not None:
            least = KEEP_CORRELATION
            distance_mm = np.hypot(self._depth_mm[:, None] - near[1], self._lateral_mm - near[0])
            scores = np.where(distance_mm < WINDOW_MM, scores, 0.0)
        row, column = np.unravel_index(np.argmax(scores), scores.shape)
        if scores[row, column] < least:
            return None
        lateral_mm = self._lateral_mm[column] + self._column_mm * _peak(scores[row, column - 1 : column + 2])
        depth_mm = self._depth_mm[row] + self._row_mm * _peak(scores[row - 1 : row + 2, column])
        return float(lateral_mm), float(depth_mm)

    def _scores(self, image: Floats) -> Floats:  # [H, W]
        """The correlation at each pixel, from -1 to 1; 0 where the template would reach over the edge."""
        spectrum, squares = np.fft.rfft2(image), np.fft.rfft2(image**2)
        product = np.fft.irfft2(spectrum * self._template, image.shape)
        mean = np.fft.irfft2(spectrum * self._support, image.shape) / self._pixels
        variance = np.fft.irfft2(squares * self._support, image.shape) / self._pixels - mean**2
        scores = product / np.sqrt(self._pixels * np.maximum(variance, 1e-4))
        reach = VESSEL_RADIUS_MM + WALL_MM
        depths = (self._depth_mm > self._depth_mm[0] + reach) & (self._depth_mm < self._depth_mm[-1] - reach)
        laterals = np.abs(self._lateral_mm) < self._lateral_mm[-1] - reach
        whole: Floats = np.where(depths[:, None] & laterals, scores, 0.0)
        return whole

    @staticmethod
    def _around(pixel_mm: float) -> Floats:
        """Distances from the first pixel along an axis that wraps around."""
        return np.fft.fftfreq(IMAGE_SIDE, 1.0 / (IMAGE_SIDE * pixel_mm)).astype(np.float64)


def _peak(three: Floats) -> float:
    """Where the parabola through three values has its top, in pixels from the middle one."""
    bend = three[0] - 2 * three[1] + three[2]
    return float(0.5 * (three[0] - three[2]) / bend) if len(three) == 3 and bend < 0 else 0.0


@dataclass
class Robot:
    """A probe carrier that is told a sideways speed and reaches it within its limits."""

    x_mm: float = START_X_MM
    speed_mm_per_s: float = 0.0
    seconds: float = 0.0

    def move(self, wanted_mm_per_s: float, step_s: float) -> None:
        wanted = float(np.clip(wanted_mm_per_s, -MAX_MM_PER_S, MAX_MM_PER_S))
        change = float(np.clip(wanted - self.speed_mm_per_s, -MAX_MM_PER_S2 * step_s, MAX_MM_PER_S2 * step_s))
        self.speed_mm_per_s += change
        self.x_mm += self.speed_mm_per_s * step_s
        self.seconds += step_s

    def pose(self) -> Floats:  # [4, 4] mm
        """In the frame of the patient, who sways."""
        pose = np.eye(4)
        pose[0, 3] = self.x_mm - SWAY_MM * math.sin(2 * math.pi * SWAY_HZ * self.seconds)
        along = (self.seconds * SWEEP_MM_PER_S / SWEEP_Y_MM) % 4.0
        pose[1, 3] = SWEEP_Y_MM * (abs(along - 2.0) - 1.0)
        return pose


@dataclass
class Record:
    """What happened."""

    sent: int = 0
    dropped: int = 0
    late: int = 0  # poses that were not rendered within POSE_TIMEOUT_S
    found_after_s: float | None = None
    latencies_ms: list[float] = field(default_factory=list)
    errors_mm: list[float] = field(
        default_factory=list
    )  # lateral, as the images show it, from SETTLING_S after the find
    lost: int = 0  # frames since the find in which it was not seen
    poses: list[Floats] = field(default_factory=list)  # of the frames that `errors_mm` are of

    def tell(self) -> str:
        """A histogram of the latencies, and the error."""
        if not self.latencies_ms:
            return "no frame came"
        latencies = np.array(self.latencies_ms)
        edges = [0, 2, 4, 8, 16, 32, 64, 128, math.inf]
        counts = np.histogram(latencies, edges)[0]
        lines = [
            f"{low:>4g} to {high:>3g} ms {count:>6} {'#' * math.ceil(50 * count / counts.max())}"
            for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True)
        ]
        p50, p99 = np.percentile(latencies, (50, 99))
        lines.append(
            f"latency p50 {p50:.1f} ms, p99 {p99:.1f} ms, max {latencies.max():.1f} ms; "
            f"{self.sent} poses, {len(latencies)} frames, {self.dropped} dropped, {self.late} late"
        )
        if not self.errors_mm:
            return "\n".join([*lines, "the vessel was not found"])
        errors = np.abs(self.errors_mm)
        rms, p99 = math.sqrt((errors**2).mean()), np.percentile(errors, 99)
        lines.append(
            f"vessel found after {self.found_after_s:.2f} s; then off centre by {rms:.2f} mm RMS, p99 {p99:.2f} mm, "
            f"in {len(errors)} frames; not seen in {self.lost}"
        )
        return "\n".join(lines)


class Servo:
    """The control loop: poses out at a fixed rate, frames in as they come."""

    def __init__(self, probe: LinearProbe, rate_hz: float) -> None:
        self._finder = VesselFinder(probe)
        self._step_s = 1.0 / rate_hz
        self._robot = Robot()
        self._place: tuple[float, float] | None = None  # of the vessel in the last frame
        self._wanted_mm_per_s = SEARCH_MM_PER_S
        self.record = Record()

    async def run(self, stream: AsyncFrameStream, seconds: float) -> None:
        watching = asyncio.create_task(self._watch(stream))
        next_step = time.monotonic()
        for _ in range(round(seconds / self._step_s)):
            if watching.done():  # nobody sees any more: it must not drive on
                break
            self._robot.move(self._wanted_mm_per_s, self._step_s)
            await stream.send(self._robot.pose(), timeout_s=POSE_TIMEOUT_S)
            self.record.sent += 1
            next_step += self._step_s
            await asyncio.sleep(max(next_step - time.monotonic(), 0.0))
        await stream.done_sending()
        await watching

    async def _watch(self, stream: AsyncFrameStream) -> None:
        while True:
            try:
                self._see(await stream.receive())
            except DeadlineExceeded:
                self.record.late += 1
            except StreamEnded:
                return

    def _see(self, frame: Frame) -> None:
        record, place = self.record, self._finder.find(frame["bmode"], self._place)
        record.dropped += frame.dropped
        record.latencies_ms.append(frame.latency_ms or 0.0)
        if place is None:
            self._wanted_mm_per_s = SEARCH_MM_PER_S if record.found_after_s is None else 0.0
            record.lost += record.found_after_s is not None
            self._place = None
            return
        self._place = place
        self._wanted_mm_per_s = GAIN_PER_S * place[0]
        if record.found_after_s is None:
            record.found_after_s = self._robot.seconds
        elif self._robot.seconds > record.found_after_s + SETTLING_S:
            record.errors_mm.append(place[0])
            record.poses.append(frame.pose)


async def servo(address: str, *, scene: str = "demo", seconds: float = 10.0, rate_hz: float = 100.0) -> Record:
    """Runs the robot and returns what happened. Raises ClientError."""
    async with AsyncClient(address) as client:
        await client.who_am_i(timeout_s=FIRST_ANSWER_S)
        first = await client.render(scene, Robot().pose(), SETTINGS)
        if not isinstance(first.probe, LinearProbe):
            raise SystemExit(f"the template is made for a linear probe, {scene} has {first.probe}")
        loop = Servo(first.probe, rate_hz)
        async with client.stream(scene, SETTINGS, mode="latest") as stream:
            await loop.run(stream, seconds)
        return loop.record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--address", default="localhost:50051", help="HOST:PORT of the service's gRPC")
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate-hz", type=float, default=100.0, help="of the control loop")
    given = parser.parse_args()
    try:
        record = asyncio.run(servo(given.address, scene=given.scene, seconds=given.seconds, rate_hz=given.rate_hz))
    except ClientError as error:
        raise SystemExit(f"error: {error.detail}") from None
    print(record.tell())


if __name__ == "__main__":
    main()
