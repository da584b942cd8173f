"""Processes forked from one that has imported what they need, where a test would else wait for a second of imports.

Run as a program, it is that process: `python warm.py SOCKET RUN MODULE…` imports the modules, then forks for each
client, until the process RUN ends.
A fork begins as the program would after its imports: with the folder, the environment and the files of its request.
Tests about starting itself use real processes.
"""

import asyncio
import atexit
import contextlib
import fcntl
import gc
import importlib
import json
import mmap
import os
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import uuid
import weakref
import zlib
from pathlib import Path
from types import SimpleNamespace

SOURCE_FOLDERS = ("model", "proto", "workers", "service", "client", "studies")
_MAX_REQUEST_BYTES = 2**17
_STANDARD_FILES = 3
_START_TIMEOUT_S = 300.0
_IS_ONE_OF_SEVERAL = "PYTEST_XDIST_WORKER" in os.environ  # the process of the run is the parent of this one


class WarmProcess:
    """A process forked for us, with the methods of subprocess.Popen that are used of one."""

    def __init__(self, pid, connection):
        self.pid = pid
        self.returncode = None
        self._connection = connection  # its end brings the exit code
        self._close = weakref.finalize(self, connection.close)
        self._lock = threading.Lock()  # several threads may wait

    def poll(self):
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def wait(self, timeout=None):
        if self.returncode is None:
            ended = select.poll()
            ended.register(self._connection, select.POLLIN)
            if not ended.poll(None if timeout is None else 1000 * timeout):
                raise subprocess.TimeoutExpired("a warm process", timeout)
            with self._lock:
                if self.returncode is None:
                    told = self._connection.recv(16)
                    self.returncode = int(told) if told else -signal.SIGKILL  # the process that forks ended with it
                    self._close()
        return self.returncode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(signal.SIGTERM)

    def kill(self):
        self.send_signal(signal.SIGKILL)


class WarmHelper(WarmProcess):
    """A process that reads a request and writes an answer, each as a whole."""

    stdin = stdout = stderr = None

    def communicate(self, request):
        with contextlib.suppress(BrokenPipeError), self.stdin:
            self.stdin.write(request)
        self.wait()
        with self.stdout, self.stderr:
            return tuple(file.seek(0) or file.read() for file in (self.stdout, self.stderr))


