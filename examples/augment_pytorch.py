"""Frames for training in PyTorch, rendered while they are needed: an IterableDataset behind a DataLoader.

    ultragray serve &
    python examples/augment_pytorch.py --frames 2000 --workers 2

Poses are drawn around a smooth path through the scene's training poses; with each frame comes its pose and, if asked
for, the mask of what lies where. Each worker of the loader has a client of its own and renders its share; the frames of
an epoch are the same for any number of workers. Nothing is trained: an epoch is timed. It needs torch, ultragray (for
the pose samplers) and ultragray_client.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import asdict

import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

import ultragray
from ultragray.contract import from_dict
from ultragray.samplers import AroundSampler, SplineSampler
from ultragray_client import Client, Frame, RenderSettings, Scene
from ultragray_client.errors import ClientError

Sample = dict[str, torch.Tensor]
PATH_POSES = 200
FIRST_ANSWER_S = 1.0  # where nobody answers within this time, there is no service


class SimulatedFrames(IterableDataset[Sample]):
    """`count` frames an epoch; `epoch` may be set before each one."""

    def __init__(
        self,
        address: str,
        scene: str,
        count: int,
        *,
        labels: bool,
        seed: int,
        spread_mm: float = 2.0,
        spread_deg: float = 4.0,
    ) -> None:
        self._address, self._scene = address, scene
        self._outputs = ("bmode", "labels") if labels else ("bmode",)
        self._count, self._spread_mm, self._spread_deg, self._seed = count, spread_mm, spread_deg, seed
        self.epoch = 0

    def __iter__(self) -> Iterator[Sample]:
        """`bmode` [1, H, W] float32 of 0 to 1, `pose` [4, 4] mm, and `labels` [H, W] int64 if asked for."""
        worker = get_worker_info()
        first, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        with Client(self._address) as client:
            scene = client.scenes.get(self._scene)
            poses = self._poses(scene)[first::step]
            for frame in client.render_batch(self._scene, poses, RenderSettings(outputs=self._outputs)):
                yield _sample(frame)

    def _poses(self, scene: Scene) -> ultragray.geometry.probe.FloatArray:  # [count, 4, 4] mm
        """All poses of the epoch; `epoch` chooses others."""
        if scene.probe is None or not scene.training_poses:
            raise SystemExit(f"{scene.name} does not say which probe and poses it was trained with")
        probe = from_dict(ultragray.Probe, asdict(scene.probe))
        path = SplineSampler(count=PATH_POSES).poses(np.stack(scene.training_poses), probe)
        around = AroundSampler(
            count=self._count,
            translation_mm=self._spread_mm,
            rotation_deg=self._spread_deg,
            seed=self._seed + self.epoch,
        )
        return around.poses(path, probe)


def _sample(frame: Frame) -> Sample:
    sample = {
        "bmode": torch.from_numpy(frame["bmode"][None] / np.float32(255.0)),
        "pose": torch.from_numpy(frame.pose.astype(np.float32)),
    }
    if "labels" in frame.arrays:
        sample["labels"] = torch.from_numpy(frame["labels"].astype(np.int64))
    return sample


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--address", default="localhost:50051", help="HOST:PORT of the service's gRPC")
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--workers", type=int, default=2, help="processes of the loader; 0: none")
    parser.add_argument(
        "--labels", action="store_true", help="with the mask of what lies where, if the scene has labels"
    )
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()

    try:
        with Client(given.address) as client:
            client.who_am_i(timeout_s=FIRST_ANSWER_S)
        measure_epoch(given)
    except ClientError as error:
        raise SystemExit(f"error: {error.detail}") from None


def measure_epoch(given: argparse.Namespace) -> None:
    """Load the frames of an epoch as a training would, and print how fast they came. Raises ClientError."""
    frames = SimulatedFrames(given.address, given.scene, given.frames, labels=given.labels, seed=given.seed)
    loader = DataLoader(
        frames,
        batch_size=given.batch_size,
        num_workers=given.workers,
        multiprocessing_context="spawn" if given.workers else None,  # a gRPC channel does not survive a fork
    )
    started = first_at = time.perf_counter()
    count, brightness = 0, 0.0
    for batch in loader:
        if not count:
            first_at = time.perf_counter()
            shapes = ", ".join(f"{name} {list(value.shape)}" for name, value in batch.items())
            print(f"first batch after {first_at - started:.1f} s: {shapes}")
        count += len(batch["bmode"])
        brightness += float(batch["bmode"].sum(0).mean())
    rate = (count - given.batch_size) / max(time.perf_counter() - first_at, 1e-9)
    print(f"{count} frames, {rate:.0f} a second after the first batch, mean brightness {brightness / count:.4f}")


if __name__ == "__main__":
    main()
