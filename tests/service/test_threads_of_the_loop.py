"""Long work keeps nobody waiting who needs a thread of the event loop for a moment."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from ultragray_service.access.principals import LOCAL, act_as
from ultragray_service.core import scenes as catalog
from ultragray_service.core import uploads as scene_imports
from ultragray_service.core.threads import HelperProcesses, in_own_thread
from ultragray_service.settings import load_settings
from ultragray_service.wiring import make_service
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.storage import local


@pytest.fixture
def blocked():
    """Until it is set, the work lasts."""
    event = threading.Event()
    yield event
    event.set()


async def body():
    yield b"bytes"


async def receive(service):
    async with service.imports.receive("sent", body()):
        pass


async def publish(service):
    async with service.imports.receive("sent", body()) as received:
        await service.imports.accept(received, "sent", private=False)


async def points(service):
    await service.catalog.points("demo", 10, None)


LONG = {
    "the sync of an import": (scene_imports, "sync", receive),
    "a name asked of the database": (JobStore, "makes_scene", receive),
    "the copy of an import": (local, "link_or_copy", publish),
    "points of a scene": (catalog, "point_message", points),
}


@pytest.mark.parametrize("name", LONG)
def test_long_work_leaves_the_threads_of_the_loop(name, tmp_path, demo_scene, blocked, monkeypatch):
    owner, function, begin = LONG[name]
    begun = threading.Event()

    def wait(*_):
        begun.set()
        blocked.wait(600)

    async def checked(*_, **__): ...

    monkeypatch.setattr(owner, function, wait)
    monkeypatch.setattr(HelperProcesses, "run", checked)
    monkeypatch.setattr(scene_imports, "read_header", lambda _: None)
    demo_scene.save(tmp_path / "demo.ugr")

    async def main():
        act_as(LOCAL, address="127.0.0.1", connection="test")
        service = make_service(load_settings(data_folder=tmp_path))
        await service.jobs.open()
        service.owners.open(service.jobs.database.engine, service.jobs.threads.executor)
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
        task = asyncio.ensure_future(begin(service))
        while not begun.is_set():
            assert not task.done(), task
            await asyncio.sleep(0.01)
        await asyncio.wait_for(asyncio.to_thread(int), 60)
        assert not task.done()
        blocked.set()
        await asyncio.wait({task})
        await service.jobs.close()

    asyncio.run(main())


async def test_many_may_wait_and_none_keeps_the_loop_from_ending(blocked):
    waiting = [asyncio.ensure_future(in_own_thread(blocked.wait)) for _ in range(50)]
    assert await in_own_thread(lambda: 7) == 7
    assert not any(task.done() for task in waiting)
