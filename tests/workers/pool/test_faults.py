"""Processes that die: nothing is lost, nothing is wrong, nothing is left."""

import asyncio
import os
import signal
import subprocess
import sys

import pytest

from ultragray.rendering.settings import Encoding
from ultragray_workers import Priority

from ..asking import asking

KILLS = int(os.environ.get("ULTRAGRAY_FAULT_SECONDS", "5"))


@pytest.mark.parametrize("priority", list(Priority))
async def test_a_worker_killed_with_work_is_replaced_and_the_work_done_again(
    open_pool, random_poses, expect_frames, until, priority
):
    requests = [
        asking("a", random_poses(1, seed=1), priority=priority),
        asking("a", random_poses(7, seed=2), priority=priority, encoding=Encoding.NPZ),
        asking("b", random_poses(1, seed=3), priority=priority, encoding=Encoding.PNG),
    ]
    async with open_pool(max_batch_poses=2) as pool:
        (worker,) = pool.statistics().pids
        os.kill(worker, signal.SIGSTOP)  # so that it surely dies with work in its hands
        tasks = [asyncio.create_task(pool.render(request)) for request in requests]
        await until(lambda: pool.statistics().busy == 1)
        os.kill(worker, signal.SIGKILL)
        results = await asyncio.gather(*tasks)
        assert pool.statistics().restarts_total == 1
        assert pool.statistics().pids != (worker,)
        found = results
    for request, result in zip(requests, found, strict=True):
        expect_frames(request, result)


async def test_a_worker_killed_in_the_middle_of_a_frame(open_pool, random_poses, expect_frames, until):
    request = asking("a", random_poses(2), height=400, width=400)  # a second or so for the reference
    async with open_pool(backend="reference") as pool:
        await pool.load("a")
        task = asyncio.create_task(pool.render(request))
        await until(lambda: pool.statistics().busy == 1)
        await asyncio.sleep(0.03)
        os.kill(pool.statistics().pids[0], signal.SIGKILL)
        result = await task
        await until(lambda: pool.statistics().restarts_total == 1)
    assert len(result.data) == 2 * 400 * 400
    assert result.renderer.endswith("reference")


@pytest.mark.long
async def test_killed_templates_are_replaced(cold_templates, open_pool, random_poses, processes, until):
    async with open_pool() as pool:
        for wanted in (1, 2):  # one template, then both at once
            await until(lambda: list(processes().values()).count("ug-template") == 2)
            templates = [pid for pid, name in processes().items() if name == "ug-template"]
            threads = [len(os.listdir(f"/proc/{pid}/task")) for pid in templates]
            assert threads == [1, 1]  # or forking them would not be safe
            for pid in templates[:wanted]:
                os.kill(pid, signal.SIGKILL)
            os.kill(pool.statistics().pids[0], signal.SIGKILL)
            await pool.render(asking("a", random_poses(1)))
        assert pool.statistics().restarts_total == 2


def test_no_process_outlives_the_service(tmp_path):
    program = (
        "import asyncio, pathlib, sys\n"
        "from ultragray_workers import PoolConfig, RenderPool, SceneStore\n"
        "async def main():\n"
        "    pool = RenderPool(SceneStore(pathlib.Path(sys.argv[1])), PoolConfig(processes=2))\n"
        "    await pool.start()\n"
        "    sys.stdout.write('started\\n')\n"
        "    sys.stdout.flush()\n"
        "    await asyncio.sleep(60)\n"
        "asyncio.run(main())\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, env=environment
    ) as service:
        assert service.stdout.readline() == b"started\n"
        service.kill()
    # the autouse fixture waits for the processes of this group to be gone


@pytest.mark.slow
async def test_load_with_a_worker_killed_every_second(open_pool, random_poses, expect_frames, until):
    singles = [asking("ab"[seed % 2], random_poses(1, seed=seed), height=96, width=96) for seed in range(6)]
    sweep = asking("a", random_poses(40), height=96, width=96, encoding=Encoding.NPZ)
    batch = asking("b", random_poses(8), height=96, width=96, priority=Priority.BATCH)
    answers = {request: [] for request in [*singles, sweep, batch]}
    is_over = False

    async def client(pool, request):
        while not is_over:
            answers[request].append(await pool.render(request))

    async with open_pool(processes=2) as pool:
        clients = [asyncio.create_task(client(pool, request)) for request in answers]
        for killed in range(KILLS):
            await asyncio.sleep(1.0)
            await until(lambda: pool.statistics().pids)
            pids = pool.statistics().pids
            os.kill(pids[killed % len(pids)], signal.SIGKILL)
            await until(lambda killed=killed: pool.statistics().restarts_total > killed)
        await until(lambda: all(answers.values()))
        is_over = True
        await asyncio.gather(*clients)
        assert pool.statistics().waiting_frames == 0
    for request, results in answers.items():
        expect_frames(request, results[0])
        assert {result.data for result in results} == {results[0].data}
