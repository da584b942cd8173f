"""What a machine lacks for a build is said in one sentence each, before anything is built or downloaded."""

import os
import subprocess
import sys

import pytest

from ..scripts import loaded
from ..surroundings import ROOT

SCRIPT = ROOT / "distribution/prerequisites.py"


@pytest.fixture
def prerequisites():
    return loaded(SCRIPT)


def program(path, text):
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_without_the_headers_of_python(prerequisites, tmp_path, monkeypatch):
    monkeypatch.setattr(prerequisites.sysconfig, "get_path", lambda name: str(tmp_path / name))
    told = prerequisites.headers_problem()
    assert "the headers of Python are missing" in told
    assert f"{tmp_path}/include/Python.h" in told
    assert f"python3.{sys.version_info.minor}-dev" in told


def test_without_a_compiler(prerequisites, tmp_path, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert prerequisites.compiler_problem() == (
        "a C++17 compiler and its library are missing; install what Debian calls g++"
    )
    program(tmp_path / "apt-get", "exit 0")
    assert prerequisites.compiler_problem().endswith("to install: sudo apt-get install g++")


def test_the_script_ends_with_one_line_for_each_problem(tmp_path):
    environment = {"PATH": str(tmp_path)}
    done = subprocess.run([sys.executable, str(SCRIPT)], env=environment, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: a C++17 compiler")


def made(tmp_path, python):
    """`make` of the virtual environment by a Python that does what the shell commands `python` do."""
    arguments = [f"PYTHON={program(tmp_path / 'python', python)}", f"VENV={tmp_path / 'venv'}"]
    command = ["make", "--no-print-directory", "-C", str(ROOT), *arguments, f"{tmp_path / 'venv'}/python"]
    return subprocess.run(command, env={"PATH": os.environ["PATH"]}, capture_output=True, text=True)


def test_make_with_an_old_python(tmp_path):
    done = made(tmp_path, "exit 1")
    assert done.returncode != 0
    assert done.stdout.splitlines()[0].startswith("error: Python 3.11 or newer is needed")
    assert not (tmp_path / "venv").exists()


def test_make_with_a_python_without_venv(tmp_path):
    done = made(tmp_path, 'case "$2" in *venv*) exit 1 ;; esac')
    assert done.returncode != 0
    assert "on Debian: sudo apt-get install python3-venv" in done.stdout.splitlines()[0]
    assert not (tmp_path / "venv").exists()


def test_make_leaves_the_environment_that_there_is_to_its_python(tmp_path):
    stamp = tmp_path / "venv" / "python"
    stamp.parent.mkdir()
    stamp.touch()
    os.utime(stamp, (0, 0))  # older than the Makefile
    done = made(tmp_path, "exit 1")
    assert done.returncode == 0, done.stdout
