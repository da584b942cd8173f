"""What would keep everybody waiting: frames that cost too much or are past their deadline, processes that hang."""

import asyncio
import os
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, SceneInfo
from ultragray.errors import FrameTooCostly, RenderFailed
from ultragray.phantom.demo import DEMO_FILE
from ultragray.rendering.frames import footprint_pixels
from ultragray_workers import PoolConfig, Priority
from ultragray_workers.errors import DeadlineExceeded
from ultragray_workers.pool import dispatcher, processes

from ..asking import HEIGHT, PROBE, WIDTH, asking

POSE = np.eye(4)[None]
HOUR_S = 3600.0


def save_wide(folder, name, *, count, log_scale):
    """A scene whose Gaussians, before the probe, measure e^log_scale cm."""
    random = torch.Generator().manual_seed(0)
    splats = {
        "means": torch.rand(count, 3, generator=random) + torch.tensor([0.0, 0.0, 1.0]),
        "scales": torch.full((count, 3), float(log_scale)),
        "quats": torch.ones(count, 4),
        "transmittances": torch.zeros(count),
        "sh0": torch.zeros(count, 1, 1),
    }
    info = SceneInfo(probe=PROBE, image_height=HEIGHT, image_width=WIDTH)
    GaussianScene.from_splats(splats, info=info).save(folder / f"{name}.ugr")


@pytest.fixture
def costly_folder(scene_folder):
    """`minutes`: a frame of 512x512 pixels takes some; `hostile`: Gaussians of e^20 cm."""
    save_wide(scene_folder, "minutes", count=100_000, log_scale=2)
    save_wide(scene_folder, "hostile", count=20_000, log_scale=20)
    return scene_folder


def large(scene, **options):
    return asking(scene, POSE, height=512, width=512, **options)


@pytest.mark.parametrize(("side", "times"), [(512, 50), (2048, 5)])
def test_usual_scenes_are_far_below_the_default_limit(random_scene, random_poses, side, times):
    """The demo scene, and one of 500,000 Gaussians in a block of 5 cm."""
    limit = PoolConfig().max_footprint_pixels
    demo = GaussianScene.load(DEMO_FILE)
    costs = footprint_pixels(demo, None, demo.training_poses[::20], height=side, width=side)
    large = random_scene(500_000, sigma_cm=(0.025, 0.035), extent_cm=(5.0, 5.0, 5.0), centre_cm=(0.0, 0.0, 2.5))
    costs += footprint_pixels(large, PROBE, random_poses(3), height=side, width=side)
    assert max(costs) * times < limit


async def test_a_hostile_scene_is_refused_and_the_next_request_served(open_pool, costly_folder, random_poses):
    async with open_pool() as pool:
        with pytest.raises(FrameTooCostly, match="a frame may cost 2,147 million") as refused:
            await pool.render(large("hostile"))
        assert refused.value.field == "pose"
        with pytest.raises(FrameTooCostly) as refused:
            await pool.render(asking("hostile", np.tile(POSE, (3, 1, 1)), height=512, width=512))
        assert refused.value.field == "poses[0]"
        await pool.render(asking("a", random_poses(1)))
        assert pool.statistics().restarts_total == pool.statistics().kills_total == 0


@pytest.mark.usefixtures("batches_of_any_length")
async def test_company_of_a_frame_that_is_too_costly_is_rendered(open_pool, costly_folder, until):
    async with open_pool() as pool:
        (worker,) = pool.statistics().pids
        await pool.load("minutes")
        os.kill(worker, signal.SIGSTOP)
        away = POSE.copy()
        away[0, 2, 3] = 1e4  # nothing is before the probe
        first = asyncio.create_task(pool.render(asking("a", POSE)))
        await until(lambda: pool.statistics().busy == 1)
        tasks = [
            asyncio.create_task(pool.render(asking("minutes", poses, height=512, width=512))) for poses in (POSE, away)
        ]
        await until(lambda: pool.statistics().waiting_frames == 2)
        os.kill(worker, signal.SIGCONT)
        await first
        refused, rendered = await asyncio.gather(*tasks, return_exceptions=True)
        assert isinstance(refused, FrameTooCostly)
        assert rendered.batch_size == 2


async def test_a_frame_past_its_deadline_is_given_up_and_frees_the_worker(open_pool, costly_folder, random_poses):
    async with open_pool(max_footprint_pixels=2**62) as pool:
        await asyncio.gather(pool.load("minutes"), pool.load("a"))
        with pytest.raises(DeadlineExceeded):
            await pool.render(large("minutes", deadline=time.monotonic() + 0.5))
        await pool.render(asking("a", random_poses(1), deadline=time.monotonic() + HOUR_S))
        assert pool.statistics().restarts_total == pool.statistics().kills_total == 0


