"""Programs in C#, compiled by Mono, against a real service and libultragray."""

import os
import queue
import shutil
import subprocess
import threading
from pathlib import Path

import pytest

from ultragray.installation import c_library

from ..service.conftest import ROOT, data_folder, demo_scene, service_starter, start_service, start_shared_service
from ..waiting import wait_until

__all__ = ["data_folder", "demo_scene", "service_starter", "start_service", "start_shared_service"]

ENGINES = ROOT / "engines"
HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def build(tmp_path_factory):
    """Compiles sources of C# to a program (.exe) or a library (.dll) in a folder that all of them share."""
    if shutil.which("mcs") is None or shutil.which("mono") is None:
        pytest.skip("there is no C# compiler (Debian's mono-mcs, mono-runtime, libmono-system-net-http4.0-cil)")
    folder = tmp_path_factory.mktemp("csharp")

    def compile_(name, sources, references=()):
        kind = "exe" if name.endswith(".exe") else "library"
        command = [
            "mcs",
            "-warnaserror",
            f"-target:{kind}",
            f"-out:{name}",
            *(f"-r:{one}" for one in references),
            *sources,
        ]
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return folder / name

    return compile_


@pytest.fixture(scope="session")
def client(build):
    return build("Ultragray.dll", sorted((ENGINES / "csharp").glob("*.cs")), ["System.Net.Http.dll"])


@pytest.fixture(scope="session")
def driver(build, client):
    return build("Driver.exe", [HERE / "Driver.cs"], [client])


@pytest.fixture
def start():
    """Starts programs, which are ended with the test."""
    started = []

    def start_(*command, **environment):
        started.append(Program(command, environment))
        return started[-1]

    yield start_
    for program in started:
        program.close()


class Program:
    """A program of C# that is spoken to by lines."""

    def __init__(self, command, environment):
        folder = str(c_library()[0].parent)
        self.process = subprocess.Popen(
            ["mono", *map(str, command)],
            env={**os.environ, "LD_LIBRARY_PATH": folder, **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        self._lines = queue.SimpleQueue()
        self.told = []  # all lines so far
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self.process.stdout:
            self._lines.put(line.rstrip("\n"))
        self._lines.put(None)

    def say(self, *words):
        self.process.stdin.write(" ".join(map(str, words)) + "\n")
        self.process.stdin.flush()

    def wait_for(self, *words):
        """The rest of the next line that begins with these words."""
        begin = " ".join(map(str, words))
        while True:
            line = self.next_line()
            if line == begin or line.startswith(f"{begin} "):
                return line.removeprefix(begin).strip()

    def next_line(self):
        wait_until(lambda: not self._lines.empty())
        line = self._lines.get()
        assert line is not None, f"it ended, after {self.told}"
        self.told.append(line)
        return line

    def end(self):
        """Its last lines, once its input has ended."""
        self.process.stdin.close()
        while (line := self._lines.get()) is not None:
            self.told.append(line)
        assert self.process.wait() == 0, self.told
        return self.told

    def close(self):
        self.process.kill()
        self._reader.join()
        with self.process:  # waits, and closes its pipes
            pass
