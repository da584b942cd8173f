"""Contact with the skin, through each front door: asked for, told with each frame, refused where there is no skin."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

import ultragray_client
from ultragray import GaussianScene, render
from ultragray.rendering.settings import Contact
from ultragray_client.contract import RenderSettings
from ultragray_client.errors import InvalidArgument

from .conftest import HEIGHT, WIDTH, RunningService

POSES = np.stack([np.eye(4)] * 3)
POSES[1, 2, 3] = 4.0  # pressed in
ANGLE = np.radians(12.0)
POSES[2, :3, :3] = [[np.cos(ANGLE), 0.0, -np.sin(ANGLE)], [0.0, 1.0, 0.0], [np.sin(ANGLE), 0.0, np.cos(ANGLE)]]
ASKED = [None, *Contact]


@pytest.fixture(scope="module")
def touching_service(
    start_service: Callable[..., RunningService], demo_scene: GaussianScene, tmp_path_factory: Any
) -> RunningService:
    folder = tmp_path_factory.mktemp("touching")
    demo_scene.save(folder / "touched.ugr")
    replace(demo_scene, training_poses=np.zeros((0, 4, 4))).save(folder / "unknown.ugr")
    return start_service(data_folder=folder, artifact_folder=tmp_path_factory.mktemp("artifacts"))


@pytest.fixture(scope="module")
def http(touching_service: RunningService) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{touching_service.http}/v1/", timeout=60) as client:
        yield client


def expected(scene: GaussianScene, contact: Contact | None) -> tuple[np.ndarray, list[float | None]]:
    """[C, H, W], and the share of each frame that has contact."""
    frames = render(scene, None, POSES, height=HEIGHT, width=WIDTH, outputs=("bmode",), contact=contact)
    shares = [None] * len(POSES) if frames.touch is None else frames.touch.shares.tolist()
    return frames["bmode"].numpy(), shares


def body(contact: Contact | None, **fields: Any) -> dict[str, Any]:
    asked = {} if contact is None else {"contact": contact.value}
    return {"dtype": "float32", **asked, **fields}


def test_the_poses_differ_in_contact(demo_scene: GaussianScene) -> None:
    frames, shares = zip(*(expected(demo_scene, contact) for contact in ASKED), strict=True)
    assert shares[1] == shares[2]
    first, pressed, tilted = shares[1]
    assert first == pressed == 1.0
    assert 0.2 < tilted < 0.8
    assert np.array_equal(frames[0][:2], frames[1][:2])
    assert np.abs(frames[0][2] - frames[1][2]).max() > 0.1
    assert np.abs(frames[1][1] - frames[2][1]).max() > 0.1


@pytest.mark.parametrize("contact", ASKED)
def test_http(http: httpx.Client, demo_scene: GaussianScene, contact: Contact | None) -> None:
    frames, shares = expected(demo_scene, contact)
    for pose, frame, share in zip(POSES, frames, shares, strict=True):
        asked = body(contact, pose={"matrix": pose.tolist()})
        answer = http.post("scenes/touched/render", json=asked, headers={"Accept": "application/octet-stream"})
        pixels = np.frombuffer(answer.content, "<f4").reshape(HEIGHT, WIDTH)
        np.testing.assert_allclose(pixels, frame, atol=1e-6)
        assert answer.headers.get("X-Ultragray-Contact") == (None if contact is None else contact.value)
        assert json.loads(answer.headers["X-Ultragray-Extrapolation"])["contact_share"] == share


@pytest.mark.parametrize("contact", ASKED)
def test_archives_hold_the_share_where_it_was_asked_for(
    http: httpx.Client, demo_scene: GaussianScene, contact: Contact | None
) -> None:
    frames, shares = expected(demo_scene, contact)
    asked = body(contact, poses=[{"matrix": pose.tolist()} for pose in POSES])
    answer = http.post("scenes/touched/render", json=asked, headers={"Accept": "application/x-npz"})
    with np.load(io.BytesIO(answer.content)) as archive:
        np.testing.assert_allclose(archive["bmode"], frames, atol=1e-6)
        assert ("contact_share" in archive) == (contact is not None)
        if contact is not None:
            np.testing.assert_allclose(archive["contact_share"], shares)


def test_grpc_and_its_client(touching_service: RunningService, demo_scene: GaussianScene) -> None:
    with ultragray_client.Client(touching_service.grpc) as client:
        for contact in ASKED:
            frames, shares = expected(demo_scene, contact)
            asked = None if contact is None else ultragray_client.Contact(contact.value)
            settings = RenderSettings(contact=asked, encoding=ultragray_client.Encoding.FLOAT32)
            found = list(client.render_batch("touched", POSES, settings))
            assert [frame.extrapolation.contact_share for frame in found] == shares
            assert [frame.contact for frame in found] == [asked] * len(POSES)
            for frame, one in zip(found, frames, strict=True):
                np.testing.assert_allclose(frame["bmode"], one, atol=1e-6)


def test_websocket(touching_service: RunningService, demo_scene: GaussianScene) -> None:
    address = f"{touching_service.http.replace('http', 'ws', 1)}/v1/scenes/touched/stream"
    with connect(address, compression=None) as connection:
        for contact in ASKED:
            frames, shares = expected(demo_scene, contact)
            settings = {"encoding": "float32", **({} if contact is None else {"contact": contact.value})}
            connection.send(json.dumps({"settings": settings, "pose": {"matrix": POSES[2].tolist()}}))
            message = connection.recv()
            assert isinstance(message, bytes)
            length = 4 + int.from_bytes(message[:4], "little")
            header = json.loads(message[4:length])
            assert header["contact"] == (None if contact is None else contact.value)
            assert header["extrapolation"]["contact_share"] == shares[2]
            pixels = np.frombuffer(message[length:], "<f4").reshape(HEIGHT, WIDTH)
            np.testing.assert_allclose(pixels, frames[2], atol=1e-6)


def test_what_is_no_contact_is_refused(http: httpx.Client, touching_service: RunningService) -> None:
    pose = {"matrix": POSES[0].tolist()}
    answer = http.post("scenes/touched/render", json={"pose": pose, "contact": "gel"})
    assert (answer.status_code, answer.json()["field"]) == (422, "contact")
    assert "'air' or 'pressure'" in answer.json()["detail"]
    answer = http.post("scenes/unknown/render", json={"pose": pose, "contact": "air"})
    assert (answer.status_code, answer.json()["field"]) == (422, "contact")
    assert "knows its training poses" in answer.json()["detail"]
    with (
        ultragray_client.Client(touching_service.grpc) as client,
        pytest.raises(InvalidArgument, match="training poses"),
    ):
        client.render("unknown", POSES[0], RenderSettings(contact=ultragray_client.Contact.AIR))


def test_render_jobs_take_it(http: httpx.Client) -> None:
    specification = {"scene": "touched", "poses": POSES.tolist(), "contact": "air"}
    taken = http.post("jobs", json={"kind": "render", "specification": specification}).json()
    assert taken["specification"]["contact"] == "air"
    refused = http.post("jobs", json={"kind": "render", "specification": specification | {"scene": "unknown"}}).json()
    assert refused["field"] == "specification.contact"
