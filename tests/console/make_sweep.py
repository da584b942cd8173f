"""What the tests of the console upload: writes sweep.zip, broken.zip and compared.ugr into the folder it is given.

sweep.zip is a small sweep over the demo scene (28 training and 5 held-out frames of 64x64), broken.zip the same with a
pose that is none, compared.ugr the demo scene as if it were trained from that sweep.
"""

from __future__ import annotations

import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ultragray import LinearProbe, render
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import write_released
from ultragray.datasets.source import load_dataset
from ultragray.demo import demo_poses, load_demo_scene

SIDE = 64
PROBE = LinearProbe(width_mm=60.0, near_mm=0.0, far_mm=60.0)
HELD_OUT_EVERY, BROKEN_FRAME = 7, 5


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    scene = load_demo_scene()
    poses = demo_poses(33)
    rendered = render(scene, PROBE, poses, height=SIDE, width=SIDE, outputs=("bmode",)).bmode
    assert rendered is not None
    images = np.rint(255.0 * rendered.detach().numpy()).astype(np.uint8)
    held_out = np.arange(len(poses)) % HELD_OUT_EVERY == HELD_OUT_EVERY // 2
    train, val = (
        Sweep(images[chosen], poses[chosen], PROBE, np.flatnonzero(chosen), "sweep") for chosen in (~held_out, held_out)
    )
    files = folder / "files"
    write_released(Dataset("sweep", train, val), files)
    pack(files, folder / "sweep.zip")
    scene.info = replace(scene.info, dataset_name="sweep", dataset_sha256=load_dataset(files).sha256)
    scene.save(folder / "compared.ugr")
    broken = train.poses.copy()
    broken[BROKEN_FRAME, 0, 0] = np.nan
    np.save(files / "poses_train.npy", broken)
    pack(files, folder / "broken.zip")


def pack(files: Path, path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for file in files.iterdir():
            archive.write(file, file.name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
