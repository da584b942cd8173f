from __future__ import annotations

import pytest

from ultragray.rendering.settings import Encoding
from ultragray_service.errors import NotAcceptable
from ultragray_service.http.accept import JPEG, NPZ, PNG, RAW, Choice, choose


@pytest.mark.parametrize(
    ("accept", "media_type", "encoding"),
    [
        ("", PNG, Encoding.PNG),
        ("*/*", PNG, Encoding.PNG),
        ("image/*", PNG, Encoding.PNG),
        ("image/jpeg", JPEG, Encoding.JPEG),
        ("IMAGE/JPEG", JPEG, Encoding.JPEG),
        ("image/*;q=0.5, application/x-npz", NPZ, Encoding.NPZ),
        ("image/png;q=0.2, image/jpeg;q=0.9", JPEG, Encoding.JPEG),
        ("image/png;q=0, */*", JPEG, Encoding.JPEG),
        ("application/*", RAW, Encoding.UINT8),
        ("application/octet-stream", RAW, Encoding.UINT8),
        ("application/octet-stream;dtype=float32", RAW, Encoding.FLOAT32),
        ('application/octet-stream; dtype="float32"; q=0.7, text/html', RAW, Encoding.FLOAT32),
        ("text/html, application/xhtml+xml, */*;q=0.8", PNG, Encoding.PNG),
        ("nonsense, ;;q=, image/jpeg;q=x, application/x-npz", NPZ, Encoding.NPZ),
    ],
)
def test_choice_for_one_image(accept: str, media_type: str, encoding: Encoding) -> None:
    choice = choose(accept, frames=1, outputs=1, dtype=None)
    assert (choice.media_type, choice.encoding) == (media_type, encoding)


@pytest.mark.parametrize(("frames", "outputs"), [(2, 1), (1, 2)])
def test_several_images_fit_npz_and_raw_only(frames: int, outputs: int) -> None:
    assert choose("*/*", frames=frames, outputs=outputs, dtype=None).media_type == NPZ
    assert choose("image/png, */*;q=0.1", frames=frames, outputs=outputs, dtype=None).media_type == NPZ
    with pytest.raises(NotAcceptable, match="application/x-npz, application/octet-stream") as caught:
        choose("image/*", frames=frames, outputs=outputs, dtype=None)
    assert caught.value.field == "Accept"


@pytest.mark.parametrize("accept", ["text/html", "image/gif", "*/*;q=0", "application/octet-stream;dtype=int4"])
def test_what_cannot_be_made_is_refused(accept: str) -> None:
    with pytest.raises(NotAcceptable):
        choose(accept, frames=1, outputs=1, dtype=None)


def test_the_header_goes_before_the_dtype_of_the_body() -> None:
    assert choose(RAW, frames=1, outputs=1, dtype="float32").encoding is Encoding.FLOAT32
    assert choose(f"{RAW};dtype=uint8", frames=1, outputs=1, dtype="float32").encoding is Encoding.UINT8


def test_a_dtype_in_the_body_asks_for_raw_where_the_header_leaves_the_choice() -> None:
    for accept in ("", "*/*"):
        assert choose(accept, frames=1, outputs=1, dtype="float32") == Choice(RAW, Encoding.FLOAT32)
    assert choose("image/png", frames=1, outputs=1, dtype="float32").media_type == PNG
