"""The process that forks those of a worker's jobs: one for all, and none outlives the other."""

import os
import signal
import socket
from pathlib import Path

from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.worker.process import JobProcess

from ....waiting import wait_until
from ..conftest import is_training, train_job

FOR_EVER = 1_000_000  # steps


def is_gone(*processes):
    return not any(Path(f"/proc/{process}").exists() for process in processes)


def test_a_process_that_dies_before_it_can_say_so_has_ended():
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with far:
        far.send(b"exit -11")
        process = JobProcess(near, None)
        assert (process.pid, process.poll(), process.wait()) == (None, -signal.SIGSEGV, -signal.SIGSEGV)
        process.end()


def test_one_template_forks_the_processes_of_all_jobs(store, start_worker, until):
    worker = start_worker()
    template = wait_until(worker.template)
    for scene in ("one", "two"):
        job = until(store.submit(train_job(scene))[0])
        assert (job.state, job.attempts) == (JobState.SUCCEEDED, 1), job
        assert "step" in store.log_tail(job.id)  # its process speaks into its own log
    assert worker.template() == template
    assert worker.terminate() == 0
    assert is_gone(template)


def test_a_job_dies_with_the_template_and_goes_on_from_a_new_one(store, start_worker, until):
    worker = start_worker()
    job, _ = store.submit(train_job("one", steps=FOR_EVER))
    until(job, is_training)
    template, process = worker.template(), worker.job_process()
    assert template is not None
    os.kill(template, signal.SIGKILL)
    wait_until(lambda: is_gone(template, process))

    successor = wait_until(worker.job_process)
    assert worker.template() not in (template, None)
    assert successor != process
    store.cancel(job.id)
    wait_until(lambda: is_gone(successor))
    assert until(store.submit(train_job("two"))[0]).state is JobState.SUCCEEDED


def test_neither_outlives_a_worker_that_is_killed(store, start_worker, until):
    worker = start_worker()
    job, _ = store.submit(train_job("one", steps=FOR_EVER))
    until(job, is_training)
    template, process = worker.template(), worker.job_process()
    worker.kill()
    wait_until(lambda: is_gone(template, process))
