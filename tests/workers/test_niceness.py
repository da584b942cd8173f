"""Jobs and helpers let frames go first, also where the kernel shares processors among sessions."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

LEVEL = min(19, os.nice(0) + 5)
PROGRAM = (
    f"import sys; sys.path[:] = {sys.path!r}; import os\n"
    f"from ultragray_workers.processes import let_frames_go_first; let_frames_go_first({LEVEL})\n"
    "print(os.nice(0), open('/proc/self/autogroup').read() if os.path.exists('/proc/self/autogroup') else '')"
)


OF_SESSION = Path("/proc/self/autogroup")
needs_sessions = pytest.mark.skipif(
    not OF_SESSION.exists(), reason="this kernel shares its processors among processes, not sessions"
)
WITHOUT_CAPABILITY = ("setpriv", "--bounding-set=-sys_admin") if os.getuid() == 0 else ()


def told(*, in_its_own_session, nice=0):
    """The nice level of a process that gave way and, where the kernel knows one, its session with that one's level."""
    output = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        start_new_session=in_its_own_session,
        preexec_fn=lambda: os.nice(nice),
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    level, _, session = output.strip().partition(" ")
    return int(level), session


def test_a_process_that_is_nice_already_is_as_nice_as_it_was_told_to_be():
    already = os.nice(0)
    for nice in (0, 3, 7):
        assert told(in_its_own_session=False, nice=nice)[0] == max(LEVEL, min(19, already + nice))


@needs_sessions
def test_a_session_is_as_nice_as_the_process_that_leads_it():
    before = OF_SESSION.read_text()
    assert told(in_its_own_session=True)[1].endswith(f"nice {LEVEL}")
    assert told(in_its_own_session=False)[1] == before.strip()


@needs_sessions
def test_sessions_that_begin_at_once_are_all_as_nice_as_they_were_told_to_be():
    """Without CAP_SYS_ADMIN, Linux takes one write in 0.1 s from all processes together."""
    together = [
        subprocess.Popen(
            [*WITHOUT_CAPABILITY, sys.executable, "-c", PROGRAM],
            start_new_session=True,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(4)
    ]
    assert [process.communicate()[0].strip().endswith(f"nice {LEVEL}") for process in together] == [True] * 4
