"""Renderings that take long: what is too large is refused before, progress is told, and an end leaves nothing."""

import os
import signal
import socket
import subprocess

from ultragray_service.cli import terminal

from ...waiting import wait_until
from .command_line import python, refused, run

LONG = ("--sampler", "around", "--count", "20000", "--height", "512", "--width", "512")


def test_sigterm_leaves_no_file_behind(scene_file, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    program = "from ultragray_service.cli.app import app; app()"
    command = python(program, "render", scene_file, "-o", folder / "frames.npz", *LONG)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: any(folder.iterdir()))
    process.send_signal(signal.SIGTERM)
    _, told = process.communicate(timeout=300)
    assert process.returncode == 130, told
    assert list(folder.iterdir()) == []


def test_frames_that_the_disk_has_no_room_for_are_refused(scene_file, tmp_path):
    many = ("--sampler", "around", "--count", 20_000, "--height", 4096, "--width", 4096, "--outputs", "bmode,echo")
    told = refused("render", scene_file, "-o", tmp_path / "f.npz", *many)
    assert "20,000 frames take up to 2,684.4 GB" in told
    assert list(tmp_path.glob("*.npz")) == []


def test_a_folder_that_cannot_be_written_to_is_refused(scene_file, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write everywhere
    told = refused("render", scene_file, "-o", f"{tmp_path / 'pictures'}/")
    assert f"output must be a folder that can be written to, {tmp_path} cannot" in told


def test_where_there_is_no_terminal_progress_is_told_in_lines(scene_file, tmp_path, monkeypatch):
    monkeypatch.setattr(terminal, "_REPORT_EVERY_S", 0.0)
    done = run("render", scene_file, "-o", tmp_path / "f.npz", "--sampler", "around", "--count", 3)
    assert "rendering: 3 of 3, 0.0 min left" in done.stderr


def test_a_port_in_use_is_told_before_a_scene_is_written(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        told = refused("serve", "--data-folder", tmp_path, "--http-port", port, "--grpc-port", 0)
    assert "the port is in use" in told
    assert list(tmp_path.iterdir()) == []
