"""The notebooks, from top to bottom in a kernel of their own, their form, and the modules beside them."""

import nbformat
import pytest
import torch

from ultragray.phantom.demo import DEMO_FILE
from ultragray_client import Client
from ultragray_client.errors import Unavailable

from ..scripts import loaded
from .conftest import ROOT

notebooks = loaded(ROOT / "docs" / "notebooks.py")
NAMES = [path.stem for path in notebooks.notebooks()]


@pytest.mark.parametrize("name", NAMES)
def test_its_file_is_in_the_form_that_the_formatter_gives(name):
    path = notebooks.FOLDER / f"{name}.ipynb"
    text = path.read_text(encoding="utf-8")
    assert notebooks.in_form(nbformat.reads(text, as_version=4)) == text, "run: make format"


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_it_runs_from_top_to_bottom(name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # other tests run beside it
    notebook = notebooks.executed(notebooks.FOLDER / f"{name}.ipynb")
    assert notebooks.picture_of(notebook).startswith(b"\x89PNG")
    told = [output for cell in notebook.cells for output in cell.get("outputs", ()) if output.get("name") == "stderr"]
    assert not told, "it warns"
    if name == "visual_servoing":
        assert "found in 13 of 13 frames" in str(notebook)


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
    learned, first, again = (unet.train_unet(frames, labels, classes=2, steps=steps, seed=0) for steps in (30, 3, 3))
    assert unet.dice(unet.segmented(learned, frames), labels, 1) > 0.9
    assert torch.equal(unet.segmented(first, frames), unet.segmented(again, frames))


@pytest.mark.long
def test_a_scene_is_served_for_as_long_as_the_block_runs(running_service, tmp_path):
    scene_file = tmp_path / "spine.ugr"
    scene_file.symlink_to(DEMO_FILE)
    with running_service.serving(scene_file) as address, Client(address) as client:
        assert [scene.name for scene in client.scenes.list(timeout_s=300.0)] == ["spine"]
    with Client(address) as client, pytest.raises(Unavailable):
        client.scenes.list(timeout_s=1.0)


@pytest.mark.slow
def test_a_service_that_cannot_start_says_why(running_service, tmp_path):
    with pytest.raises(RuntimeError, match=r"absent\.ugr"), running_service.serving(tmp_path / "absent.ugr"):
        pass
