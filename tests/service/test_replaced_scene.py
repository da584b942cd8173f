"""A scene whose file is replaced while frames of it are asked for: no frame mixes the old one with the new one."""

import hashlib
import json
import os
import threading
import time

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from ultragray import LinearProbe

from .conftest import make_scene

SWAPS = 8
BETWEEN_SWAPS_S = 0.1


class Changing:
    """A scene that is replaced by one with another probe, and back."""

    def __init__(self, folder):
        self.path = folder / "changing.ugr"
        self._contents = []
        self.known = set()
        for far_mm, gaussians in ((40.0, 400), (60.0, 500)):
            make_scene(gaussians, probe=LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=far_mm)).save(self.path)
            self._contents.append(self.path.read_bytes())
            self.known.add((hashlib.sha256(self._contents[-1]).hexdigest(), far_mm))

    def swap(self):
        self._contents.reverse()
        other = self.path.with_suffix(".new")
        other.write_bytes(self._contents[0])
        os.replace(other, self.path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("changing")


@pytest.fixture(scope="module")
def changing(folder):
    return Changing(folder)


@pytest.fixture(scope="module")
def service(start_service, changing, folder):
    return start_service(data_folder=folder)


def check(changing, ask):
    """Both contents are seen while they are swapped, at most once during an answer, each with its own probe only."""
    seen = set()
    may_swap, idle, done = threading.Event(), threading.Event(), threading.Event()

    def swap():
        for _ in range(SWAPS):
            idle.set()
            assert may_swap.wait(300)
            may_swap.clear()
            time.sleep(BETWEEN_SWAPS_S)  # into this answer or a later one
            changing.swap()
        done.set()

    swapping = threading.Thread(target=swap)
    swapping.start()
    try:
        while not done.is_set() or seen != changing.known:
            if idle.is_set():
                idle.clear()
                may_swap.set()
            seen.update(ask())
            assert seen <= changing.known
            if done.is_set():
                changing.swap()
    finally:
        swapping.join()


def test_http(service, changing):
    body = {"poses": [{"matrix": np.eye(4).tolist()}] * 3, "dtype": "uint8"}

    def ask():
        answer = client.post("/v1/scenes/changing/render", json=body, headers={"Accept": "application/octet-stream"})
        assert answer.status_code == 200, answer.text
        probe = json.loads(answer.headers["X-Ultragray-Probe"])
        yield answer.headers["X-Ultragray-Scene-Sha256"], probe["far_mm"]

    with httpx.Client(base_url=service.http, timeout=300) as client:
        check(changing, ask)


def test_what_the_new_scene_cannot_give_is_told_and_the_stream_goes_on(service, changing):
    """A scene without a probe of its own takes the place of one with a probe, under a stream that names none."""
    message = json.dumps({"pose": {"matrix": np.eye(4).tolist()}})
    with connect(service.stream_url("changing"), compression=None, max_size=None, close_timeout=0.2) as connection:
        connection.send(message)
        assert isinstance(connection.recv(timeout=300), bytes)
        make_scene(20).save(changing.path)
        for _ in range(2):
            connection.send(message)
            refusal = connection.recv(timeout=300)
            assert isinstance(refusal, str)
            assert json.loads(refusal)["error"]["reason"] == "INVALID_PROBE"
            assert json.loads(refusal)["error"]["field"] == "settings.probe"
        changing.swap()
        connection.send(message)
        assert isinstance(connection.recv(timeout=300), bytes)
