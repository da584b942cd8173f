"""What clients of all kinds do, one visit at a time: those that work, and those that are slow or vanish."""

import itertools
import json
import random
import socket
import struct
import time

import cv2
import httpx
import numpy as np
from websockets.sync.client import connect

from ultragray_client import Client
from ultragray_client.contract import AroundSampler, RenderJob, TrainJob
from ultragray_service.igtl.contents import unpack_image
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message

from ..service.igtl.conftest import Peer
from .place import CHANGING, POSES, STEADY

TIMEOUT_S = 60.0
UPLOAD_TIMEOUT_S = 600.0  # they are checked one at a time
STREAMED = 40  # poses of one visit to a stream
_numbers = itertools.count()


def any_pose():
    return random.randrange(len(POSES))


def body(index, **more):
    return {"pose": {"matrix": POSES[index].tolist()}, **more}


def grpc_unary(place):
    with Client(place.service.grpc) as client:
        for _ in range(20):
            scene, index = random.choice([STEADY, CHANGING]), any_pose()
            frame = client.render(scene, POSES[index], timeout_s=TIMEOUT_S)
            place.check(frame.scene_sha256, index, frame["bmode"])
            time.sleep(0.02)


def grpc_batch(place):
    with Client(place.service.grpc) as client:
        for index, frame in enumerate(client.render_batch(STEADY, POSES, timeout_s=TIMEOUT_S)):
            place.check(frame.scene_sha256, index, frame["bmode"])
    time.sleep(0.2)


def grpc_ordered(place):
    sent = [any_pose() for _ in range(STREAMED)]
    with Client(place.service.grpc) as client, client.stream(CHANGING, timeout_s=TIMEOUT_S) as stream:
        for index in sent:
            stream.send(POSES[index])
        stream.done_sending()
        for index, frame in zip(sent, stream, strict=True):
            place.check(frame.scene_sha256, index, frame["bmode"])


def _latest(place, read_every_s):
    """Poses at 60 Hz, and a reader that takes its time."""
    sent = {}
    with Client(place.service.grpc) as client, client.stream(STEADY, mode="latest", timeout_s=TIMEOUT_S) as stream:
        next_read = time.monotonic()
        for _ in range(STREAMED * 3):
            index = any_pose()
            sent[stream.send(POSES[index])] = index
            if time.monotonic() >= next_read:
                frame = stream.receive()
                place.check(frame.scene_sha256, sent[frame.sequence], frame["bmode"])
                next_read = time.monotonic() + read_every_s
            time.sleep(1 / 60)


def grpc_latest(place):
    _latest(place, read_every_s=0.0)


def grpc_latest_slow_reader(place):
    _latest(place, read_every_s=0.5)


def http_raw(place):
    with httpx.Client(base_url=place.service.http, timeout=TIMEOUT_S) as client:
        for _ in range(20):
            scene, index = random.choice([STEADY, CHANGING]), any_pose()
            answer = client.post(
                f"/v1/scenes/{scene}/render", json=body(index), headers={"Accept": "application/octet-stream"}
            )
            answer.raise_for_status()
            sha256 = answer.headers["X-Ultragray-Scene-Sha256"]
            pixels = np.frombuffer(answer.content, np.uint8).reshape(place.expected[sha256][index].shape)
            place.check(sha256, index, pixels)
            time.sleep(0.02)


def http_png(place):
    with httpx.Client(base_url=place.service.http, timeout=TIMEOUT_S) as client:
        for _ in range(10):
            index = any_pose()
            answer = client.post(
                f"/v1/scenes/{STEADY}/render", json=body(index), headers={"Accept": "image/png"}
            ).raise_for_status()
            pixels = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
            place.check(answer.headers["X-Ultragray-Scene-Sha256"], index, pixels)
            time.sleep(0.05)


def websocket(place):
    address = f"{place.service.http.replace('http', 'ws', 1)}/v1/scenes/{CHANGING}/stream"
    with connect(address, compression=None, max_size=None) as stream:
        for sequence in range(STREAMED):
            index = any_pose()
            stream.send(json.dumps({"sequence": sequence, **body(index)}))
            answer = stream.recv(timeout=TIMEOUT_S)
            assert isinstance(answer, bytes), answer
            end = 4 + int.from_bytes(answer[:4], "little")
            header = json.loads(answer[4:end])
            assert header["sequence"] == sequence
            pixels = np.frombuffer(answer[end:], np.uint8).reshape(header["height"], header["width"])
            place.check(header["scene_sha256"], index, pixels)
            time.sleep(0.02)


def igtl(place):
    peer = Peer(place.igtl)
    with peer.socket:
        for _ in range(STREAMED):
            index = any_pose()
            stamp = next(_numbers) + 1
            peer.send_pose(POSES[index], STEADY, timestamp=stamp)
            answer = peer.receive()
            assert (answer.type_name, answer.timestamp) == ("IMAGE", stamp), answer
            place.check(place.steady_sha256, index, unpack_image(answer.content).pixels)
            time.sleep(0.02)


