"""The size of a fuzzing run, its seed, and the loop that tries one door's inputs."""

import os
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import hypothesis
from hypothesis import HealthCheck, Phase
from hypothesis.errors import HypothesisWarning

from ..surroundings import ROOT

INPUTS = int(os.environ.get("ULTRAGRAY_FUZZ_INPUTS", "2000"))
SHARES = {  # of the inputs, by door: about as many as each takes in its part of the time
    "http documented": 0.02,
    "http bodies": 0.10,
    "http paths": 0.07,
    "http bytes": 0.05,
    "websocket": 0.12,
    "websocket paths": 0.01,
    "grpc messages": 0.08,
    "grpc bytes": 0.08,
    "igtl messages": 0.12,
    "igtl bytes": 0.05,
    "scene files": 0.05,
    "compressed scene files": 0.03,
    "ply files": 0.04,
    "checkpoints": 0.02,
    "training states": 0.02,
    "pose files": 0.05,
    "released folders": 0.01,
    "sequences": 0.02,
    "dicom": 0.01,
    "mcap": 0.01,
    "jpeg in dicom": 0.01,
    "tables of poses": 0.01,
    "scans of TUS-REC": 0.01,
    "archives": 0.03,
    "transform chains": 0.04,
    "clocks": 0.03,
    "photometric words": 0.04,
    "control frames": 0.02,
}
FAILED_FOLDER = ROOT / "build" / "fuzz"


@dataclass
class Door:
    """A door of the product, and how many inputs it got."""

    name: str
    seed: int
    record: Callable[[str, int, float], None]  # the inputs tried at a door, and the seconds that they took
    tried: int = 0

    @property
    def wanted(self):
        return max(1, round(SHARES[self.name] * INPUTS))

    def enter(self, inputs, attempt, *, share=1.0, group=1):
        """Tries `share` of the wanted inputs, of which `inputs` makes `group` at a time; they follow from the seed.

        What `attempt` raises is told with the smallest input that still does it.
        """
        began, before = time.monotonic(), self.tried
        wanted = max(1, round(share * self.wanted))
        last = None  # hypothesis tries the smallest input that fails last

        @hypothesis.seed(self.seed)
        @hypothesis.settings(
            max_examples=-(-wanted // group),
            database=None,
            deadline=None,
            print_blob=False,
            report_multiple_bugs=False,
            phases=[Phase.generate, Phase.shrink],
            suppress_health_check=list(HealthCheck),
        )
        @hypothesis.given(inputs)
        def try_one(value):
            nonlocal last
            last = value
            self.tried += group
            attempt(value)

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", HypothesisWarning)  # of a long input, in place of what it raised
                try_one()
        except Exception as error:
            error.__notes__ = [self._told(last)]  # without hypothesis's, which hold the whole input
            raise
        finally:
            self.record(self.name, self.tried - before, time.monotonic() - began)
        assert self.tried - before >= wanted, f"{self.name}: only {self.tried - before} of {wanted} inputs"

    def _told(self, value):
        """Keeps the input in a file and says how to come to it again."""
        FAILED_FOLDER.mkdir(parents=True, exist_ok=True)
        path = FAILED_FOLDER / f"{self.name.replace(' ', '_')}-{self.seed}"
        path.write_bytes(value if isinstance(value, bytes) else repr(value).encode())
        shown = repr(value)
        again = f"ULTRAGRAY_FUZZ_INPUTS={INPUTS}, --seed {self.seed}"
        return f"{self.name}: the smallest input that fails is {shown[:1000]}, kept in {path}; to try again: {again}"
