"""RenderPool against direct renders, in real worker processes."""

import asyncio
import gc
import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from ultragray import ConvexProbe
from ultragray.errors import BackendUnavailable, FrameTooCostly, InvalidArgument, SceneFileInvalid
from ultragray.files import file_sha256
from ultragray.rendering.settings import Encoding
from ultragray_workers import PoolConfig, RenderPool, SceneStore
from ultragray_workers.errors import Draining, NotReady, SceneNotFound, SceneTooLarge
from ultragray_workers.pool.messages import Place

from ..asking import asking


@pytest.mark.usefixtures("batches_of_any_length")
def test_results_equal_a_direct_render(run, open_pool, random_poses, expect_frames, scene_folder):
    convex = ConvexProbe(opening_angle_deg=60.0, near_mm=5.0, far_mm=40.0)
    one_frame = asking("a", random_poses(1))
    many = asking("b", random_poses(11), probe=convex, height=20, width=17, outputs=("coverage", "bmode"))

    def encoded(request, encoding):
        return replace(request, settings=replace(request.settings, encoding=encoding))

    requests = [encoded(one_frame, encoding) for encoding in Encoding]
    requests += [encoded(many, encoding) for encoding in Encoding if not encoding.is_image_file]

    async def main(max_batch_poses):
        async with open_pool(max_batch_poses=max_batch_poses) as pool:
            return [await pool.render(request) for request in requests]

    in_one_go, in_parts = run(main(32)), run(main(2))
    for request, whole, result in zip(requests, in_one_go, in_parts, strict=True):
        assert (whole.batch_size, result.batch_size) == ((1, 1) if len(request.poses) == 1 else (11, 2))
        assert request.settings.encoding is Encoding.NPZ or whole.data == result.data
        expect_frames(request, whole)
        expect_frames(request, result)
        assert result.scene_sha256 == file_sha256(scene_folder / f"{request.scene}.ugr")
        assert result.renderer.startswith("ultragray/")
        assert result.settings == request.settings
        np.testing.assert_array_equal(result.poses, request.poses)
        assert min(result.queue_ms, result.render_ms, result.encode_ms) > 0


async def test_image_files_hold_the_frame_of_one_pose(open_pool, random_poses):
    async with open_pool() as pool:
        with pytest.raises(InvalidArgument, match="png holds the frame of one pose, got 2"):
            await pool.render(asking("a", random_poses(2), encoding=Encoding.PNG))
        with pytest.raises(InvalidArgument, match="at least one pose"):
            await pool.render(asking("a", np.zeros((0, 4, 4))))


@pytest.mark.usefixtures("batches_of_any_length")
async def test_waiting_requests_of_one_kind_are_rendered_together(open_pool, random_poses, expect_frames, until):
    alike = [asking("a", random_poses(1, seed=seed)) for seed in range(5)]
    other = asking("a", random_poses(1), height=10)
    async with open_pool() as pool:
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        first = asyncio.create_task(pool.render(asking("b", random_poses(1))))
        await until(lambda: pool.statistics().busy == 1)
        tasks = [asyncio.create_task(pool.render(request)) for request in [*alike, other]]
        await until(lambda: pool.statistics().waiting_frames == 6)
        os.kill(worker, signal.SIGCONT)
        first, results = await first, [await task for task in tasks]
    assert first.batch_size == 1
    assert [result.batch_size for result in results] == [5, 5, 5, 5, 5, 1]
    for request, result in zip([*alike, other], results, strict=True):
        expect_frames(request, result)


async def test_a_cancelled_request_leaves_the_queue(open_pool, random_poses, until):
    rendered = []
    async with open_pool() as pool:
        pool.on_rendered = lambda result: rendered.append(result.scene)
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        tasks = [asyncio.create_task(pool.render(asking("a", random_poses(1))))]
        await until(lambda: pool.statistics().busy == 1)
        tasks.append(asyncio.create_task(pool.render(asking("b", random_poses(3)))))
        await until(lambda: pool.statistics().waiting_frames == 3)
        for task in tasks:  # one under way, one waiting
            task.cancel()
        await asyncio.wait(tasks)
        assert all(task.cancelled() for task in tasks)
        assert pool.statistics().waiting_frames == 0
        os.kill(worker, signal.SIGCONT)
        await pool.render(asking("a", random_poses(1)))
        assert "b" not in pool.loaded()
    assert rendered == ["a"]


