"""The modules beside the notebooks: the U-Net, its measure, and the service of a scene."""

import pytest
import torch

from ultragray.phantom.demo import DEMO_FILE
from ultragray_client import Client
from ultragray_client.errors import Unavailable


@pytest.fixture(scope="module")
def unet(load_example):
    return load_example("notebooks/unet")


@pytest.fixture(scope="module")
def running_service(load_example):
    return load_example("notebooks/running_service")


def squares(count):
    """Frames [F, 16, 16] with a bright square each, and its mask."""
    labels = torch.zeros(count, 16, 16, dtype=torch.uint8)
    for number in range(count):
        labels[number, 2 + number % 5 : 8 + number % 5, 4:10] = 1
    noise = 0.1 * torch.rand(labels.shape, generator=torch.Generator().manual_seed(0))
    return 0.8 * labels + noise, labels


def test_dice_is_the_overlap_of_two_masks(unet):
    truth = torch.tensor([[[1, 1, 0, 0]]])
    assert unet.dice(truth, truth, 1) == 1.0
    assert unet.dice(torch.tensor([[[1, 0, 1, 0]]]), truth, 1) == 0.5
    assert unet.dice(torch.tensor([[[0, 0, 1, 1]]]), truth, 1) == 0.0
    assert unet.dice(torch.tensor([[[1, 1, 1, 1]]]), torch.tensor([[[1, 1, unet.IGNORED, unet.IGNORED]]]), 1) == 1.0


def test_the_network_learns_squares_and_the_same_seed_gives_the_same_network(unet):
    frames, labels = squares(10)
    first, again = (unet.train_unet(frames, labels, classes=2, steps=30, seed=0) for _ in range(2))
    assert unet.dice(unet.segmented(first, frames), labels, 1) > 0.9
    assert torch.equal(unet.segmented(first, frames), unet.segmented(again, frames))


@pytest.mark.long
def test_a_scene_is_served_for_as_long_as_the_block_runs(running_service, tmp_path):
    scene_file = tmp_path / "spine.ugr"
    scene_file.symlink_to(DEMO_FILE)
    with running_service.serving(scene_file) as address, Client(address) as client:
        assert [scene.name for scene in client.scenes.list(timeout_s=60.0)] == ["spine"]
    with Client(address) as client, pytest.raises(Unavailable):
        client.scenes.list(timeout_s=1.0)


@pytest.mark.slow
def test_a_service_that_cannot_start_says_why(running_service, tmp_path):
    with pytest.raises(RuntimeError, match=r"absent\.ugr"), running_service.serving(tmp_path / "absent.ugr"):
        pass
