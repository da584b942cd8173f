"""Content negotiation of a render: which media type, and which encoding the workers produce for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from ultragray.rendering.settings import Encoding
from ultragray_service.errors import NotAcceptable

PNG = "image/png"
JPEG = "image/jpeg"
RAW = "application/octet-stream"
NPZ = "application/x-npz"
DICOM = "application/dicom"
NPY = "application/x-npy"
MEDIA_TYPES = (PNG, JPEG, RAW, NPZ, DICOM)
SLICE_TYPES = (PNG, NPY, RAW)

RAW_ENCODINGS = {one.value: one for one in Encoding if one.is_raw}
_ENCODINGS = {PNG: Encoding.PNG, JPEG: Encoding.JPEG, NPZ: Encoding.NPZ, DICOM: Encoding.UINT8}


@dataclass(frozen=True)
class MediaRange:
    """One entry of an Accept header, such as `image/*;q=0.5` or `application/octet-stream;dtype=float32`."""

    kind: str
    subtype: str
    dtype: str | None
    quality: float

    def specificity(self, media_type: str) -> int:
        """The closeness of a match: 3 with a dtype, 2 exactly, 1 by kind, 0 as */*, −1 not at all."""
        kind, _, subtype = media_type.partition("/")
        if (self.kind, self.subtype) == (kind, subtype):
            if self.dtype is None:
                return 2
            return 3 if media_type == RAW and self.dtype in RAW_ENCODINGS else -1
        if (self.kind, self.subtype) == (kind, "*"):
            return 1
        return 0 if (self.kind, self.subtype) == ("*", "*") else -1


@dataclass(frozen=True)
class Choice:
    """The form of an answer."""

    media_type: str
    encoding: Encoding


def parse_accept(header: str) -> list[MediaRange]:
    """The ranges of an Accept header; entries that cannot be read are passed over."""
    ranges = []
    for entry in header.split(","):
        name, *parameters = (part.strip() for part in entry.split(";"))
        kind, slash, subtype = name.lower().partition("/")
        values = {
            key.strip().lower(): value.strip().strip('"') for key, _, value in (p.partition("=") for p in parameters)
        }
        try:
            quality = float(values.get("q", "1"))
        except ValueError:
            continue
        if slash and kind and subtype and 0.0 <= quality <= 1.0:
            ranges.append(MediaRange(kind, subtype, values.get("dtype"), quality))
    return ranges


def choose(accept: str, *, frames: int, outputs: int, dtype: str | None, lossless: bool = False) -> Choice:
    """The media type for `frames` poses of `outputs` outputs; `dtype` is that of the body, for raw pixels.
    `lossless`: no pixel may change, as those of labels.

    Among types of equal quality: raw first where the body names a dtype, else PNG for one image and npz for several.
    A dtype in the Accept header goes before that of the body.
    Raises NotAcceptable, saying which types can hold the request.
    """
    single = frames == 1 and outputs == 1
    able: Sequence[str] = (PNG, JPEG, RAW, NPZ, DICOM) if single else (NPZ, RAW, DICOM) if outputs == 1 else (NPZ, RAW)
    if lossless:
        able = tuple(media_type for media_type in able if media_type != JPEG)
    if dtype is not None:  # only raw pixels have one
        able = (RAW, *(media_type for media_type in able if media_type != RAW))
    media_type, chosen = _best(accept, tuple(able), f"{frames} frame(s) of {outputs} output(s)")
    if media_type == RAW:
        return Choice(RAW, RAW_ENCODINGS[chosen.dtype or dtype or "uint8"])
    return Choice(media_type, _ENCODINGS[media_type])


def choose_of_slice(accept: str) -> str:
    return _best(accept, SLICE_TYPES, "a slice")[0]


def _best(accept: str, able: tuple[str, ...], what: str) -> tuple[str, MediaRange]:
    """The media type that an Accept header likes best, the first of those alike, and the range that names it."""
    best = _liked(accept, able)
    if best is None:
        raise NotAcceptable(
            f"Accept must allow a type that can hold {what}: {', '.join(able)}; got {accept!r}", field="Accept"
        )
    return best


@lru_cache(maxsize=64)  # a client sends the same header with every request
def _liked(accept: str, able: tuple[str, ...]) -> tuple[str, MediaRange] | None:
    ranges = parse_accept(accept) if accept.strip() else [MediaRange("*", "*", None, 1.0)]
    best: tuple[str, MediaRange] | None = None
    for media_type in able:
        matches = [(level, one) for one in ranges if (level := one.specificity(media_type)) >= 0]
        if not matches:
            continue
        _, chosen = max(matches, key=lambda match: (match[0], match[1].quality))
        if chosen.quality > 0 and (best is None or chosen.quality > best[1].quality):
            best = media_type, chosen
    return best