async def test_newer_poses_take_the_place_of_those_that_wait(open_pool, random_poses, expect_frames):
    older, newer = random_poses(1, seed=1), random_poses(1, seed=2)
    async with open_pool() as pool:
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        with pool.ask(asking("b", older)) as begun, pool.ask(asking("a", older)) as waits:
            assert not begun.give_to(newer, None)
            assert waits.give_to(newer, None)
            assert pool.statistics().waiting_frames == 1
            os.kill(worker, signal.SIGCONT)
            for turn, poses in ((begun, older), (waits, newer)):
                result = await pool.frames(turn)
                np.testing.assert_array_equal(result.poses, poses)
                expect_frames(turn.request, result)
            assert not waits.give_to(older, None)


async def test_frames_that_nobody_takes_keep_no_pool_from_closing(open_pool, random_poses, until, expect_frames):
    async with open_pool() as pool:
        turn = pool.ask(asking("a", random_poses(1)))
        await until(lambda: not pool.statistics().busy)
        await pool.drain(3600)
    expect_frames(turn.request, await pool.frames(turn))
    turn.close()


@pytest.mark.parametrize("seconds", [60.0, 0.01], ids=["waiting", "failed"])
async def test_a_turn_that_is_closed_is_not_rendered_and_its_failure_is_nobodys_loss(
    open_pool, random_poses, until, seconds
):
    complaints = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: complaints.append(context))
    async with open_pool() as pool:
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        with pool.ask(asking("a", random_poses(1))):
            deadline = time.monotonic() + seconds
            with pool.ask(asking("b", random_poses(1), deadline=deadline)):
                await until(lambda: pool.statistics().waiting_frames == (seconds > 1.0))
        assert pool.statistics().waiting_frames == 0
        os.kill(worker, signal.SIGCONT)
        await pool.render(asking("a", random_poses(1)))
        assert pool.loaded().keys() == {"a"}
    gc.collect()
    assert complaints == []


class OneRoom:
    """A caller's memory with room for one frame."""

    def __init__(self, offset=4096):
        self.descriptor, self.offset = os.memfd_create("caller"), offset
        self.is_free = True

    def lend(self, size):
        if not self.is_free:
            return None
        self.is_free = False
        return Place(7, size, self.descriptor, self.offset)

    def take_back(self, place):
        assert place.slot == 7
        self.is_free = True

    @property
    def written(self):
        return os.pread(self.descriptor, 2**20, 0)


@pytest.fixture
def room():
    made = OneRoom()
    yield made
    os.close(made.descriptor)


async def test_frames_are_rendered_into_the_memory_of_their_caller(open_pool, random_poses, room):
    request = asking("a", random_poses(5), encoding=Encoding.FLOAT32, outputs=("bmode", "echo"))
    into = replace(request, destination=room)
    async with open_pool(max_batch_poses=2) as pool:
        expected, there, beside = [await pool.render(one) for one in (request, into, into)]
        floats, room.is_free = room.written, True
        image = await pool.render(asking("a", random_poses(1), encoding=Encoding.PNG, destination=room))
    assert (there.place.slot, there.place.size, there.data) == (7, len(expected.data), b"")
    assert floats == bytes(room.offset) + expected.data
    assert (beside.place, beside.data) == (None, expected.data)
    assert image.data == b""
    assert room.written[room.offset :][: image.place.size].startswith(b"\x89PNG")


@pytest.mark.parametrize("sign", [signal.SIGCONT, signal.SIGKILL])
async def test_the_room_of_a_frame_that_nobody_takes_is_free_when_its_process_is_done(
    open_pool, random_poses, room, until, sign
):
    async with open_pool() as pool:
        await pool.load("a")
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        task = asyncio.create_task(pool.render(asking("a", random_poses(1), destination=room)))
        await until(lambda: pool.statistics().busy == 1)
        task.cancel()
        await asyncio.wait([task])
        assert not room.is_free  # the process may still write there
        os.kill(worker, sign)
        await until(lambda: room.is_free)


async def test_the_room_of_a_refused_frame_is_free_again(open_pool, random_poses, room):
    async with open_pool(max_footprint_pixels=1) as pool:
        with pytest.raises(FrameTooCostly):
            await pool.render(asking("a", random_poses(1), destination=room))
        assert room.is_free


async def test_load_and_unload_reach_every_process(open_pool):
    async with open_pool(processes=2) as pool:
        assert pool.loaded() == {}
        await pool.load("a")
        assert pool.loaded() == {"a": 2}
        await pool.unload("a")
        await pool.unload("a")  # nothing to do, no error
        assert pool.loaded() == {}
        for call in (pool.load, pool.unload):
            with pytest.raises(SceneNotFound, match="known scenes: a, b"):
                await call("missing")
        with pytest.raises(SceneNotFound):
            await pool.render(asking("../a", np.eye(4)[None]))


