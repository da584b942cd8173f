"""The template of a worker's job processes: `python -m ultragray_workers.jobs.worker.template SOCKET`.

It has imported what jobs need and waits, so that a job takes a fork in place of seconds of imports. It runs no job
itself, touches no GPU (a CUDA context does not survive a fork) and has one thread, which is what makes forking it safe.
One job at a time: it waits for the end of each, and dies with its worker, as the job dies with it.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import socket
import sys
from contextlib import suppress
from importlib import import_module
from typing import Any, NoReturn

from ultragray_workers.jobs.worker.process import EXIT_CODE, PID
from ultragray_workers.processes import end_with_parent

MAX_MESSAGE_BYTES = 16 * 1024


def main(descriptor: str) -> NoReturn:
    """Fork a process for each request on a socket of sequenced packets, until the worker hangs up.

    A request is JSON with the job's folder and changes of the environment, and three descriptors: its log, the lock of
    its device, and a socket on which its number and, once it has ended, its exit code come back.
    """
    end_with_parent(signal.SIGKILL)
    for number in (signal.SIGINT, signal.SIGTERM):  # the worker decides about the job
        signal.signal(number, signal.SIG_IGN)
    _import_work()
    gc.collect()
    gc.freeze()  # keeps the collector of each fork from touching, and so copying, these pages
    requests, template = socket.socket(fileno=int(descriptor)), os.getpid()
    while True:
        content, descriptors, _, _ = socket.recv_fds(requests, MAX_MESSAGE_BYTES, 3)
        if not content:
            os._exit(0)
        log, lock, answers = descriptors
        pid = os.fork()
        if pid == 0:
            requests.close()
            _do_job(json.loads(content), log, answers, template)
        for file in (log, lock):
            os.close(file)
        ended = os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
        assert ended is not None
        code = ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status
        with socket.socket(fileno=answers) as connection, suppress(OSError):  # a worker may have gone
            connection.send(b"%s %d" % (EXIT_CODE, code))
            connection.recv(1)  # until it has ended what the process left in its group, whose number stays taken
        os.waitpid(pid, 0)


def _import_work() -> None:
    import torch  # after the signals: it takes seconds

    from ultragray_workers.jobs.kinds import Specification

    import_module("ultragray_workers.jobs.worker.run_job")
    if torch.version.cuda is not None:
        with suppress(ImportError):
            import_module("triton")
    for kind in Specification.members.values():
        if kind.run_module is not None:
            import_module(kind.run_module)


def _do_job(request: dict[str, Any], log: int, answers: int, template: int) -> NoReturn:
    from ultragray_workers.jobs.worker import run_job

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.setsid()
    with socket.socket(fileno=answers) as connection:
        connection.send(b"%s %d" % (PID, os.getpid()))  # from now on its group can be killed
    for number in (1, 2):
        os.dup2(log, number)
    os.close(log)
    os.environ.update(request["environment"])
    code = 1
    try:
        code = run_job.main(request["folder"], template)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):
                stream.flush()
        os._exit(code)  # without the interpreter's slow farewell to torch


if __name__ == "__main__":
    main(*sys.argv[1:])