async def test_a_frame_whose_client_has_gone_is_given_up(open_pool, costly_folder, random_poses, until):
    async with open_pool(max_footprint_pixels=2**62) as pool:
        await asyncio.gather(pool.load("minutes"), pool.load("a"))
        task = asyncio.create_task(pool.render(large("minutes")))
        await until(lambda: pool.statistics().busy == 1)
        await asyncio.sleep(0.2)  # into the frame
        task.cancel()
        await until(lambda: pool.statistics().busy == 0)
        await pool.render(asking("a", random_poses(1)))
        assert pool.statistics().restarts_total == pool.statistics().kills_total == 0


@pytest.fixture
def until_killed(monkeypatch):
    """Lets hours pass for whoever watches the workers, until so many have been killed."""

    async def wait(pool, count):
        passed_s = 0.0
        while pool.statistics().kills_total < count:
            passed_s += HOUR_S
            ahead = SimpleNamespace(monotonic=lambda passed_s=passed_s: time.monotonic() + passed_s)
            monkeypatch.setattr(processes, "time", ahead)
            await asyncio.sleep(0.05)

    return wait


@pytest.mark.parametrize("priority", list(Priority))
async def test_a_stopped_worker_is_killed_and_its_work_done_again(
    open_pool, random_poses, expect_frames, priority, until_killed
):
    request = asking("a", random_poses(3), priority=priority, deadline=time.monotonic() + 99 * HOUR_S)
    async with open_pool() as pool:
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        rendering = asyncio.create_task(pool.render(request))
        await until_killed(pool, 1)
        found = await rendering  # long before its deadline: the task was not even taken up
        statistics = pool.statistics()
        assert (statistics.kills_total, statistics.restarts_total) == (1, 0)
        assert statistics.pids != (worker,)
    expect_frames(request, found)


async def test_a_worker_stopped_in_the_middle_of_a_frame_is_killed_after_its_deadline(
    open_pool, costly_folder, random_poses, until, until_killed
):
    async with open_pool(max_footprint_pixels=2**62) as pool:
        await pool.load("minutes")
        (worker,) = pool.statistics().pids
        late = asyncio.create_task(pool.render(large("minutes", deadline=time.monotonic() + 3.0)))
        await until(lambda: pool.statistics().busy == 1)
        await asyncio.sleep(0.1)  # into the frame
        os.kill(worker, signal.SIGSTOP)
        next_one = asyncio.create_task(pool.render(asking("a", random_poses(1))))
        with pytest.raises(DeadlineExceeded):
            await late
        await until_killed(pool, 1)
        await next_one
        assert pool.statistics().kills_total == 1


async def test_a_request_with_which_two_workers_hang_fails_alone(open_pool, costly_folder, random_poses, until_killed):
    async with open_pool(max_footprint_pixels=2**62) as pool:
        rendering = asyncio.create_task(pool.render(large("minutes")))
        await until_killed(pool, 2)
        with pytest.raises(RenderFailed, match="2 worker processes hung"):
            await rendering  # without a deadline: silence is all there is to go by
        await pool.render(asking("b", random_poses(1)))
        assert (pool.statistics().kills_total, pool.statistics().restarts_total) == (2, 0)


async def test_a_request_that_kills_every_worker_fails_alone(open_pool, costly_folder, random_poses, until):
    async with open_pool(max_footprint_pixels=2**62) as pool:
        task = asyncio.create_task(pool.render(large("minutes")))
        for deaths in range(1, 6):
            await until(lambda: pool.statistics().busy == 1)
            os.kill(pool.statistics().pids[0], signal.SIGKILL)
            await until(lambda deaths=deaths: pool.statistics().restarts_total == deaths)
        with pytest.raises(RenderFailed, match="died 5 times"):
            await task
        await pool.render(asking("b", random_poses(1)))


async def test_a_load_that_hangs_is_ended(open_pool, until_killed):
    async with open_pool() as pool:
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)
        loading = asyncio.create_task(pool.load("a"))
        await until_killed(pool, 1)
        await loading
        assert pool.statistics().kills_total == 1
        assert pool.loaded() == {"a": 1}


async def test_a_pool_whose_workers_are_stuck_is_not_ready(open_pool, random_poses, until, monkeypatch):
    monkeypatch.setattr("ultragray_workers.pool.dispatcher.STUCK_AFTER_S", 0.5)
    assert dispatcher.STUCK_AFTER_S <= 10.0
    async with open_pool() as pool:
        (worker,) = pool.statistics().pids
        assert pool.ready
        os.kill(worker, signal.SIGSTOP)
        assert pool.ready  # nobody asks for anything
        task = asyncio.create_task(pool.render(asking("a", random_poses(1))))
        await until(lambda: not pool.ready)
        assert pool.statistics().stuck == 1
        os.kill(worker, signal.SIGCONT)
        await task
        assert pool.ready