async def test_a_scene_beyond_the_memory_budget_is_refused_and_the_worker_lives(open_pool):
    async with open_pool(memory_budget_bytes=100) as pool:
        for call in (pool.load("a"), pool.render(asking("a", np.eye(4)[None]))):
            with pytest.raises(SceneTooLarge, match="memory budget"):
                await call
        assert pool.statistics().restarts_total == 0


async def test_a_replaced_file_is_rendered_as_it_is_now(open_pool, scene_folder, random_poses, expect_frames):
    request = asking("a", random_poses(1))
    async with open_pool() as pool:
        before = await pool.render(request)
        (scene_folder / "b.ugr").replace(scene_folder / "a.ugr")
        before, after = before, await pool.render(request)
    assert before.scene_sha256 != after.scene_sha256 == file_sha256(scene_folder / "a.ugr")
    expect_frames(request, after)


async def test_an_invalid_file_is_an_error_and_no_more(open_pool, scene_folder, random_poses):
    data = bytearray((scene_folder / "a.ugr").read_bytes())
    (scene_folder / "truncated.ugr").write_bytes(data[:-100])
    header_bytes = 8 + int.from_bytes(data[:8], "little")
    data[header_bytes:] = b"\xff" * (len(data) - header_bytes)  # a valid header over NaN: only the worker sees it
    (scene_folder / "nan.ugr").write_bytes(data)
    async with open_pool() as pool:
        for name in ("truncated", "nan"):
            with pytest.raises(SceneFileInvalid, match=name):
                await pool.render(asking(name, random_poses(1)))
        await pool.render(asking("a", random_poses(1)))
        assert pool.statistics().restarts_total == 0


async def test_draining_answers_what_was_asked_and_refuses_more(open_pool, random_poses, until):
    async with open_pool() as pool:
        assert pool.ready
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        tasks = [asyncio.create_task(pool.render(asking("a", random_poses(1)))) for _ in range(3)]
        await until(lambda: pool.statistics().waiting_frames == 2)
        await pool.drain(timeout_s=0.05)  # too short
        assert not any(task.done() for task in tasks)
        assert not pool.ready
        with pytest.raises(Draining):
            await pool.render(asking("a", random_poses(1)))
        os.kill(worker, signal.SIGCONT)
        await pool.drain(timeout_s=300.0)
        assert all(task.done() for task in tasks)
        assert len([await task for task in tasks]) == 3


async def test_closing_fails_what_is_open_and_leaves_no_process(open_pool, random_poses, until, processes):
    async with open_pool(processes=2) as pool:
        await until(lambda: sorted(processes().values()) == ["ug-template"] * 2 + ["ug-worker"] * 2)
        for worker in pool.statistics().pids:
            os.kill(worker, signal.SIGSTOP)  # closing must not depend on their help
        tasks = [asyncio.create_task(pool.render(asking("a", random_poses(1)))) for _ in range(3)]
        await until(lambda: pool.statistics().busy == 2)
        await pool.close()
        for task in tasks:
            with pytest.raises(Draining):
                await task
        assert processes() == {}


async def test_a_pool_that_has_not_started_is_not_ready(scene_folder, random_poses):
    pool = RenderPool(SceneStore(scene_folder), PoolConfig())
    assert not pool.ready
    with pytest.raises(NotReady):
        await pool.render(asking("a", random_poses(1)))
    await pool.close()


async def test_an_unknown_backend_fails_the_start(scene_folder, processes):
    with pytest.raises(BackendUnavailable, match="nonsense"):
        await RenderPool(SceneStore(scene_folder), PoolConfig(backend="nonsense")).start()
    assert processes() == {}


async def test_a_start_that_is_cancelled_leaves_no_process(cold_templates, scene_folder, processes, until):
    start = asyncio.create_task(RenderPool(SceneStore(scene_folder), PoolConfig()).start())
    await until(lambda: processes() != {})
    start.cancel()
    await asyncio.wait([start])
    assert processes() == {}


@pytest.mark.parametrize("settings", [{"processes": -1}, {"max_batch_poses": 1000}, {"queue_limit_frames": 0}])
def test_impossible_sizes_are_refused(settings):
    with pytest.raises(InvalidArgument, match=next(iter(settings))):
        PoolConfig(**settings)


def test_it_works_on_uvloop(open_pool, random_poses, expect_frames):
    uvloop = pytest.importorskip("uvloop")
    request = asking("a", random_poses(3))

    async def main():
        async with open_pool() as pool:
            return await pool.render(request)

    loop = uvloop.new_event_loop()
    try:
        result = loop.run_until_complete(main())
        loop.run_until_complete(loop.shutdown_default_executor())
    finally:
        loop.close()
    expect_frames(request, result)
