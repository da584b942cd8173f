from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from ultragray_service.core.scenes import SceneCatalog
from ultragray_service.igtl import routes
from ultragray_service.igtl.routes import SceneChooser, device_of, frame_of, image_name
from ultragray_workers.errors import SceneNotFound
from ultragray_workers.scenes import SceneStore


@pytest.mark.parametrize(
    ("device", "frame", "image"),
    [
        ("ProbeToReference", "Reference", "Image_Reference"),
        ("MyToolToTracker", "Tracker", "Image_Tracker"),
        ("StylusTipToTorso", "Torso", "Image_Torso"),
        ("ProbeToliver", "liver", "Image_liver"),
        ("liver", "liver", "Image_liver"),
        ("ToReference", "ToReference", "Image_ToReference"),
        ("ProbeTo", "ProbeTo", "Image_ProbeTo"),
        ("", "", "Image_"),
        ("abcdefghijklmnopqrst", "abcdefghijklmnopqrst", "Image_abcdefghijklmn"),
    ],
)
def test_names(device: str, frame: str, image: str) -> None:
    assert (frame_of(device), image_name(device)) == (frame, image)


@pytest.mark.parametrize(
    ("scene", "device"),
    [
        ("liver", "ProbeToliver"),
        ("exactly-13-by", "ProbeToexactly-13-by"),
        ("fourteen-bytes", "fourteen-bytes"),
        ("aTo3", "aTo3"),  # ProbeToaTo3 would be of a scene called 3
        ("a-name-of-20-letters", "a-name-of-20-letters"),
        ("a-name-of-twenty-one-b", "ProbeToReference"),
    ],
)
def test_a_scene_has_a_device_that_names_it(scene: str, device: str) -> None:
    assert device_of(scene) == device
    assert device == "ProbeToReference" or scene in (device, frame_of(device))


def chooser(folder: Path, *names: str, default: str | None = None) -> SceneChooser:
    for name in names:
        (folder / f"{name}.ugr").touch()
    return SceneChooser(SceneCatalog(SceneStore(folder)), default)


def test_the_device_chooses_else_the_default_else_the_only_one(tmp_path: Path) -> None:
    async def choices(one: SceneChooser, *devices: str) -> list[str]:
        return [await one.choose(device) for device in devices]

    only = chooser(tmp_path, "liver")
    assert asyncio.run(choices(only, "ProbeToReference", "liver")) == ["liver", "liver"]
    several = chooser(tmp_path, "spine", default="spine")
    devices = ("ProbeToReference", "liver", "ProbeToliver", "Liver")
    assert asyncio.run(choices(several, *devices)) == ["spine", "liver", "liver", "spine"]
    with pytest.raises(SceneNotFound, match="ULTRAGRAY_IGTL_SCENE"):
        asyncio.run(choices(chooser(tmp_path), "ProbeToReference"))


def test_scenes_that_come_later_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def before_and_after() -> list[str | None]:
        one = chooser(tmp_path, "liver")
        found = [await one.named("spine")]
        (tmp_path / "spine.ugr").touch()
        found.append(await one.named("spine"))
        monkeypatch.setattr(routes, "_NAMES_LIVE_S", 0.0)
        return [*found, await one.named("spine")]

    assert asyncio.run(before_and_after()) == [None, None, "spine"]
