"""The template process: has torch imported and waits, so that a new worker takes a fork and not an import.

It never renders, never touches a GPU (a CUDA context does not survive a fork) and has one thread, which is what makes
forking it safe. Every process it forks, a worker or another template, serves the channel sent along with the request.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import traceback
from pathlib import Path
from typing import NoReturn

from ultragray_workers.pool.channel import Channel
from ultragray_workers.pool.messages import ForkWorker, Hello

WORKER = "ug-worker"  # name of a process that renders


def main(channel_descriptor: int) -> NoReturn:
    for number in (signal.SIGINT, signal.SIGTERM):  # meant for the service, which drains and then hangs up
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # no zombies
    import torch  # after the signals: it takes seconds

    from ultragray_workers.pool.worker import run_worker

    if torch.version.cuda is not None:
        with contextlib.suppress(ImportError):
            importlib.import_module("triton")  # a third of a second less for each worker with a GPU
    gc.collect()
    gc.freeze()  # keeps the collector of each fork from touching, and so copying, these pages
    channel = Channel.from_descriptor(channel_descriptor)
    _name_process("ug-template")
    channel.send(Hello(os.getpid()))
    while True:
        try:
            request, descriptors = channel.receive()
        except (EOFError, ConnectionError):
            os._exit(0)  # without the interpreter's slow farewell to torch
        if os.fork() != 0:
            for descriptor in descriptors:
                os.close(descriptor)
            continue
        channel.close()
        channel = Channel.from_descriptor(descriptors[0])  # the others are the worker's board
        if isinstance(request, ForkWorker):
            _name_process(WORKER)
            try:
                run_worker(channel, request, *descriptors[1:])
            except BaseException:
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        channel.send(Hello(os.getpid()))


def _name_process(name: str) -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/comm").write_text(name)