class WarmServer:
    """Starts the process that forks when it is first asked; the test processes of a run share it."""

    def __init__(self, *modules):
        self._modules = modules
        run = os.environ.get("PYTEST_XDIST_TESTRUNUID") or uuid.uuid4().hex
        tree = zlib.crc32(__file__.encode())  # a test may run those of a copy of the tree
        self._folder = Path(tempfile.gettempdir(), f"ultragray-warm-{run}-{tree:08x}")

    def path(self):
        """Where the process listens."""
        socket_path = self._folder / "socket"
        if not socket_path.exists():
            self._folder.mkdir(mode=0o700, exist_ok=True)
            with (self._folder / "lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)  # until it listens
                if not socket_path.exists():
                    self._start(socket_path)
        return socket_path

    def _start(self, socket_path):
        run_pid = os.getppid() if _IS_ONE_OF_SEVERAL else os.getpid()
        self._process = subprocess.Popen(
            [sys.executable, __file__, socket_path, str(run_pid), *self._modules],
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # what is sent to the group of one test process is not for it
            env={
                **os.environ,
                "PYTEST_RUN": "",  # a fork belongs to the tests that asked for it
                "OMP_NUM_THREADS": "1",
                "OPENBLAS_NUM_THREADS": "1",  # a process with threads must not be forked
                "PYTHONPATH": os.pathsep.join(str(Path(__file__).parents[1] / folder) for folder in SOURCE_FOLDERS),
            },
        )
        end = time.monotonic() + _START_TIMEOUT_S
        while not socket_path.exists():
            assert self._process.poll() is None, "the process that forks others did not start"
            assert time.monotonic() < end, f"the process that forks others is not ready after {_START_TIMEOUT_S} s"
            time.sleep(0.01)


def fork(path, function, arguments, *, environment, folder, files, kind=WarmProcess, **more):
    """Has the process that listens at `path` fork one that calls `function` of this module.

    `files` are descriptors: stdin, stdout, stderr, and more, which the function gets after its `arguments`.
    `end_with`: the signal that it gets when this process ends; `session`: whether it leads one of its own.
    """
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.connect(str(path))
    request = {"function": function, "arguments": arguments, "environment": dict(environment), "folder": str(folder)}
    socket.send_fds(connection, [json.dumps(request | more).encode()], files)
    return kind(int(connection.recv(16)), connection)


WARM = WarmServer(
    "torch",
    "matplotlib.backends.backend_agg",
    "mpl_toolkits.mplot3d",
    "ultragray.datasets.checks",
    "ultragray.datasets.pictures",
    "ultragray_service.__main__",
    "ultragray_service.cli.worker",
    "ultragray_workers.datasets.intake",
    "ultragray_workers.jobs.kinds.render_run",
    "ultragray_workers.jobs.kinds.train_run",
    "ultragray_workers.jobs.worker.run_job",
    "ultragray_workers.jobs.worker.template",
    "ultragray_workers.jobs.worker.worker",
    "ultragray_workers.pool.worker",
    "ultragray_workers.views",
)


def start_template(path, descriptor):
    """As ultragray_workers.pool.processes.start_template."""
    with open(os.devnull, "r+b") as null:
        files = (null.fileno(), 1, 2, descriptor)
        return fork(path, "template", [], environment=os.environ, folder=Path.cwd(), files=files)


def template(descriptor):
    """The template process of a pool."""
    from ultragray_workers.pool.template import main

    main(descriptor)


# What a service looks at now and then, one whose state tests change looks at more often, in seconds. That takes 1.6% of
# a core of one that is idle: those that tests share, which live long, keep their own, as those that start cold.
SHORT_WAITS = {
    "access.audit.WRITE_INTERVAL_S": 0.2,
    "access.credentials.LOOK_INTERVAL_S": 0.2,
    "access.keys.INTERVAL_S": 0.25,
    "access.owners.SPREAD_S": 0.5,  # two of the interval before
    "core.jobs.READ_INTERVAL_S": 0.1,
    "core.jobs.COUNT_INTERVAL_S": 0.5,
    "core.readiness.CHECK_INTERVAL_S": 0.5,
    "core.uploads._POLL_INTERVAL_S": 0.05,
    "tls._POLL_S": 0.2,
}


def service(path):
    """The service, whose processes are forked at `path`."""
    from ultragray_service.__main__ import main
    from ultragray_workers import RenderPool
    from ultragray_workers.pool import processes as launcher

    for place, seconds in json.loads(os.environ["PYTEST_WAITS"]).items():
        module, _, name = place.rpartition(".")
        owner = importlib.import_module(f"ultragray_service.{module}")
        assert isinstance(getattr(owner, name), float), place
        setattr(owner, name, seconds)
    launcher.start_template = lambda descriptor: start_template(path, descriptor)
    if Hold("start").is_wanted:
        RenderPool.start = lambda pool: asyncio.Event().wait()
    work_warmly(path)
    return main()


def warm_subprocess(path):
    """What the product uses of the module subprocess, with processes that are forked at `path`."""
    return SimpleNamespace(
        Popen=lambda command, **options: popen(path, command, **options),
        **{name: getattr(subprocess, name) for name in ("PIPE", "DEVNULL", "TimeoutExpired")},
    )


def work_warmly(path):
    """From now on the helpers, the embedded worker and the jobs that this process starts are forked at `path`."""
    for module in ("service.core.threads", "service.server", "workers.jobs.worker.process"):
        importlib.import_module(f"ultragray_{module}").subprocess = warm_subprocess(path)


def popen(path, command, *, env, stdout=None, stderr=None, pass_fds=(), **_):
    """As subprocess.Popen, for the commands of which the product has three."""
    common = {"environment": env, "folder": Path.cwd(), "session": True}
    if command[1] == "-c":
        module, work = re.findall(r"from (\S+) import (\w+)", command[2])[-1]
        out, err = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115
        reading, writing = os.pipe()
        files = (reading, out.fileno(), err.fileno())
        common |= {"session": False, "end_with": signal.SIGKILL}
        process = fork(path, "helper", [module, work], files=files, kind=WarmHelper, **common)
        os.close(reading)
        process.stdin, process.stdout, process.stderr = os.fdopen(writing, "wb"), out, err
        return process
    with open(os.devnull, "rb") as nothing:
        if command[2] == "ultragray_service.cli.worker":
            files = (nothing.fileno(), 1, 2)
            return fork(path, "worker", [str(path)], files=files, end_with=signal.SIGTERM, **common)
        return fork(
            path, "job_template", [], files=(nothing.fileno(), 1, 2, *pass_fds), end_with=signal.SIGKILL, **common
        )


class Hold:
    """Keeps helper processes of a work from beginning it until this context ends; `start`: services, for ever."""

    def __init__(self, work):
        self._file = Path.home() / f"held-{work}"  # the home of the tests of one process

    def __enter__(self):
        self._file.touch()
        return self

    def __exit__(self, *_):
        self._file.unlink()

    @property
    def pid(self):
        """The process that is held; None: there is none yet."""
        told = self._file.read_text()
        return int(told) if told else None

    @property
    def is_wanted(self):
        return self._file.exists()

    def keep(self):
        """What the helper process does."""
        if self.is_wanted:
            self._file.write_text(str(os.getpid()))
        while self.is_wanted:
            time.sleep(0.01)


def helper(module, work):
    """A helper process of a service."""
    from ultragray_workers.helpers import answer_request

    Hold(work).keep()
    answer_request(getattr(importlib.import_module(module), work))
    return 0


def worker(path):
    """The worker within a service."""
    from ultragray_service.cli.worker import main

    work_warmly(path)
    return main(str(os.getppid()))


def job_template(descriptor):
    """The template of a worker's job processes."""
    from ultragray_workers.jobs.worker.template import main

    main(descriptor)


FUNCTIONS = {one.__name__: one for one in (template, service, helper, worker, job_template)}


def serve(path, run_pid):
    """Forks for whoever connects, until the run has ended."""
    running, bound = {}, {}  # connections by process; processes that end with those who asked for them
    ended, wake = socket.socketpair()
    wake.setblocking(False)
    signal.set_wakeup_fd(wake.fileno(), warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    run = os.pidfd_open(run_pid)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(f"{path}.new")
    listener.listen(64)
    os.rename(f"{path}.new", path)
    while True:
        readable = select.select([run, listener, ended, *bound], [], [])[0]
        if ended in readable:
            ended.recv(4096)
            with contextlib.suppress(ChildProcessError):
                while (found := os.waitpid(-1, os.WNOHANG))[0]:
                    with running.pop(found[0]) as connection, contextlib.suppress(OSError):
                        bound.pop(connection, None)
                        connection.send(str(os.waitstatus_to_exitcode(found[1])).encode())
        for connection in bound.keys() & set(readable):  # whoever asked is gone
            os.kill(*bound.pop(connection))
        if listener in readable:
            connection, _ = listener.accept()
            content, files, _, _ = socket.recv_fds(connection, _MAX_REQUEST_BYTES, 8)
            request = json.loads(content)
            pid = os.fork()
            if pid == 0:
                if request.get("session"):
                    os.setsid()
                connection.send(str(os.getpid()).encode())  # from now on its group can be killed
                for ours in (listener, ended, wake, connection, *running.values()):
                    ours.close()
                os.close(run)
                leave(begin(request, files))
            for file in files:
                os.close(file)
            running[pid] = connection
            if "end_with" in request:
                bound[connection] = pid, request["end_with"]
        if run in readable:
            shutil.rmtree(Path(path).parent)
            return


def begin(request, files):
    """What a fork does: takes over the state of a fresh process, then calls the function."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _mark(request["environment"]["PYTEST_RUN"])
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(str(request["folder"]))
    for number, file in enumerate(files[:_STANDARD_FILES]):
        os.dup2(file, number)
        os.close(file)
    return FUNCTIONS[str(request["function"])](*request["arguments"], *files[_STANDARD_FILES:])


def leave(code):
    """Ends a fork as the interpreter would, but for its slow farewell to all that was imported: a third of a second."""
    threading._shutdown()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(code or 0)


_marks = []


def _mark(run):
    """Shows in /proc/PID/maps, also of what a fork forks, whose tests it belongs to: its environment is another's."""
    descriptor = os.memfd_create(mark_of(run))
    os.ftruncate(descriptor, mmap.PAGESIZE)
    _marks.append(mmap.mmap(descriptor, mmap.PAGESIZE))
    os.close(descriptor)


def mark_of(run):
    return f"pytest-run-{run}."


def belongs_to(run, folder):
    """Whether the process of a folder of /proc was started by the tests of a run, as a fork or as a program."""
    started = f"PYTEST_RUN={run}\0".encode() in (folder / "environ").read_bytes()
    return started or mark_of(run) in (folder / "maps").read_text()


_TEMPLATE = b"ultragray_workers.pool.template"


def pool_processes(run):
    """Workers and templates of render pools of a run by process id; one that has just started is called `python`."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(FileNotFoundError, PermissionError, ProcessLookupError):
            name = (folder / "comm").read_text().strip()
            is_pools = name in ("ug-worker", "ug-template") or _TEMPLATE in (folder / "cmdline").read_bytes()
            if is_pools and belongs_to(run, folder):
                found[int(folder.name)] = name
    return found


if __name__ == "__main__":
    for module in sys.argv[3:]:
        importlib.import_module(module)
    gc.collect()
    gc.freeze()
    assert len(os.listdir("/proc/self/task")) == 1, "a process with threads must not be forked"
    serve(sys.argv[1], int(sys.argv[2]))
