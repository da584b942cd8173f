"""`ultragray live` as a client of an OpenIGTLink server: pyigtl's, in the place of that of PLUS, and a real service."""

import signal
import socket
import threading
from contextlib import contextmanager

import httpx
import numpy as np
import pyigtl
import pytest

from ultragray.datasets.source import SourceOptions
from ultragray.errors import InvalidArgument
from ultragray_service.igtl import scanner
from ultragray_workers.datasets.store import open_datasets

from ...waiting import wait_until
from ..cli.command_line import refused, run

HEIGHT, WIDTH, PIXEL_MM = 20, 16, (1.0, 0.5)
IMAGE_TO_PROBE = np.array(  # the probe's origin is in the middle of the upper edge
    [
        [PIXEL_MM[0], 0, 0, -PIXEL_MM[0] * (WIDTH - 1) / 2],
        [0, 0, 1, 0],
        [0, PIXEL_MM[1], 0, PIXEL_MM[1] / 2],
        [0, 0, 0, 1],
    ]
)


def pose_of(number):
    pose = np.eye(4)
    pose[:3, 3] = 2.0, 0.5 * number, -1.0
    return pose


def pixels_of(number):
    return np.random.default_rng(number).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)


def image(number, pixels=None, matrix=IMAGE_TO_PROBE, name="Image_Probe"):
    shown = pixels_of(number) if pixels is None else pixels
    return pyigtl.ImageMessage(shown[None], matrix, timestamp=100.0 + 0.1 * number, device_name=name)


def transform(number):
    return pyigtl.TransformMessage(pose_of(number), timestamp=100.0 + 0.1 * number, device_name="ProbeToReference")


@contextmanager
def sending(*messages):
    """The address of a server that sends these to whoever connects, and closes."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    server = pyigtl.OpenIGTLinkServer(port=0)
    for number, handler in before.items():  # it takes those of the process
        signal.signal(number, handler)

    def send():
        wait_until(server.is_connected)
        for message in messages:
            server.send_message(message, wait=False)
        wait_until(lambda: not server.outgoing_messages or not server.is_connected())  # some leave before the end
        server.stop()

    thread = threading.Thread(target=send)
    thread.start()
    yield f"igtl://127.0.0.1:{server.server_address[1]}"
    thread.join()


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(artifact_folder=artifacts)


def test_a_scanner_is_recorded_with_the_poses_of_its_transforms(service, artifacts):
    messages = []
    for number in range(6):
        pair = [image(number), transform(number)]
        messages += pair if number % 2 else pair[::-1]
    lost, dark = image(6), [image(7, np.zeros((HEIGHT, WIDTH), np.uint8)), transform(7)]
    with sending(*messages[:6], lost, *dark, *messages[6:]) as address:
        asked = ("--transform", "ProbeToReference", "--address", service.http)
        told = run("live", address, "spine", "--open", *asked)
    assert told.exit_code == 0, told.output
    frames = [one for block in open_datasets(artifacts, artifacts).recordings.frames("spine") for one in block]
    assert [one.number for one in frames] == list(range(6))
    np.testing.assert_array_equal([one.pixels for one in frames], [pixels_of(number) for number in range(6)])
    np.testing.assert_allclose([one.pose for one in frames], [pose_of(number) for number in range(6)], atol=1e-5)
    np.testing.assert_allclose([one.time_s for one in frames], 100.0 + 0.1 * np.arange(6))

    with sending(*(one for number in (8, 9, 10) for one in (image(number), transform(number)))) as address:
        told = run("live", address, "spine", *asked)
    assert told.exit_code == 0, told.output
    record = httpx.get(f"{service.http}/v1/datasets/spine").json()
    assert (record["train_frames"] + record["val_frames"], record["height"], record["width"]) == (9, HEIGHT, WIDTH)


def test_a_pose_that_is_embedded_in_an_image_is_that_of_its_crop(service, artifacts):
    embedded = (image(number, matrix=pose_of(number) @ IMAGE_TO_PROBE, name="Image_Reference") for number in range(4))
    with sending(*embedded) as address:
        told = run("live", address, "crop", "--open", "--crop", "4:12,10:20", "--address", service.http)
    assert told.exit_code == 0, told.output
    store = open_datasets(artifacts, artifacts).recordings
    settings, frames = store.settings("crop"), [one for block in store.frames("crop") for one in block]
    assert settings.probe.width_mm == pytest.approx(8 * PIXEL_MM[0])
    np.testing.assert_array_equal(frames[3].pixels, pixels_of(3)[10:20, 4:12])
    lower = pose_of(3)
    lower[2, 3] += 10 * PIXEL_MM[1]
    np.testing.assert_allclose(frames[3].pose, lower, atol=1e-5)


def test_what_cannot_be_recorded_is_told_in_a_line(service):
    shallow = IMAGE_TO_PROBE * [1.0, 1.1, 1.0, 1.0]
    with sending(image(0), image(1, matrix=shallow)) as address:
        assert "the depth was changed" in refused("live", address, "deep", "--address", service.http)
    with sending(image(0), image(0, name="Other_Probe")) as address:
        assert "several images: Image_Probe, Other_Probe" in refused("live", address, "two", "--address", service.http)
    with sending(transform(0)) as address:
        assert "closed the connection before" in refused("live", address, "none", "--address", service.http)
    assert "no OpenIGTLink server answers" in refused("live", "igtl://127.0.0.1:1", "none", "--address", service.http)
    with pytest.raises(InvalidArgument, match="device_set is not for frames of a scanner"):
        next(scanner.scanned("igtl://127.0.0.1:1", SourceOptions(device_set="plus.xml")))


def test_a_server_that_sends_nothing_is_given_up(monkeypatch, service):
    monkeypatch.setattr(scanner, "PATIENCE_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"igtl://127.0.0.1:{silent.getsockname()[1]}"
        told = refused("live", address, "none", "--transform", "ProbeToReference", "--address", service.http)
    assert "has sent no IMAGE with a TRANSFORM ProbeToReference of the same time in" in told
