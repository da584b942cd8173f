"""Names of scenes, with and without a pin."""

import pytest

from ultragray.errors import InvalidArgument
from ultragray_workers.scene_names import SceneReference, base_name, check_scene_name, check_scene_reference

HASH = "0123456789abcdef" * 4


@pytest.mark.parametrize(
    ("text", "reference"),
    [
        ("liver", SceneReference("liver")),
        (f"liver@{HASH}", SceneReference("liver", HASH)),
        (f"liver@{HASH[:12]}", SceneReference("liver", HASH[:12])),
        (f"liver@{HASH[:11]}", None),
        (f"liver@{HASH}0", None),
        (f"liver@{HASH.upper()}", None),
        ("liver@", None),
        (f"@{HASH}", None),
        (f"a b@{HASH}", None),
        (f"liver@{HASH}@{HASH}", None),
        ("../liver", None),
    ],
)
def test_a_reference_is_a_name_and_perhaps_a_pin(text, reference):
    assert SceneReference.of(text) == reference
    if reference is None:
        with pytest.raises(InvalidArgument, match="scene must be"):
            check_scene_reference(text)
    else:
        check_scene_reference(text)
        assert base_name(text) == reference.name


def test_a_pin_fits_what_begins_with_it():
    assert SceneReference("liver").fits(HASH)
    assert SceneReference("liver", HASH[:12]).fits(HASH)
    assert not SceneReference("liver", "f" * 12).fits(HASH)


def test_nothing_new_is_named_with_a_pin():
    with pytest.raises(InvalidArgument, match="letters, digits"):
        check_scene_name(f"liver@{HASH}")
