"""The process that reads files for the tests, started again where an input ended it."""

import json
import os
import select
import subprocess
import sys
from collections import Counter
from pathlib import Path

from ..processes import Growth, taken_by
from ..surroundings import ROOT
from ..waiting import at_this_load
from ..warm import SOURCE_FOLDERS

READ_TIMEOUT_S = 20.0
MOST_GROWTH_BYTES = 64 * 2**20
SAMPLE_EVERY = 100
LEAST_READ = 0.002  # of the inputs: were all refused at their first byte, the fuzzing would show nothing
LEAST_OUTCOMES = 200


class ReaderProcess:
    """Reads mutated files with one of the readers of reader.py, each of which is written into `folder` first."""

    def __init__(self, reader, folder):
        self._reader = reader
        self._folder = folder
        self._log = folder / "log"
        self._outcomes = Counter()
        self._resident_bytes = []
        self._process = None

    def read_file(self, name, data):
        """Raises AssertionError where the reader neither reads the file nor refuses it in words."""
        path = self._folder / name
        path.write_bytes(data)
        self._read(path)

    def read_files(self, files):
        """The same with a folder of files."""
        inputs = self._folder / "inputs"
        inputs.mkdir(exist_ok=True)
        for name, data in files.items():
            (inputs / name).write_bytes(data)
        self._read(inputs)

    def close(self):
        """Asserts that the process has not grown, and that enough of the inputs were read to their end."""
        if self._process is not None:
            self._process.communicate()
        if self._resident_bytes:
            growth = Growth.of(self._resident_bytes, parts=5)
            assert growth.absolute < MOST_GROWTH_BYTES, f"the reader has grown: {self._resident_bytes}"
        if self._outcomes.total() >= LEAST_OUTCOMES:
            assert self._outcomes["read"] >= LEAST_READ * self._outcomes.total(), self._outcomes

    def _read(self, path):
        process = self._started()
        process.stdin.write(json.dumps({"reader": self._reader, "path": str(path)}) + "\n")
        process.stdin.flush()
        if not select.select([process.stdout], [], [], at_this_load(READ_TIMEOUT_S))[0]:
            process.kill()
            raise AssertionError(f"reading takes more than {READ_TIMEOUT_S:g} s")
        line = process.stdout.readline()
        if not line:
            raise AssertionError(f"the reader has ended with {process.wait()}: {self._log.read_text()[-2000:]}")
        reply = json.loads(line)
        assert "fault" not in reply, reply["fault"]
        self._outcomes[reply["outcome"]] += 1
        if self._outcomes.total() % SAMPLE_EVERY == 1:
            self._resident_bytes.append(taken_by(process.pid).resident_bytes)

    def _started(self):
        if self._process is None or self._process.poll() is not None:
            self._resident_bytes.clear()
            with self._log.open("w") as log:
                self._process = subprocess.Popen(
                    [sys.executable, Path(__file__).with_name("reader.py")],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    env={
                        **os.environ,
                        "OMP_NUM_THREADS": "1",
                        "PYTHONPATH": os.pathsep.join(str(ROOT / folder) for folder in SOURCE_FOLDERS),
                    },
                )
        return self._process
