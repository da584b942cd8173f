"""What systemd hears of the service, on a socket as systemd has one."""

import os
import signal
import socket

import pytest

from ultragray_service.server import ALIVE, READY, STOPPING, ServiceManager

WAIT_S = 60.0


@pytest.fixture
def listener(tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(WAIT_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


def test_service_tells_when_it_is_ready_alive_and_stopping(listener, start_service, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "600000")
    service = start_service(wait=False)
    told = [listener.recv(100).decode()]
    while told[-1] != READY:
        told.append(listener.recv(100).decode())
    service.wait_until_serving()
    while told[-1] != ALIVE:
        told.append(listener.recv(100).decode())
    service.process.send_signal(signal.SIGTERM)
    while told[-1] != STOPPING:
        told.append(listener.recv(100).decode())
    assert set(told) == {READY, ALIVE, STOPPING}
    assert service.terminate() == 0


def test_process_that_nobody_manages_tells_nobody(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    manager = ServiceManager()
    manager.tell(READY)
    assert manager.alive_every_s is None


def test_processes_that_it_starts_do_not_inherit_the_socket(listener, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "30000000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    manager = ServiceManager()
    assert manager.alive_every_s == pytest.approx(10.0)
    assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"} & os.environ.keys()
    manager.tell(ALIVE)
    assert listener.recv(100).decode() == ALIVE


def test_manager_that_is_gone_or_busy_holds_nobody_up(listener, monkeypatch, tmp_path):
    manager = ServiceManager()
    for _ in range(10_000):  # nobody listens
        manager.tell(ALIVE)
    (tmp_path / "notify").unlink()
    manager.tell(STOPPING)
