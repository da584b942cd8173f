"""Frames go on by the registrations that a service has copied, while the database that keeps them is away."""

import json
from typing import Any, cast

import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from ultragray_service.core import registrations as store
from ultragray_service.core.registrations import NamedRegistration, Registrations
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.owners import tell_change
from ultragray_workers.jobs.tables import REGISTRATIONS

from ..waiting import at_this_load, wait_until

PATH = "/v1/registrations/robot"
TOO_LATE_S = 30.0  # whoever waits for the database waits for ten
AT_ONCE_S = 5.0  # a frame that does not wait for it


def put(http, by_mm):
    base_to_scene = np.eye(4)
    base_to_scene[1, 3] = by_mm
    answer = http.put(PATH, json={"scene": "demo", "base_to_scene": base_to_scene.tolist()})
    assert answer.status_code == 200, answer.text


def render(http, pose, registration):
    body = {"pose": pose, "height": 16, "width": 16, "registration": registration}
    return http.post("/v1/scenes/demo/render", json=body)


def shift_mm(answer):
    assert answer.status_code == 200, answer.text
    pose = json.loads(answer.headers["X-Ultragray-Pose"])  # [4, 4] mm, in the scene
    return float(pose[1][3])


def assert_shifted(answer, by_mm):
    assert shift_mm(answer) == by_mm
    assert answer.elapsed.total_seconds() < at_this_load(AT_ONCE_S)


def assert_unavailable(answer):
    assert (answer.status_code, answer.json()["reason"]) == (503, "DATABASE_UNAVAILABLE"), answer.text


@pytest.mark.parametrize("silent", [False, pytest.param(True, marks=pytest.mark.long)], ids=["stopped", "silent"])
def test_frames_go_on_by_a_registration_that_was_read_while_the_database_is_away(
    start_service, postgres, tmp_path, pose_body, silent
):
    shared = {"artifact_folder": tmp_path, "database_url": postgres.create_database()}
    service, other = (start_service(**shared) for _ in range(2))
    take_away, give_back = (postgres.pause, postgres.resume) if silent else (postgres.stop, postgres.start)
    with (
        httpx.Client(base_url=service.http, timeout=TOO_LATE_S) as http,
        httpx.Client(base_url=other.http, timeout=TOO_LATE_S) as elsewhere,
    ):
        put(http, 3.0)
        assert_shifted(render(elsewhere, pose_body, "robot"), 3.0)
        put(http, 4.0)
        database = JobDatabase(tmp_path, shared["database_url"])
        add_unreadable(database)  # an answer does not tell whether it is from the copy yet
        database.close()
        wait_until(lambda: other.logged(UNREADABLE))
        take_away()
        try:
            for _ in range(2):
                for one in (http, elsewhere):
                    assert_shifted(render(one, pose_body, "robot"), 4.0)
                assert_unavailable(http.get(PATH))  # is told from the database alone
            assert_unavailable(render(http, pose_body, "another"))
        finally:
            give_back()
        wait_until(lambda: http.get(PATH).status_code == 200)
        put(http, 5.0)
        assert_shifted(render(http, pose_body, "robot"), 5.0)
        wait_until(lambda: shift_mm(render(elsewhere, pose_body, "robot")) == 5.0)
        assert http.delete(PATH).status_code == 204
        assert render(http, pose_body, "robot").status_code == 404
        wait_until(lambda: render(elsewhere, pose_body, "robot").status_code == 404)


UNREADABLE = "the registration 'odd' cannot be read"


def add_unreadable(database):
    """A registration that is told in the log whenever a service copies them all."""
    with database.engine.begin() as connection:
        row = {"name": "odd", "scene": "demo", "owner": "local:", "changed_at_s": 0.0, "document": '{"later": 1}'}
        connection.execute(sa.insert(REGISTRATIONS).values(row))
        tell_change(connection)


def test_one_that_cannot_be_read_hinders_no_other(start_service, tmp_path, pose_body):
    service = start_service(artifact_folder=tmp_path)
    with httpx.Client(base_url=service.http, timeout=TOO_LATE_S) as http:
        put(http, 3.0)
        database = JobDatabase(tmp_path, None)
        add_unreadable(database)
        database.close()
        wait_until(lambda: service.logged(UNREADABLE))
        assert [one["name"] for one in http.get("/v1/registrations").json()["registrations"]] == ["robot"]
        assert_shifted(render(http, pose_body, "robot"), 3.0)


UNUSED = None


def kept(changed_at):
    facts = {"name": "robot", "scene": "demo", "changed_at": changed_at}
    return store.Kept(NamedRegistration(base_to_scene=cast(Any, np.eye(4).tolist()), **facts), None)


@pytest.mark.parametrize("changed", [kept("2026-01-02T00:00:00Z"), None], ids=["replaced", "deleted"])
def test_a_copy_is_read_again_where_the_service_changed_it_meanwhile(changed, monkeypatch):
    registrations = Registrations(UNUSED, UNUSED, UNUSED)
    before, after = {"robot": kept("2026-01-01T00:00:00Z")}, {} if changed is None else {"robot": changed}
    reads = []

    def read(connection):
        reads.append(after if reads else before)
        if len(reads) == 1:
            registrations._change_copy("robot", changed)  # after the rows were read, before they are copied
        return reads[-1]

    monkeypatch.setattr(store, "read_registrations", read)
    registrations.read(UNUSED)
    assert reads == [before, after]
    assert registrations._copy == after
