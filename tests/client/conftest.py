"""Both clients against a real service: what a test does with `client` it does with either."""

import asyncio
import inspect
import threading

import pytest

from ultragray_client import AsyncClient, AsyncFrameStream, Client
from ultragray_client.transport import Group

from ..service.conftest import data_folder, demo_scene, start_service, start_shared_service

__all__ = ["data_folder", "demo_scene", "start_service", "start_shared_service"]
from .proxy import Proxy

KEY = "0123456789abcdef-client"
MAX_POSES = 40
SETTINGS = {"max_poses_per_request": MAX_POSES, "max_image_side": 600, "api_keys": KEY}


def pytest_collection_modifyitems(items):
    """Of uploads, jobs and TLS, `make test` has those of the client for threads: both act on the same descriptions."""
    for item in items:
        if item.path.stem in ("test_client_resources", "test_client_tls") and "[asyncio" in item.name:
            item.add_marker(pytest.mark.long)


class Blocking:
    """An object for asyncio as if it were an ordinary one: awaits, iterates and enters for the caller."""

    def __init__(self, target, loop):
        self._target, self._loop = target, loop

    def __getattr__(self, name):
        return self._as_ordinary(getattr(self._target, name))

    def __call__(self, *arguments, **keywords):
        async def call():
            return self._target(*arguments, **keywords)

        return self._as_ordinary(self._run(call()))

    def __iter__(self):
        return self

    def __next__(self):
        try:
            return self._run(anext(self._target))
        except StopAsyncIteration:
            raise StopIteration from None

    def __enter__(self):
        return self._as_ordinary(self._run(self._target.__aenter__()))

    def __exit__(self, *error):
        self._run(self._target.__aexit__(*error))

    def _run(self, awaitable):
        async def wait():
            return await awaitable

        return asyncio.run_coroutine_threadsafe(wait(), self._loop).result(60)

    def _as_ordinary(self, value):
        if inspect.iscoroutine(value):
            return self._as_ordinary(self._run(value))
        own = isinstance(value, (Group, AsyncFrameStream)) or inspect.isasyncgen(value)
        return Blocking(value, self._loop) if own or inspect.ismethod(value) else value


@pytest.fixture(scope="session")
def event_loop_thread():
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield loop
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


@pytest.fixture(scope="session")
def client_service(start_shared_service, tmp_path_factory):
    """It takes few poses at a time."""
    return start_shared_service(artifact_folder=tmp_path_factory.mktemp("artifacts"), **SETTINGS)


@pytest.fixture(scope="module")
def working_service(start_service, tmp_path_factory):
    """The same with a worker for jobs."""
    artifacts = tmp_path_factory.mktemp("artifacts")
    return start_service(artifact_folder=artifacts, embedded_worker=True, training_threads=1, **SETTINGS)


@pytest.fixture(params=["sync", "asyncio"])
def make_client(request, event_loop_thread):
    """Makes clients of either kind, with the arguments of both."""
    made = []

    def make(address, **keywords):
        if request.param == "sync":
            made.append(Client(address, **keywords))
        else:
            made.append(Blocking(AsyncClient, event_loop_thread)(address, **keywords))
        return made[-1]

    yield make
    for client in made:
        client.close()


@pytest.fixture
def client(make_client, client_service):
    return make_client(client_service.grpc, api_key=KEY, timeout_s=300.0)


@pytest.fixture
def proxy(client_service):
    """The way to the service, which a test cuts."""
    proxy = Proxy(client_service.grpc)
    yield proxy
    proxy.close()


@pytest.fixture
def far_client(make_client, proxy):
    """A client that reaches the service by that way."""
    return make_client(proxy.address, api_key=KEY, timeout_s=300.0)
