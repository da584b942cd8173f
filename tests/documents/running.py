"""Runs the blocks of a page in a folder, one after another.

    python -m tests.documents.running PAGE FOLDER

does so against the service on the ports that the documents name.
"""

import ast
import contextlib
import doctest
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import yaml

from ..waiting import Deadline
from .blocks import SHELL, read_page

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SHARED = ("ultragray serve", "ultragray serve --igtl-port 18944", "make serve")  # what the service of all pages does
COMMAND_TIMEOUT_S = 1200.0  # a training, on a machine that is busy with other tests
START_TIMEOUT_S = 300.0
PORTS = {"8000": "http", "50051": "grpc", "18944": "igtl"}  # as documents write them
_ADDRESS = re.compile(r"((?:localhost|127\.0\.0\.1)[\"']?[:,] ?|port[ =])(8000|50051|18944)\b")
_PARSERS = {"json": json.loads, "toml": tomllib.loads, "yaml": yaml.safe_load}


class PageRun:
    """The run of a page: its folder, the names of its Python blocks, and the service that it started."""

    def __init__(self, page, folder, shared_ports):
        """`shared_ports` gives those of the service of all pages, by door; it is asked where a page starts one."""
        self.page, self.folder, self.ports, self._shared_ports = page, folder, None, shared_ports
        self.names = {"__name__": "__main__"}
        self.served = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stop_serving()

    def run(self, block):
        code = self._with_ports(block.code)
        if block.language in _PARSERS:
            _PARSERS[block.language](code)
        elif block.language == "python":
            self._python(code, block)
        elif block.language in SHELL and block.not_run is None:
            if block.serves and shlex.join(shlex.split(block.script(), comments=True)) in SHARED:
                self.ports = self._shared_ports()
            elif block.serves:
                self._serve(block)
            else:
                self._shell(self._with_ports(block.script()), block)

    def environment(self):
        """That of the commands. A service that a page starts gets ports of its own from it."""
        path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
        found = {**os.environ, "PATH": path, "COLUMNS": "120", "ULTRAGRAY_THREADS_PER_PROCESS": "1"}
        if self.ports is not None:
            found["ULTRAGRAY_ADDRESS"] = f"http://127.0.0.1:{self.ports['http']}"
        return found

    def _with_ports(self, text):
        ports = self.ports
        return text if ports is None else _ADDRESS.sub(lambda match: f"{match[1]}{ports[PORTS[match[2]]]}", text)

    def _place(self, block):
        return f"{self.page.path}:{block.line}"

    def _python(self, code, block):
        if code.startswith(">>>"):
            if block.not_run is None:
                self._doctest(code, block)
            return
        tree = ast.parse(code, str(self.page.path))
        ast.increment_lineno(tree, block.line - 1)  # a traceback names the line of the page
        compiled = compile(tree, str(self.page.path), "exec")
        if block.not_run is None:
            exec(compiled, self.names)

    def _doctest(self, code, block):
        path = str(self.page.path)
        test = doctest.DocTestParser().get_doctest(code, self.names, path, path, block.line - 1)
        told = []
        runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
        runner.run(test, out=told.append, clear_globs=False)
        self.names.update(test.globs)
        assert not runner.failures, f"{self._place(block)}: " + "".join(told)

    def _shell(self, script, block):
        with tempfile.TemporaryFile() as output:  # no pipe: a process left in the background would keep it open
            done = subprocess.run(
                ["bash", "-e", "-o", "pipefail", "-c", script],
                cwd=self.folder,
                env=self.environment(),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                timeout=COMMAND_TIMEOUT_S,
            )
            output.seek(0)
            told = output.read().decode(errors="replace")
        assert done.returncode == 0, f"{self._place(block)}: exit code {done.returncode}\n{script}\n{told[-4000:]}"

    def _serve(self, block):
        """Runs the block in the background, with the ports of a service of its own."""
        self._stop_serving()
        self.ports = {door: _free_port() for door in PORTS.values()}
        own = {f"ULTRAGRAY_{door.upper()}_PORT": str(self.ports[door]) for door in ("http", "grpc")}
        log = self.folder.parent / f"{self.folder.name}.log"
        with log.open("wb") as output:
            self.served = subprocess.Popen(
                ["bash", "-e", "-c", self._with_ports(block.script())],
                cwd=self.folder,
                env={**self.environment(), **own},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        end = Deadline(START_TIMEOUT_S)
        while not _answers(self.ports["http"]):
            told = log.read_text(errors="replace")[-4000:]
            assert self.served.poll() is None, f"{self._place(block)}: the service ended\n{told}"
            assert not end.passed, f"{self._place(block)}: not ready after {START_TIMEOUT_S} s\n{told}"
            time.sleep(0.1)

    def _stop_serving(self):
        if self.served is not None and self.served.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.served.pid, signal.SIGTERM)
            try:
                self.served.wait(300)
            except subprocess.TimeoutExpired:
                os.killpg(self.served.pid, signal.SIGKILL)
                self.served.wait()
                raise


def _free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def _answers(port):
    """Whether a service at a port is ready. One that speaks TLS cuts this off, and is taken for ready."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/v1/health/ready", timeout=10) as answer:
            return bool(answer.status == 200)
    except ConnectionResetError:
        return True
    except OSError:
        return False


def main(page, folder):
    folder.mkdir()
    os.chdir(folder)
    with PageRun(read_page(page), folder, lambda: {door: int(port) for port, door in PORTS.items()}) as run:
        os.environ.update(run.environment())
        for block in run.page.runs:
            run.run(block)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
