"""Real frames that come late, of a probe that is elsewhere in the scene than its poses say, or of no such scene."""

import asyncio
import shutil
import time

import numpy as np
import pytest

from ultragray import render
from ultragray.phantom.demo import DEMO_FILE, demo_poses, load_demo_scene
from ultragray.rendering.pixels import png_file
from ultragray_client import AsyncClient, Client, RenderSettings, errors

from ..waiting import Deadline

SIDE = 128
POSE = demo_poses(3)[1]  # [4, 4] mm
SETTINGS = RenderSettings(height=SIDE, width=SIDE)


@pytest.fixture(scope="module")
def service(start_service, tmp_path_factory, artifacts):
    folder = tmp_path_factory.mktemp("phantom")
    shutil.copy(DEMO_FILE, folder / "spine.ugr")
    return start_service(data_folder=folder, artifact_folder=artifacts)


@pytest.fixture
def stream(service):
    with Client(service.grpc) as client, client.stream("spine", SETTINGS, mode="latest") as stream:
        yield stream


def real(shift_mm):
    pose = POSE.copy()
    pose[:3, 3] += shift_mm
    frame = render(load_demo_scene(), None, pose, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"][0]
    return png_file(frame.detach().numpy())


def seen(stream, image, until):
    """The first frame that is as it should be, of a probe that rests while its real frames come 50 ms late."""
    deadline = Deadline(120)
    while True:
        now_ns = time.monotonic_ns()
        stream.send(POSE, measured_ns=now_ns)
        frame = stream.receive()
        if frame.preview is not None and until(frame.preview):
            return frame
        stream.send_real(image, now_ns)
        assert not deadline.passed


def test_the_scene_is_moved_to_where_the_real_frames_show_it(stream):
    shift_mm = (1.5, -1.0, 1.0)
    frame = seen(stream, real(shift_mm), lambda preview: preview.offset_mm > 0.5)
    np.testing.assert_allclose(frame.pose[:3, 3] - POSE[:3, 3], shift_mm, atol=0.3)
    assert frame.preview.offset_mm == pytest.approx(np.linalg.norm(shift_mm), abs=0.3)
    assert frame.preview.agreement > 0.9
    assert frame.preview.trust == pytest.approx(frame.preview.agreement * frame.extrapolation.confidence, abs=0.01)
    assert not frame.preview.disagrees


def test_a_real_frame_that_no_small_correction_brings_to_the_scene_is_said_to_disagree(stream):
    noise = np.random.default_rng(0).integers(0, 255, (SIDE, SIDE), np.uint8)
    preview = seen(stream, noise, lambda preview: preview.disagrees).preview
    assert preview.trust < 0.3
    assert preview.offset_mm == 0.0


def test_a_real_frame_that_is_none_is_refused_and_the_stream_goes_on(stream):
    with pytest.raises(errors.InvalidArgument, match="floating point must hold finite values"):
        stream.send_real(np.full((SIDE, SIDE), np.nan), time.monotonic_ns())
    stream.send(POSE)
    stream.receive()
    stream.send_real(b"no picture", time.monotonic_ns() - 10**12)
    with pytest.raises(errors.InvalidArgument, match="between those of poses"):
        stream.receive()
    stream.send(POSE)
    assert stream.receive().preview is None


def test_real_frames_are_sent_beside_asynchronous_poses(service):
    async def first_preview():
        image, deadline = real((0.0, 0.0, 0.0)), Deadline(120)
        async with AsyncClient(service.grpc) as client, client.stream("spine", SETTINGS, mode="latest") as stream:
            while not deadline.passed:
                now_ns = time.monotonic_ns()
                await stream.send(POSE, measured_ns=now_ns)
                if (preview := (await stream.receive()).preview) is not None:
                    return preview
                await stream.send_real(image, now_ns)
        return None

    assert asyncio.run(first_preview()).agreement > 0.9