def http_slow_reader(place):
    """Many frames in one answer, taken a little at a time."""
    asked = {"poses": [{"matrix": pose.tolist()} for pose in POSES], "height": 256, "width": 256}
    headers = {"Accept": "application/x-npz"}
    with (
        httpx.Client(base_url=place.service.http, timeout=TIMEOUT_S) as client,
        client.stream("POST", f"/v1/scenes/{STEADY}/render", json=asked, headers=headers) as answer,
    ):
        answer.raise_for_status()
        for _ in answer.iter_bytes(100_000):
            time.sleep(0.05)


def vanishing(place):
    """Clients that are cut off, each at another door, in the middle of what they do."""
    host, port = place.service.http.removeprefix("http://").split(":")
    document = json.dumps(body(0)).encode()
    half = b"POST /v1/scenes/%s/render HTTP/1.1\r\nHost: %s\r\nContent-Length: %d\r\n\r\n%s"
    asked = half % (STEADY.encode(), host.encode(), len(document), document)
    upgrade = (
        f"GET /v1/scenes/{STEADY}/stream HTTP/1.1\r\nHost: {host}:{port}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    ).encode()
    igtl_host, igtl_port = place.igtl.rsplit(":", 1)
    transform = pack_message(Message("GET_IMAGE", STEADY))
    for address, data in (
        ((host, int(port)), asked[: random.randrange(len(asked))]),
        ((host, int(port)), asked),
        ((host, int(port)), upgrade),
        ((igtl_host, int(igtl_port)), transform[: random.randrange(HEADER_BYTES)]),
        ((igtl_host, int(igtl_port)), transform),
    ):
        with socket.create_connection(address, timeout=TIMEOUT_S) as peer:
            peer.sendall(data)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, no FIN
    client = Client(place.service.grpc)
    stream = client.stream(STEADY, timeout_s=TIMEOUT_S)
    for _ in range(5):
        stream.send(POSES[0])
    client.close()
    time.sleep(0.3)


def scenes(place):
    """Scenes come, are replaced, loaded, unloaded and go, while others render them."""
    place.replace_scene()
    with Client(place.service.grpc) as client, httpx.Client(base_url=place.service.http, timeout=TIMEOUT_S) as http:
        client.scenes.unload(CHANGING)
        client.scenes.load(CHANGING)
        name = f"visit-{next(_numbers)}"
        http.put(
            f"/v1/scenes/{name}",
            content=place.versions[0].read_bytes(),
            headers={"Content-Type": "application/octet-stream"},
            timeout=UPLOAD_TIMEOUT_S,
        ).raise_for_status()
        frame = client.render(name, POSES[3], timeout_s=TIMEOUT_S)
        place.check(frame.scene_sha256, 3, frame["bmode"])
        http.delete(f"/v1/scenes/{name}").raise_for_status()
    time.sleep(0.5)


def datasets(place):
    with Client(place.service.grpc) as client:
        name = f"sweep-{next(_numbers)}"
        client.datasets.upload(name, place.dataset, timeout_s=UPLOAD_TIMEOUT_S)
        assert client.datasets.contact_sheet(name).startswith(b"\x89PNG")
        client.datasets.delete(name)
    time.sleep(1.0)


def jobs(place):
    """An archive of frames, and now and then a training, each watched to its end, and removed."""
    number = next(_numbers)
    with Client(place.service.grpc) as client, httpx.Client(base_url=place.service.http, timeout=TIMEOUT_S) as http:
        scene = f"trained-{number}"
        if number % 4:
            job = client.jobs.submit(RenderJob(STEADY, sampler=AroundSampler(count=3), height=16, width=12))
        else:
            client.datasets.upload(scene, place.dataset, timeout_s=UPLOAD_TIMEOUT_S)
            settings = {"steps": 12, "max_gaussians": 60, "confidence": False}
            job = client.jobs.submit(TrainJob(scene, scene, settings=settings, device="cpu"))
        last = watched(http, job.id)
        assert last["state"] == "succeeded", last
        client.jobs.delete(job.id)
        if not number % 4:
            http.delete(f"/v1/scenes/{scene}").raise_for_status()
            client.datasets.delete(scene)


def watched(http, job):
    """The job as its server-sent events tell it at the end."""
    last = {}
    with http.stream("GET", f"/v1/jobs/{job}/events", timeout=UPLOAD_TIMEOUT_S) as events:
        events.raise_for_status()
        event = ""
        for line in events.iter_lines():
            name, _, value = line.partition(": ")
            if name == "event":
                event = value
            elif name == "data" and event == "progress":
                last = json.loads(value)
    return last


def lists(place):
    with httpx.Client(base_url=place.service.http, timeout=TIMEOUT_S) as http:
        for path in ("/v1/scenes", f"/v1/scenes/{STEADY}", "/v1/datasets", "/v1/jobs", "/v1/statistics", "/metrics"):
            http.get(path).raise_for_status()
    time.sleep(0.5)


VISITORS = {
    visitor.__name__: visitor
    for visitor in (
        *(grpc_unary, grpc_batch, grpc_ordered, grpc_latest, grpc_latest_slow_reader),
        *(http_raw, http_png, http_slow_reader, websocket, igtl, vanishing, scenes, datasets, jobs, lists),
    )
}
