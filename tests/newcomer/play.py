"""Plays somebody who clones the project and types what its documents say, with Debian's Python: `make test-newcomer`.

Each step is told with its time; the first that fails ends the play. The times go to build/newcomer.json. Ports 8000 and
50051 must be free: a newcomer takes the ones that the documents name.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "build" / "newcomer.json"
PYTHON = "/usr/bin/python3"  # Debian's
PORTS = (8000, 50051)
CONSOLE = f"http://localhost:{PORTS[0]}"
DEVELOPERS = (
    "ULTRAGRAY_",
    "VIRTUAL_ENV",
    "PYTHON",
    "MAKE",
    "MFLAGS",
    "ARGS",
)  # beginnings of variables that a newcomer lacks
PAGES = ("README.md", "docs/tutorial.md")
REPEATS = 7
# Seconds, of the two cores that the project is measured on.
GOALS = {"first frame": 180.0, "first frame of the second start": 10.0, "help": 0.15, "error of input": 0.3}


class Failed(Exception):
    """A step went wrong; the message is what the newcomer saw."""


class Newcomer:
    """A clone of the project, a terminal in it, and the times of what was done there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.clone = folder / "ultragray"
        self.times_s: dict[str, float] = {}
        self.environment = {name: value for name, value in os.environ.items() if not name.startswith(DEVELOPERS)}
        self.environment["PATH"] = _without(self.environment["PATH"], ROOT / ".venv")

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[None]:
        _tell(f"{name} ...")
        began = time.perf_counter()
        yield
        self.note(name, time.perf_counter() - began)

    @property
    def missed(self) -> list[str]:
        """The goals that were not reached."""
        return [name for name, goal_s in GOALS.items() if self.times_s.get(name, 0.0) > goal_s]

    def note(self, name: str, taken_s: float) -> None:
        goal = f" (goal {GOALS[name]:g} s)" if name in GOALS else ""
        self.times_s[name] = round(taken_s, 3)
        _tell(f"{name}: {taken_s:.2f} s{goal}")

    def run(self, *command: str, expect: int = 0, cwd: Path | None = None, path: Path | None = None) -> str:
        """What a command prints, both streams. `path`: a folder of programs that comes first. Raises Failed."""
        environment = dict(self.environment)
        if path is not None:
            environment["PATH"] = f"{path}:{environment['PATH']}"
        done = subprocess.run(
            command,
            cwd=cwd or self.clone,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode != expect:
            raise Failed(f"{' '.join(command)}: exit code {done.returncode}, expected {expect}\n{done.stdout[-6000:]}")
        return done.stdout

    @contextlib.contextmanager
    def serving(self) -> Iterator[Terminal]:
        """`make serve` in a terminal, until Ctrl-C."""
        terminal = Terminal(["make", "serve", f"PYTHON={PYTHON}"], self.clone, self.environment)
        try:
            yield terminal
        except BaseException:
            with contextlib.suppress(Failed):  # the first failure is the one to tell
                terminal.interrupt()
            raise
        terminal.interrupt()


class Terminal:
    """A command in a terminal of its own, and what it has shown there so far."""

    def __init__(self, command: Sequence[str], cwd: Path, environment: dict[str, str]) -> None:
        self._ours, theirs = pty.openpty()
        self._process = subprocess.Popen(
            command, cwd=cwd, env=environment, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
        )
        os.close(theirs)
        self._shown = bytearray()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def shown(self) -> str:
        return self._shown.decode(errors="replace")

    @property
    def ended(self) -> bool:
        return self._process.poll() is not None

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # the terminal closes with its last process
            while part := os.read(self._ours, 65536):
                self._shown += part

    def interrupt(self) -> None:
        """Ctrl-C. Raises Failed where the command does not stop, or not as one that was asked to."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGINT)
        try:
            code = self._process.wait(60)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            raise Failed(f"the service did not stop at Ctrl-C\n{self.shown[-3000:]}") from None
        if code not in (0, 2, 130, -signal.SIGINT):  # make says 2 or 130 at Ctrl-C
            raise Failed(f"the service ended with {code}\n{self.shown[-3000:]}")
        if "Traceback" in self.shown:
            raise Failed(f"the service shows a traceback\n{self.shown[-6000:]}")


def clone(newcomer: Newcomer) -> None:
    with newcomer.step("git clone"):
        newcomer.run("git", "clone", "--quiet", str(ROOT), str(newcomer.clone), cwd=newcomer.folder)


def serve(newcomer: Newcomer) -> None:
    """The first start from the clone, the documents against it, and the second start."""
    began = time.time() - newcomer.times_s["git clone"]
    with newcomer.serving() as terminal:
        newcomer.note("first frame", _frame_shown(newcomer, terminal, "first.png") - began)
        for expected in (f":{PORTS[0]}", "Ctrl-C"):
            if expected not in terminal.shown:
                raise Failed(f"the terminal does not say {expected!r}\n{terminal.shown[-3000:]}")
        for page in PAGES:
            with newcomer.step(f"the blocks of {page}"):
                run_blocks(newcomer, newcomer.clone / page)
    began = time.time()
    with newcomer.serving() as terminal:
        newcomer.note("first frame of the second start", _frame_shown(newcomer, terminal, "second.png") - began)


def run_blocks(newcomer: Newcomer, page: Path) -> None:
    """The code blocks of a page, against the service that runs, in an empty folder."""
    folder = newcomer.folder / page.stem
    newcomer.run(".venv/bin/python", "-m", "tests.newcomer.run_page", str(page), str(folder))


def command_line(newcomer: Newcomer) -> None:
    """How long the short commands take, as medians."""
    program = str(newcomer.clone / ".venv/bin/ultragray")
    newcomer.note("help", _median_s(lambda: newcomer.run(program, "--help")))
    newcomer.note("error of input", _median_s(lambda: newcomer.run(program, "show", "missing.ugr", expect=2)))


def test(newcomer: Newcomer) -> None:
    """The tests, in the checkout that was used."""
    with newcomer.step("make test"):
        newcomer.run("make", "test")


def packages(newcomer: Newcomer) -> None:
    """Wheels into empty environments; each goes on without the other."""
    with newcomer.step("wheels"):
        newcomer.run(".venv/bin/pytest", "-m", "long", "tests/distribution")


def _frame_shown(newcomer: Newcomer, terminal: Terminal, picture: str) -> float:
    """When the first frame was on the console, in seconds since the epoch. Raises Failed."""
    command = ["node", str(ROOT / "tests/newcomer/first_frame.mjs"), CONSOLE, str(RECORD.parent / picture)]
    with subprocess.Popen(command, env=newcomer.environment, stdout=subprocess.PIPE, text=True) as browser:
        while browser.poll() is None:
            time.sleep(0.1)
            if terminal.ended:
                browser.terminate()
        if browser.returncode != 0:
            raise Failed(f"no frame came to the console; the terminal shows\n{terminal.shown[-3000:]}")
        return float(browser.communicate()[0].split()[-1])


def _median_s(command: Callable[[], object]) -> float:
    def once() -> float:
        began = time.perf_counter()
        command()
        return time.perf_counter() - began

    once()  # the files are read from the disk
    return statistics.median(once() for _ in range(REPEATS))


def _without(path: str, folder: Path) -> str:
    return ":".join(part for part in path.split(":") if not Path(part).is_relative_to(folder))


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _require_free_ports() -> None:
    for port in PORTS:
        with socket.socket() as one:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                one.bind(("127.0.0.1", port))
            except OSError:
                raise Failed(f"port {port} is taken; the newcomer needs {PORTS[0]} and {PORTS[1]}") from None


STEPS = {step.__name__: step for step in (clone, serve, command_line, test, packages)}


def main(names: Sequence[str]) -> None:
    """All steps, or those of the names."""
    RECORD.parent.mkdir(exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="ultragray-newcomer-"))
    newcomer = Newcomer(folder)
    try:
        _require_free_ports()
        for name in names or STEPS:
            STEPS[name](newcomer)
        if newcomer.missed:
            raise Failed(f"goals missed: {', '.join(newcomer.missed)}")
    except Failed as error:
        sys.exit(f"error: {error}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        RECORD.write_text(json.dumps({"seconds": newcomer.times_s, "goals": GOALS}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
