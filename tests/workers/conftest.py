"""Scenes in a folder, pools over them, and a look at which processes there are."""

import asyncio
import contextlib
import io
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ultragray import GaussianScene, render
from ultragray.rendering.settings import Encoding
from ultragray.scene.confidence import FIGURES
from ultragray_workers import PoolConfig, RenderPool, SceneStore
from ultragray_workers.pool import processes as launcher
from ultragray_workers.pool import waiting
from ultragray_workers.pool.messages import Priority

from ..waiting import Deadline, wait_until
from ..warm import WARM, pool_processes, start_template
from .asking import HEIGHT, PROBE, WIDTH

TIME_LIMIT_S = 600.0


@pytest.fixture
def batches_of_any_length(monkeypatch):
    """However long others wait for them."""
    monkeypatch.setattr(waiting, "_LONGEST_BATCH_S", dict.fromkeys(Priority, 60.0))


@pytest.fixture(autouse=True)
def warm_templates(monkeypatch):
    """Pools of this process have their templates forked, but for tests that ask for `cold_templates`."""
    monkeypatch.setattr(launcher, "start_template", lambda channel: start_template(WARM.path(), channel))


_START_COLD = launcher.start_template


@pytest.fixture
def cold_templates(warm_templates, monkeypatch):
    """Pools start their templates as they do where there are no tests."""
    monkeypatch.setattr(launcher, "start_template", _START_COLD)


@pytest.fixture
def scene_folder(tmp_path, random_scene):
    """Scenes `a` and `b`, which look different, trained with frames of 24x32."""
    info = {"probe": PROBE, "image_height": HEIGHT, "image_width": WIDTH}
    random_scene(50, seed=1, info=info).save(tmp_path / "a.ugr")
    random_scene(50, seed=2, info=info).save(tmp_path / "b.ugr")
    return tmp_path


@pytest.fixture
def open_pool(scene_folder):
    @contextlib.asynccontextmanager
    async def open_(**settings):
        usual = {"threads_per_process": 1, "worker_grace_s": 600.0}  # others may keep the machine busy
        pool = RenderPool(SceneStore(scene_folder), PoolConfig(**{**usual, **settings}))
        await pool.start()
        try:
            yield pool
        finally:
            await pool.close()

    return open_


@pytest.fixture
def expect_frames(scene_folder):
    """Asserts that a result is what a direct render() of its request gives."""

    def check(request, result):
        scene = GaussianScene.load(scene_folder / f"{request.scene}.ugr")
        asked = request.settings
        direct = render(
            scene, asked.probe, request.poses, height=result.height, width=result.width, outputs=asked.outputs
        )
        floats = np.stack([direct[name].numpy() for name in asked.outputs])  # [O, C, H, W]
        bytes_ = np.round(np.clip(floats, 0, 1) * np.float32(255)).astype(np.uint8)
        if asked.encoding is Encoding.UINT8:
            assert result.data == bytes_.tobytes()
        elif asked.encoding in (Encoding.FLOAT32, Encoding.FLOAT16):
            assert result.data == floats.astype(asked.encoding.pixel_type).tobytes()
        elif asked.encoding is Encoding.PNG:
            assert result.data.startswith(b"\x89PNG")
            decoded = cv2.imdecode(np.frombuffer(result.data, np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(decoded, bytes_[0, 0])
        elif asked.encoding is Encoding.JPEG:
            assert result.data.startswith(b"\xff\xd8")
            decoded = cv2.imdecode(np.frombuffer(result.data, np.uint8), cv2.IMREAD_UNCHANGED)
            assert decoded.shape == bytes_[0, 0].shape
            assert np.abs(decoded.astype(float) - bytes_[0, 0]).mean() < 6
        else:
            with np.load(io.BytesIO(result.data)) as archive:
                assert set(archive) == {*asked.outputs, "poses", *FIGURES, "scene", "scene_sha256", "renderer"}
                for number, name in enumerate(asked.outputs):
                    assert archive[name].dtype == np.float32
                    np.testing.assert_array_equal(archive[name], floats[number])
                np.testing.assert_array_equal(archive["poses"], request.poses)
                assert str(archive["scene"]) == request.scene
                assert str(archive["scene_sha256"]) == result.scene_sha256
                assert str(archive["renderer"]) == result.renderer

    return check


@pytest.fixture
def processes():
    """The workers and templates that this test has started and that live, by process id."""
    return lambda: pool_processes(os.environ["PYTEST_RUN"])


@pytest.fixture(autouse=True)
def nothing_left_behind(processes):
    """Every test must end without processes and open files of its own."""
    descriptors = open_channels_and_memories()
    yield
    wait_until(lambda: not processes(), within_s=20)
    assert open_channels_and_memories() <= descriptors


def open_channels_and_memories():
    links = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            links.append(os.readlink(descriptor))
    return {link for link in links if link.startswith(("socket:", "/memfd:"))}


@pytest.fixture
def until():
    async def wait(condition, timeout_s=300.0):
        """Returns once the condition holds."""
        give_up = Deadline(timeout_s)
        while not condition():
            assert not give_up.passed, "the condition never held"
            await asyncio.sleep(0.005)

    return wait


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Asynchronous tests run in a loop of their own, with a limit: a lost request fails its test and hangs nothing."""
    if not asyncio.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    asyncio.run(asyncio.wait_for(pyfuncitem.obj(**arguments), TIME_LIMIT_S))
    return True


@pytest.fixture
def run():
    """asyncio.run with a limit, so that a lost request fails its test instead of hanging it."""

    def run_(coroutine):
        return asyncio.run(asyncio.wait_for(coroutine, TIME_LIMIT_S))

    return run_
