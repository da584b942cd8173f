"""What client/generate.py writes is committed as it writes it."""

from dataclasses import asdict
from pathlib import Path

import pytest

from ultragray.rendering import settings
from ultragray.rendering.display import AS_RENDERED
from ultragray_client import Display, RenderSettings
from ultragray_service.errors import STATUSES

from ..scripts import loaded

CLIENT = Path(__file__).resolve().parents[2] / "client"


@pytest.fixture(scope="module")
def generator():
    return loaded(CLIENT / "generate.py")


def test_the_contract_is_current(generator, tmp_path):
    committed = CLIENT / "ultragray_client" / "contract.py"
    assert committed.read_text() == generator.generate_contract(tmp_path).read_text()


def test_the_errors_are_current(generator, tmp_path):
    committed = CLIENT / "ultragray_client" / "errors.py"
    assert committed.read_text() == generator.generate_errors(tmp_path).read_text()
    assert STATUSES.keys() > generator.NOT_OVER_GRPC


def test_the_writer_of_recordings_is_current(generator, tmp_path):
    for path in generator.generate_recording(tmp_path):
        committed = CLIENT / "ultragray_client" / "recording" / path.name
        assert committed.read_text() == path.read_text()


def test_the_contract_has_the_defaults_of_the_library():
    for own, library in ((RenderSettings(), settings.RenderSettings()), (Display(), AS_RENDERED)):
        assert asdict(own) == asdict(library)
