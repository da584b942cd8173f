"""Scene files over HTTP: looked into, downloaded, imported, deleted."""

import asyncio
import hashlib
import json
import socket
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import httpx
import numpy as np
import pytest
from safetensors.numpy import load, save
from starlette.requests import Request

from ultragray import GaussianScene, read_header
from ultragray_service.core.scene_points import even_selection
from ultragray_service.http.routes.scenes import OpenFileResponse, download_compressed_scene

from ...waiting import wait_until
from ...warm import Hold
from ..conftest import DEMO_PROBE, make_scene

MAX_BYTES = 20_000_000
RAW = {"Content-Type": "application/octet-stream"}
POSE = {"position_mm": {"x": 0, "y": 1, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(artifact_folder=artifacts, max_dataset_bytes=MAX_BYTES, max_body_bytes=1024)


def points_of(answer):
    length = int.from_bytes(answer.content[:4], "little")
    assert (4 + length) % 8 == 0
    header = json.loads(answer.content[4 : 4 + length])
    return header, np.frombuffer(answer.content[4 + length :], "<f4").reshape(-1, 6)


def test_gaussians_as_points(http, demo_scene):
    answer = http.get("/v1/scenes/demo/gaussians")
    header, points = points_of(answer)
    assert header == {
        "count": 400,
        "fields": ["x", "y", "z", "intensity", "transmittance", "deviation_mm"],
        "total": 400,
    }
    means_mm = demo_scene.means.numpy() * 10 + [0, 0, 20]
    np.testing.assert_allclose(points[:, :3], means_mm, atol=1e-4)
    intensity = (demo_scene.sh0[:, 0, 0].numpy() * 0.28209479 + 1).clip(0.5, 0.999)
    np.testing.assert_allclose(points[:, 3], intensity, atol=1e-5)
    np.testing.assert_allclose(points[:, 4], demo_scene.transmittances.sigmoid().numpy(), atol=1e-5)
    np.testing.assert_allclose(points[:, 5], 10 * demo_scene.scales.exp().mean(dim=1).numpy(), rtol=1e-5)

    few, chosen = points_of(http.get("/v1/scenes/demo/gaussians", params={"limit": 7}))
    assert few["count"] == 7
    np.testing.assert_array_equal(chosen, points[even_selection(400, 7)])
    assert http.get("/v1/scenes/demo/gaussians", params={"limit": 0}).json()["reason"] == "INVALID_ARGUMENT"
    assert http.get("/v1/scenes/nobody/gaussians").json()["reason"] == "SCENE_NOT_FOUND"


def test_the_shape_of_gaussians_is_told_where_it_is_asked_for(http, demo_scene):
    fields = ["deviation_3_mm", "qw", "qx", "qy", "qz", "deviation_1_mm", "label", "x"]
    answer = http.get("/v1/scenes/demo/gaussians", params={"fields": fields})
    length = int.from_bytes(answer.content[:4], "little")
    assert json.loads(answer.content[4 : 4 + length])["fields"] == fields
    points = np.frombuffer(answer.content[4 + length :], "<f4").reshape(-1, len(fields))
    scales_mm = 10 * demo_scene.scales.exp().numpy()
    np.testing.assert_allclose(points[:, 0], scales_mm[:, 2], rtol=1e-5)
    np.testing.assert_allclose(points[:, 5], scales_mm[:, 0], rtol=1e-5)
    quaternions = demo_scene.quats / demo_scene.quats.norm(dim=1, keepdim=True)
    np.testing.assert_allclose(points[:, 1:5], quaternions.numpy(), atol=1e-5)
    labels = np.zeros(len(points)) if demo_scene.labels is None else demo_scene.labels.numpy()
    np.testing.assert_array_equal(points[:, 6], labels)
    np.testing.assert_allclose(points[:, 7], points_of(http.get("/v1/scenes/demo/gaussians"))[1][:, 0])
    refused = http.get("/v1/scenes/demo/gaussians", params={"fields": ["x", "colour"]}).json()
    assert (refused["reason"], refused["field"]) == ("INVALID_ARGUMENT", "fields")


@pytest.mark.parametrize(("count", "limit"), [(0, 5), (3, 5), (1000, 7)])
def test_an_even_selection(count, limit):
    chosen = even_selection(count, limit)
    assert len(chosen) == min(count, limit) == len(set(chosen.tolist()))
    gaps = np.diff([*chosen, count])
    assert not len(chosen) or gaps.max() - gaps.min() <= 1


def test_training_poses(http, demo_scene):
    told = http.get("/v1/scenes/demo/training-poses").json()
    np.testing.assert_array_equal(np.array(told["poses"]).reshape(-1, 4, 4), demo_scene.training_poses)
    assert told["rest_poses"] is told["shift_mm"] is told["turn_deg"] is None


def test_the_life_of_an_imported_scene(http, artifacts):
    sent = make_scene(probe=DEMO_PROBE, seed=5).to_bytes()
    answer = http.put("/v1/scenes/sent", content=sent, headers=RAW)
    assert answer.status_code == 201, answer.text
    assert (answer.json()["name"], answer.json()["gaussian_count"]) == ("sent", 400)
    assert "sent" in [scene["name"] for scene in http.get("/v1/scenes").json()["scenes"]]

    whole = http.get("/v1/scenes/sent/file")
    assert whole.content == sent
    assert 'filename="sent.ugr"' in whole.headers["content-disposition"]
    part = http.get("/v1/scenes/sent/file", headers={"Range": "bytes=10-19"})
    assert (part.status_code, part.content) == (206, sent[10:20])

    again = http.put("/v1/scenes/sent", content=sent, headers=RAW)
    assert (again.status_code, again.json()["reason"]) == (409, "SCENE_EXISTS")
    assert "delete it first, or choose another name" in again.json()["detail"]
    assert http.post("/v1/scenes/sent/render", json={"pose": POSE}).status_code == 200
    assert http.get("/v1/scenes/sent").json()["loaded"]
    removable = {entry["name"]: entry["removable"] for entry in http.get("/v1/scenes").json()["scenes"]}
    assert (removable["demo"], removable["sent"]) == (False, True)

    assert http.delete("/v1/scenes/sent").status_code == 204
    assert http.get("/v1/scenes/sent").json()["reason"] == "SCENE_NOT_FOUND"
    assert http.delete("/v1/scenes/sent").json()["reason"] == "SCENE_NOT_FOUND"
    assert http.get("/v1/statistics").json()["loaded_scenes"] == 0
    assert not list((artifacts / "scenes").iterdir())


def test_what_is_no_scene_is_refused_and_leaves_nothing(http, artifacts):
    whole = make_scene(probe=DEMO_PROBE).to_bytes()
    damaged = bytearray(whole)
    damaged[-200:] = b"\xff" * 200  # a header that is well, and numbers that are none
    for content, detail in (
        (whole[:-100], "the body"),
        (b"\x89PNG no scene", "the body"),
        (bytes(damaged), "the body"),
    ):
        answer = http.put("/v1/scenes/bad", content=content, headers=RAW)
        problem = answer.json()
        assert (answer.status_code, problem["reason"], problem["field"]) == (422, "SCENE_FILE_INVALID", "body")
        assert detail in problem["detail"]
        assert str(artifacts) not in problem["detail"]
    announced = http.put("/v1/scenes/bad", content=b"\0" * (MAX_BYTES + 1), headers=RAW)
    assert (announced.status_code, announced.json()["reason"]) == (413, "UPLOAD_TOO_LARGE")

    def blocks():
        for _ in range(3):
            yield b"\0" * (MAX_BYTES // 2)

    assert http.put("/v1/scenes/bad", content=blocks(), headers=RAW).status_code == 413
    assert http.put("/v1/scenes/.bad", content=whole, headers=RAW).json()["reason"] == "INVALID_ARGUMENT"
    assert not list((artifacts / "scenes").glob("*"))
    assert not list((artifacts / "scenes").glob(".*"))


def test_scenes_of_the_data_folder_stay(http, data_folder):
    answer = http.delete("/v1/scenes/demo")
    assert (answer.status_code, answer.json()["reason"]) == (403, "SCENE_READ_ONLY")
    assert (data_folder / "demo.ugr").exists()
    taken = http.put("/v1/scenes/demo", content=make_scene().to_bytes(), headers=RAW)
    assert taken.json()["reason"] == "SCENE_EXISTS"
    assert taken.json()["detail"] == "there is already a scene 'demo': choose another name"


def test_what_did_not_change_is_not_sent_again(http, artifacts):
    sent = make_scene(probe=DEMO_PROBE, seed=6).to_bytes()
    assert http.put("/v1/scenes/kept", content=sent, headers=RAW).status_code == 201
    for path in ("/v1/scenes/kept/gaussians", "/v1/scenes/kept/training-poses"):
        first = http.get(path)
        assert first.headers["cache-control"] == "private, no-cache"
        again = http.get(path, headers={"If-None-Match": first.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
    (artifacts / "scenes" / "other").write_bytes(make_scene(300).to_bytes())
    (artifacts / "scenes" / "other").replace(artifacts / "scenes" / "kept.ugr")
    for path in ("/v1/scenes/kept/gaussians", "/v1/scenes/kept/training-poses"):
        assert http.get(path, headers={"If-None-Match": first.headers["etag"]}).status_code == 200
    assert http.delete("/v1/scenes/kept").status_code == 204


def test_who_stops_during_the_check_gets_no_scene(service, http, artifacts):
    whole = make_scene(probe=DEMO_PROBE, seed=8).to_bytes()
    url = httpx.URL(service.http)
    with Hold("check_scene_file") as held, socket.create_connection((url.host, url.port)) as connection:
        head = f"PUT /v1/scenes/stopped HTTP/1.1\r\nHost: {url.host}\r\nContent-Length: {len(whole)}\r\n\r\n"
        connection.sendall(head.encode() + whole)
        checking = wait_until(lambda: held.pid)
        connection.close()
        wait_until(lambda: not Path(f"/proc/{checking}").exists())
    wait_until(lambda: not list((artifacts / "scenes").glob(".*")))
    assert http.get("/v1/scenes/stopped").status_code == 404
    assert http.put("/v1/scenes/stopped", content=whole, headers=RAW).status_code == 201
    assert http.delete("/v1/scenes/stopped").status_code == 204


def changed(whole, metadata=None, **tensors):
    """The scene file with other metadata and tensors."""
    length = int.from_bytes(whole[:8], "little")
    info = json.loads(json.loads(whole[8 : 8 + length])["__metadata__"]["ultragray"])
    return save({**load(whole), **tensors}, {"ultragray": json.dumps({**info, **(metadata or {})})})


def test_values_that_no_scene_has_are_refused_at_the_door(http):
    whole = make_scene(probe=DEMO_PROBE).to_bytes()
    scales = np.full_like(load(whole)["scales"], 1000.0)
    for sent, said in (
        (changed(whole, scales=scales), "'scales'] must be finite and within ±20"),
        (changed(whole, {"centre_mm": [1e308, 0.0, 0.0]}), "centre_mm[0] must be a finite number from -1e+06"),
        (changed(whole, {"metrics": {"psnr_db": 10**400}}), "metrics.psnr_db must be a finite number"),
    ):
        answer = http.put("/v1/scenes/odd", content=sent, headers=RAW)
        assert answer.status_code == 422
        assert said in answer.json()["detail"]


def test_what_a_killed_service_left_goes_at_once(start_service, tmp_path):
    whole = make_scene(probe=DEMO_PROBE).to_bytes()
    killed = start_service(artifact_folder=tmp_path)
    url = httpx.URL(killed.http)

    def received():
        return [path.stat().st_size for path in (tmp_path / "scenes").glob(".importing-*")]

    with socket.create_connection((url.host, url.port)) as connection:
        head = f"PUT /v1/scenes/late HTTP/1.1\r\nHost: {url.host}\r\nContent-Length: {len(whole)}\r\n\r\n"
        connection.sendall(head.encode() + whole[:-1])
        wait_until(lambda: sum(received()))
        start_service(artifact_folder=tmp_path)
        assert received()  # another one lives
        killed.process.kill()
        killed.process.wait()
    start_service(artifact_folder=tmp_path)
    assert not received()


def test_corrected_training_poses(http):
    plain = make_scene(probe=DEMO_PROBE, seed=6)
    corrections = np.tile(np.eye(4), (2, 1, 1))
    corrections[1, 0, 3] = 2.0
    scene = GaussianScene.from_splats(
        plain.splats, info=plain.info, training_poses=np.tile(np.eye(4), (2, 1, 1)), pose_corrections=corrections
    )
    assert http.put("/v1/scenes/corrected", content=scene.to_bytes(), headers=RAW).status_code == 201
    told = http.get("/v1/scenes/corrected/training-poses").json()
    assert (told["shift_mm"], told["turn_deg"]) == ([0.0, 2.0], [0.0, 0.0])
    http.delete("/v1/scenes/corrected")


def test_poses_in_the_tissue_at_rest_are_told_beside_those_of_the_tracker(http):
    plain = make_scene(probe=DEMO_PROBE, seed=6)
    tracked, at_rest = np.tile(np.eye(4), (2, 2, 1, 1))
    at_rest[1, 2, 3] = 3.0
    info = replace(plain.info, tissue_shares=(0.5, 0.5, 0.5))
    scene = GaussianScene.from_splats(plain.splats, info=info, training_poses=tracked, rest_poses=at_rest)
    assert http.put("/v1/scenes/at_rest", content=scene.to_bytes(), headers=RAW).status_code == 201
    told = http.get("/v1/scenes/at_rest/training-poses").json()
    for name, poses in (("poses", tracked), ("rest_poses", at_rest)):
        np.testing.assert_array_equal(np.array(told[name]).reshape(-1, 4, 4), poses)
    assert (told["shift_mm"], told["turn_deg"]) == ([0.0, 3.0], [0.0, 0.0])
    http.delete("/v1/scenes/at_rest")


async def sent(response):
    """What a client gets of a response."""
    async with httpx.AsyncClient(transport=httpx.ASGITransport(response), base_url="http://test") as client:
        return await client.get("/")


def test_a_download_is_of_one_version_whatever_takes_its_name(tmp_path):
    """A scene that grows gets a new version after the length of the one before was told."""
    path, newer = tmp_path / "liver.ugr", tmp_path / "newer.ugr"
    path.write_bytes(b"the version that was asked for")
    response = OpenFileResponse(path.open("rb"), filename="liver.ugr")
    newer.write_bytes(b"a shorter one")
    newer.replace(path)
    answer = asyncio.run(sent(response))
    assert (answer.content, answer.headers["content-length"]) == (b"the version that was asked for", "30")


def test_a_compressed_scene_is_sent_whole_though_it_is_removed_once_found(tmp_path):
    """Those that were asked for longest ago are removed as others are made."""
    path = tmp_path / "liver.ugz"
    path.write_bytes(b"a compressed scene")

    class Compressed:
        async def open(self, scene):
            file = path.open("rb")
            path.unlink()
            return file

    service = SimpleNamespace(compressed=Compressed(), life=SimpleNamespace(require_serving=lambda: None))
    request = Request({"type": "http", "headers": []})

    async def get():
        return await sent(await download_compressed_scene(request, service, "liver"))

    answer = asyncio.run(get())
    assert (answer.content, answer.headers["content-length"]) == (b"a compressed scene", "18")
    assert answer.headers["etag"] == f'"{hashlib.sha256(answer.content).hexdigest()}"'


def test_a_scene_is_handed_out_compressed_once_made(http, demo_scene, artifacts, tmp_path):
    answer = http.get("/v1/scenes/demo/file.ugz")
    assert answer.status_code == 200, answer.text
    assert 'filename="demo.ugz"' in answer.headers["content-disposition"]
    assert answer.headers["accept-ranges"] == "bytes"
    (tmp_path / "got.ugz").write_bytes(answer.content)
    assert read_header(tmp_path / "got.ugz").is_compressed
    assert answer.content == demo_scene.to_compressed_bytes()
    (kept,) = (artifacts / "compressed").glob("*/*.ugz")
    made = kept.stat().st_mtime_ns
    tag = answer.headers["etag"]
    assert tag == f'"{hashlib.sha256(answer.content).hexdigest()}"'
    assert http.get("/v1/scenes/demo/file.ugz", headers={"If-None-Match": tag}).status_code == 304
    part = {"Range": "bytes=1000-"}
    rest = http.get("/v1/scenes/demo/file.ugz", headers={**part, "If-Range": tag})
    assert (rest.status_code, rest.content) == (206, answer.content[1000:])
    assert rest.headers["content-range"] == f"bytes 1000-{len(answer.content) - 1}/{len(answer.content)}"
    assert http.get("/v1/scenes/demo/file.ugz", headers={**part, "If-Range": '"another"'}).status_code == 200
    assert http.get("/v1/scenes/demo/file.ugz", headers={"Range": "bytes=100000000-"}).status_code == 416
    assert kept.stat().st_mtime_ns == made
    assert http.get("/v1/scenes/nobody/file.ugz").json()["reason"] == "SCENE_NOT_FOUND"


def test_a_compressed_scene_is_served_like_any_other(http, demo_scene):
    sent = demo_scene.to_compressed_bytes()
    answer = http.put("/v1/scenes/small", content=sent, headers=RAW)
    assert answer.status_code == 201, answer.text
    try:
        for form in ("file", "file.ugz"):
            whole = http.get(f"/v1/scenes/small/{form}")
            assert whole.content == sent
            assert whole.headers["cache-control"] == "private, no-cache"
            again = http.get(f"/v1/scenes/small/{form}", headers={"If-None-Match": whole.headers["etag"]})
            assert (again.status_code, again.content) == (304, b""), form
            assert again.headers["etag"] == whole.headers["etag"]
            assert http.get(f"/v1/scenes/small/{form}", headers={"If-None-Match": '"another"'}).status_code == 200
            assert 'filename="small.ugz"' in whole.headers["content-disposition"]
        assert http.post("/v1/scenes/small/render", json={"pose": POSE}).status_code == 200
        _, points = points_of(http.get("/v1/scenes/small/gaussians"))
        assert len(points) == demo_scene.gaussian_count
        cut = http.put("/v1/scenes/cut", content=sent[:-100], headers=RAW).json()
        assert (cut["reason"], cut["field"]) == ("SCENE_FILE_INVALID", "body")
    finally:
        assert http.delete("/v1/scenes/small").status_code == 204
