"""Plays somebody who clones the project and types what its documents say, with Debian's Python: `make test-newcomer`.

Each step is told with its time; the first that fails ends the play. The times go to build/newcomer.json. Ports 8000 and
50051 must be free: a newcomer takes the ones that the documents name.
"""

import contextlib
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "build" / "newcomer.json"
PYTHON = "/usr/bin/python3"  # Debian's
CONSOLE = "http://localhost:8000"
DEVELOPERS = ("ULTRAGRAY_", "VIRTUAL_ENV", "PYTHON", "MAKE", "MFLAGS", "ARGS")  # variables that a newcomer lacks
# Seconds, of the two cores that the project is measured on.
GOALS = {"first frame": 180.0, "first frame of the second start": 10.0, "help": 0.15, "error of input": 0.3}

environment = {name: value for name, value in os.environ.items() if not name.startswith(DEVELOPERS)}
environment["PATH"] = ":".join(
    part for part in environment["PATH"].split(":") if not Path(part).is_relative_to(ROOT / ".venv")
)
times_s = {}


def note(name, taken_s):
    times_s[name] = round(taken_s, 3)
    goal = f" (goal {GOALS[name]:g} s)" if name in GOALS else ""
    sys.stdout.write(f"{name}: {taken_s:.2f} s{goal}\n")
    sys.stdout.flush()


def run(clone, *command, expect=0):
    """What a command in the clone prints, both streams."""
    shown = [str(part) for part in command]
    done = subprocess.run(
        shown, cwd=clone, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    if done.returncode != expect:
        sys.exit(f"error: {' '.join(shown)}: exit code {done.returncode}, not {expect}\n{done.stdout[-6000:]}")
    return done.stdout


def timed(name, clone, *command, expect=0, repeats=1):
    """Tell the time of a command, the median of some repetitions."""
    taken_s = []
    for _ in range(repeats):
        began = time.perf_counter()
        run(clone, *command, expect=expect)
        taken_s.append(time.perf_counter() - began)
    note(name, statistics.median(taken_s))


@contextlib.contextmanager
def serving(clone, name, began):
    """`make serve` until Ctrl-C, from the first frame on the console on."""
    log = clone.parent / "serve.log"
    command = ["make", "serve", f"PYTHON={PYTHON}"]
    with log.open("wb") as file:
        service = subprocess.Popen(command, cwd=clone, env=environment, stdout=file, stderr=file, process_group=0)
    try:
        picture = RECORD.with_name(f"{name.replace(' ', '-')}.png")
        shown_at = run(clone, "node", ROOT / "tests/newcomer/first_frame.mjs", CONSOLE, picture).split()[-1]
        note(name, float(shown_at) - began)
        yield
    finally:
        os.killpg(service.pid, signal.SIGINT)
        code, said = service.wait(60), log.read_text(errors="replace")
    if code not in (0, 2, 130, -signal.SIGINT) or "Traceback" in said:  # make says 2 or 130 at Ctrl-C
        sys.exit(f"error: the service ended with {code}\n{said[-6000:]}")


def play(folder):
    """Every step of a newcomer's first hour."""
    clone, python = folder / "ultragray", ".venv/bin/python"
    began = time.time()
    timed("git clone", folder, "git", "clone", "--quiet", ROOT, clone)
    with serving(clone, "first frame", began):
        for page in ("README.md", "docs/tutorial.md"):
            runner = (python, "-m", "tests.documents.running", clone / page, folder / Path(page).stem)
            timed(f"the blocks of {page}", clone, *runner)
    with serving(clone, "first frame of the second start", time.time()):
        pass
    timed("help", clone, ".venv/bin/ultragray", "--help", repeats=8)
    timed("error of input", clone, ".venv/bin/ultragray", "show", "missing.ugr", expect=2, repeats=8)
    timed("make test", clone, "make", "test")
    timed("wheels", clone, ".venv/bin/pytest", "-m", "long", "tests/distribution")


def main():
    RECORD.parent.mkdir(exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="ultragray-newcomer-"))
    try:
        play(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        RECORD.write_text(json.dumps({"seconds": times_s, "goals": GOALS}, indent=2) + "\n", encoding="utf-8")
    if missed := [name for name, goal_s in GOALS.items() if times_s[name] > goal_s]:
        sys.exit(f"error: goals missed: {', '.join(missed)}")


if __name__ == "__main__":
    main()
