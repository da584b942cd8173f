"""The folder of a page: whole or not at all. What a browser makes of it is in tests/browser."""

import json

import numpy as np
import pytest

from ultragray.errors import BackendUnavailable, InvalidArgument, SceneFileInvalid
from ultragray.exchange import page
from ultragray.phantom.demo import DEMO_FILE
from ultragray.scene.info import read_header


@pytest.fixture
def built(tmp_path, monkeypatch):
    """Assets as `make browser` leaves them, by name: what is in them does not matter here."""
    assets = tmp_path / "assets"
    assets.mkdir()
    (assets / "gpu").mkdir()
    for name in ("gpu/renderer.js", "index.html", "ultragray.wasm"):
        (assets / name).write_text(name)
    monkeypatch.setattr(page, "ASSETS", assets)
    return tmp_path


def test_a_page_holds_renderer_scene_and_poses(built):
    files = page.write_page(DEMO_FILE, built / "made" / "page")
    names = [str(path.relative_to(built / "made" / "page")) for path in files]
    assert names == ["gpu/renderer.js", "index.html", "page.json", "scene.ugz", "ultragray.wasm"]
    scene = built / "made" / "page" / "scene.ugz"
    assert read_header(scene).is_compressed
    page.write_page(scene, built / "again")
    assert (built / "again" / "scene.ugz").read_bytes() == scene.read_bytes()
    described = json.loads((built / "made" / "page" / "page.json").read_text())
    poses = read_header(DEMO_FILE).training_poses
    assert 1 < len(described["poses"]) <= page.MAX_POSES
    np.testing.assert_array_equal(np.reshape(described["poses"][0], (4, 4)), poses[0])
    assert described["labels"]
    assert [path.name for path in (built / "made").iterdir()] == ["page"]


def test_what_cannot_be_written_is_told_and_leaves_nothing(built, monkeypatch):
    full = built / "full"
    full.mkdir()
    (full / "mine").touch()
    with pytest.raises(InvalidArgument, match="must be a new folder, or an empty one"):
        page.write_page(DEMO_FILE, full)
    with pytest.raises(SceneFileInvalid):
        page.write_page(full / "mine", built / "page")
    monkeypatch.setattr(page, "ASSETS", built / "nowhere")
    with pytest.raises(BackendUnavailable, match="make browser"):
        page.write_page(DEMO_FILE, built / "page")
    assert [path.name for path in full.iterdir()] == ["mine"]
    assert not (built / "page").exists()
