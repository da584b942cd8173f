"""A process that reads files in place of the tests: run as a program, so that an input may crash it or fill its memory.

A line of JSON comes in, `{"reader": NAME, "path": PATH}`, and one goes out: `{"outcome": TEXT}` where the file was read
or refused in words, `{"fault": TRACEBACK}` where the reader raised anything else.
"""

import json
import resource
import sys
import tempfile
import traceback
from pathlib import Path

import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.datasets.checks import check_dataset
from ultragray.datasets.source import SourceOptions, find_source, load_dataset
from ultragray.errors import UltragrayError
from ultragray.exchange.checkpoint import import_checkpoint
from ultragray.exchange.ply import read_ply
from ultragray.exchange.poses import load_poses
from ultragray.learn.training.checkpointing import check_tensors, read_checkpoint
from ultragray.scene.info import read_header
from ultragray_workers.datasets.unpack import unpack

ADDRESS_SPACE_BYTES = 8 << 30
UNPACKED_BYTES = 1 << 20
_PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)


def read_scene(path):
    read_header(path)
    scene = GaussianScene.load(path)
    render(scene, _PROBE, torch.eye(4)[None].numpy(), height=16, width=16, backend="cpu")


def read_point_cloud(path):
    read_ply(path)


def read_released_checkpoint(path):
    import_checkpoint(path / "ckpt.pt", config=path / "conf.json", poses=path / "poses_train.npy")


def read_training_state(path):
    check_tensors(path, *read_checkpoint(path), frame_count=10, pose_count=0)


def read_poses(path):
    load_poses(path)


def read_folder(path):
    """As an upload is read."""
    source = find_source(path)
    source.format.check_upload(source.path, path)
    check_dataset(load_dataset(path))


def read_sequence(path):
    device_set = next(path.glob("*.xml"))
    (sequence,) = (file for file in path.iterdir() if file.suffix in (".mha", ".nrrd"))
    check_dataset(load_dataset(sequence, SourceOptions(device_set=device_set, crop="2:14,1:19")))


def read_archive(path):
    with tempfile.TemporaryDirectory() as folder:
        inner = Path(folder) / "unpacked"
        inner.mkdir()
        try:
            unpack(path, inner, UNPACKED_BYTES)
        finally:
            assert not [entry for entry in Path(folder).iterdir() if entry != inner], "it wrote outside its folder"
            assert not any(entry.is_symlink() for entry in inner.rglob("*")), "it made a link"


READERS = {
    "scene": read_scene,
    "ply": read_point_cloud,
    "checkpoint": read_released_checkpoint,
    "training state": read_training_state,
    "poses": read_poses,
    "folder": read_folder,
    "sequence": read_sequence,
    "archive": read_archive,
}


def answer(request):
    try:
        READERS[request["reader"]](Path(request["path"]))
    except UltragrayError as error:
        return {"outcome": error.reason}
    except MemoryError:
        return {"outcome": "MEMORY"}
    except BaseException:
        return {"fault": traceback.format_exc()}
    return {"outcome": "read"}


def main():
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE_BYTES, ADDRESS_SPACE_BYTES))
    torch.set_num_threads(1)
    replies = sys.stdout
    sys.stdout = sys.stderr
    for line in sys.stdin:
        replies.write(json.dumps(answer(json.loads(line))) + "\n")
        replies.flush()


if __name__ == "__main__":
    main()
