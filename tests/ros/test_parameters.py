"""Parameters of the node and the settings that they stand for; without ROS."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest

from ultragray_client import Below, Contact, ConvexProbe, Display, Needle, RenderSettings, ToolFrame
from ultragray_client.errors import InvalidArgument
from ultragray_ros.parameters import defaults, settings_of


def test_every_setting_is_a_parameter() -> None:
    settings = {item.name for item in fields(RenderSettings)} - {"encoding", "display"}
    assert set(defaults()) == settings | {f"display.{item.name}" for item in fields(Display)}


def test_the_defaults_leave_everything_to_the_scene() -> None:
    assert settings_of(defaults()) == RenderSettings()


def test_no_default_is_of_a_type_that_ros_lacks() -> None:
    for name, value in defaults().items():
        assert isinstance(value, (bool, int, float, str, list)), name
        assert value != [], f"{name}: the type of an empty list is not known"


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"height": 128, "outputs": ["bmode", "echo"]}, RenderSettings(height=128, outputs=("bmode", "echo"))),
        ({"slice_thickness_mm": 0.0}, RenderSettings(slice_thickness_mm=0.0)),
        (
            {"min_confidence": 0.5, "below_min_confidence": "mask"},
            RenderSettings(min_confidence=0.5, below_min_confidence=Below.MASK),
        ),
        ({"contact": "air"}, RenderSettings(contact=Contact.AIR)),
        (
            {"display.gain_db": -1.0, "display.tgc_db": [0.0, 6.0]},
            RenderSettings(display=Display(gain_db=-1.0, tgc_db=(0.0, 6.0))),
        ),
        (
            {"probe": '{"kind": "convex", "opening_angle_deg": 60, "near_mm": 40, "far_mm": 95}'},
            RenderSettings(probe=ConvexProbe(60, 40, 95)),
        ),
        (
            {
                "tools": '[{"kind": "needle", "tip_mm": [5, 0, 30], "hub_mm": [-9, 0, 4], "frame": "probe"}]',
                "ghost": 0.5,
            },
            RenderSettings(
                tools=(Needle(tip_mm=(5, 0, 30), hub_mm=(-9, 0, 4), frame=ToolFrame.PROBE),),
                ghost=0.5,
            ),
        ),
        ({"tools": "[]", "registration": "robot"}, RenderSettings(tools=(), registration="robot")),
    ],
)
def test_what_parameters_stand_for(given: dict[str, Any], expected: RenderSettings) -> None:
    assert settings_of({**defaults(), "scene": "demo", **given}) == expected


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"contact": "firm"}, "contact must be one of air, pressure, got 'firm'"),
        ({"probe": "convex"}, "probe must be JSON with a kind"),
        ({"probe": '{"kind": "square"}'}, "one of convex, linear, phased, radial, steered, and its numbers"),
        ({"probe": '{"kind": "linear"}'}, "probe must be JSON with a kind"),
        ({"probe": "[]"}, "probe must be JSON with a kind"),
        ({"tools": "needle"}, "tools must be JSON with a kind, one of box, cylinder, needle"),
        ({"tools": '{"kind": "needle"}'}, "it is no list"),
        ({"tools": '[{"kind": "scalpel"}]'}, "tools must be JSON with a kind"),
        (
            {"tools": '[{"kind": "needle", "tip_mm": [0, 0, 1], "hub_mm": [0, 0, 2], "frame": "base"}]'},
            "tools: frame must be one of scene, probe, got 'base'",
        ),
    ],
)
def test_a_word_that_does_not_exist_is_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(InvalidArgument, match=told):
        settings_of({**defaults(), **given})
