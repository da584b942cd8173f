"""Tools in files and in settings: what is read is what was written, and what is none is named."""

import json

import pytest

from ultragray.contract import from_dict, to_dict
from ultragray.errors import InvalidArgument
from ultragray.rendering.settings import FrameSettings
from ultragray.rendering.tools import MAX_TOOLS, Box, Cylinder, Needle, ToolFrame, load_tools

TOOLS = (
    Needle(tip_mm=(1.0, 2.0, 3.0), hub_mm=(4.0, 5.0, 6.0), label=3),
    Cylinder(tip_mm=(1.0, 2.0, 3.0), hub_mm=(4.0, 5.0, 6.0), diameter_mm=4.0, frame=ToolFrame.PROBE),
    Box(centre_mm=(0.0, 0.0, 30.0), size_mm=(3.0, 2.0, 1.0), quaternion=(0.0, 1.0, 0.0, 0.0)),
)


def test_a_file_gives_back_the_tools_that_were_written(tmp_path):
    path = tmp_path / "tools.json"
    path.write_text(json.dumps(to_dict(TOOLS)))
    assert load_tools(path) == TOOLS
    path.write_text("[]")
    assert load_tools(path) == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "it must hold a list of tools, got {}"),
        ("[1]", r"tools\[0\] must be an object, got 1"),
        ("[", "Expecting value"),
        ("[" * 100_000, "recursion"),
        ('[{"kind": "saw"}]', r"tools\[0\].kind must be one of box, cylinder, needle, got 'saw'"),
        ('[{"kind": "box", "centre_mm": [0, 0, 0]}]', r"tools\[0\].size_mm is required by kind box"),
        ('[{"kind": "box", "centre_mm": [0, 0, NaN], "size_mm": [1, 1, 1]}]', r"tools\[0\].centre_mm\[2\] must be a"),
    ],
)
def test_what_is_no_file_of_tools_is_refused(tmp_path, text, words):
    path = tmp_path / "tools.json"
    path.write_text(text)
    with pytest.raises(InvalidArgument, match=words) as told:
        load_tools(path)
    assert told.value.detail.startswith(f"{path}: ")
    with pytest.raises(InvalidArgument, match="no such file"):
        load_tools(tmp_path / "other.json")


def test_settings_take_tools_as_json_holds_them():
    settings = FrameSettings(tools=TOOLS, ghost=0.25)
    assert from_dict(FrameSettings, to_dict(settings)) == settings
    assert from_dict(FrameSettings, {"tools": None}) == FrameSettings()


def test_settings_refuse_what_is_no_tool_and_too_many():
    with pytest.raises(InvalidArgument, match=f"tools must be a list of at most {MAX_TOOLS} values, got 9"):
        FrameSettings(tools=TOOLS * 3)
    for wrong in (None, "needle", {"kind": "needle"}):
        with pytest.raises(InvalidArgument, match=r"tools\[1\] must be a Tool"):
            FrameSettings(tools=(TOOLS[0], wrong))
    with pytest.raises(InvalidArgument, match=r"tools\[0\].opacity must be a finite number from 0 to 0.999"):
        from_dict(FrameSettings, {"tools": [to_dict(TOOLS[0]) | {"opacity": 1.0}]})
    with pytest.raises(InvalidArgument, match="ghost must be a finite number from 0 to 1"):
        FrameSettings(ghost=1.5)
