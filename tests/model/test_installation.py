"""The machine, and what an import brings."""

import os
import platform
import subprocess
import sys

import pytest

from ultragray import installation as machine
from ultragray.phantom.demo import DEMO_FILE


def test_what_the_system_tells(tmp_path, monkeypatch):
    told = tmp_path / "cpuinfo"
    told.write_text("processor : 0\nmodel name\t: Abacus 3000: fast\nmodel name\t: another\n")
    monkeypatch.setattr(machine, "Path", lambda _: told)
    assert machine.processor_name() == "Abacus 3000: fast"
    assert (machine.processor_maker(), machine.processor_model()) == (None, None)
    told.write_text("vendor_id : Counting House\ncpu family\t: 26\nmodel\t\t: 2\nmodel name : Abacus\n")
    assert (machine.processor_maker(), machine.processor_model()) == ("Counting House", "family 26, model 2")
    told.write_text("CPU implementer\t: 0x41\nCPU part\t: 0xd40\n")
    assert (machine.processor_maker(), machine.processor_model()) == ("0x41", "part 0xd40")


def test_else_the_architecture(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "Path", lambda _: tmp_path / "none")
    monkeypatch.setattr(platform, "processor", lambda: "")
    assert machine.processor_name() == platform.machine()


def test_a_container_may_have_less_memory_than_the_machine(tmp_path, monkeypatch):
    limits = (tmp_path / "memory.max", tmp_path / "none")
    monkeypatch.setattr(machine, "_GROUP_LIMITS", limits)
    limits[0].write_text("max\n")
    whole = machine.memory_bytes()
    assert whole >= 2**28
    limits[0].write_text("268435456\n")
    assert machine.memory_bytes() == 2**28


PROGRAM = "import os, sys, ultragray; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"


@pytest.mark.slow
@pytest.mark.parametrize(("given", "expected"), [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active")])
def test_they_sleep_unless_the_environment_says_otherwise(given, expected):
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"} | given
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [expected, "False"]


# What the service's own process and the command line import, before anything is rendered.
WITHOUT_TORCH = (
    "from ultragray.phantom.demo import copy_demo_scene; copy_demo_scene('copy.ugr')",
    "import ultragray; ultragray.read_header('copy.ugr')",
    "from ultragray.learn.training import TrainingConfig; TrainingConfig.preset('fast', steps=3)",
    "from ultragray.learn.evaluation.methods import ComparisonSettings; ComparisonSettings(methods=('median',))",
    "import ultragray.samplers",
    "from ultragray.exchange.exports import check_format",
    "import numpy as np; from ultragray import SceneInfo; from ultragray.scene.confidence import Assessor; "
    "Assessor(SceneInfo(), np.zeros((0, 4, 4))).assess(np.eye(4))",
)


@pytest.mark.slow
def test_little_is_imported_before_it_is_needed(working_folder):
    program = "import sys\n"
    for statement in WITHOUT_TORCH:
        program += f"{statement}\nassert 'torch' not in sys.modules, {statement!r}\n"
    program += "from ultragray.learn.training import train; ultragray.render\n"
    program += "assert 'torch' in sys.modules and 'triton' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)
    assert (working_folder / "copy.ugr").read_bytes() == DEMO_FILE.read_bytes()
