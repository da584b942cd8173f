"""Frames and poses as an OpenIGTLink server of a scanner sends them, such as that of PLUS: IMAGE, and TRANSFORM beside.

PLUS embeds a pose into an IMAGE whether it is valid or not, and sends only those TRANSFORM that are: so a transform may
be named, without which an image is left out. Image and transform belong together where their timestamps are the same.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import BinaryIO
from urllib.parse import urlsplit

import numpy as np

from ultragray.datasets.fan import tracked_sweep
from ultragray.datasets.images import SCALE_TOLERANCE, parse_image_size, resize_frames
from ultragray.datasets.source import SourceOptions
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import Chain, Sweep
from ultragray_service.errors import IgtlMessageInvalid
from ultragray_service.igtl.contents import unpack_image, unpack_matrix
from ultragray_service.igtl.messages import HEADER_BYTES, TICKS_PER_S, Message, unpack_header, unpack_message
from ultragray_workers.errors import NotReady

OPTIONS = ("crop", "fan", "transform", "image_size", "image_topic")  # fields of SourceOptions that a scanner takes
PORT = 18944
PATIENCE_S = 30.0  # with a server that has sent no frame yet
MOST_BYTES = 64 * 2**20  # of a message
_MOST_WAITING = 16  # images, or transforms, for the other one of their time


def scanned(address: str, options: SourceOptions) -> Iterator[Sweep]:
    """A sweep of one frame for each that the server sends, as they come, until it closes the connection.

    All have the size of the first one; a frame that cannot be one of a sweep, such as one without echo, is left out.
    Raises NotReady where nobody answers, or no frame comes, InvalidArgument, naming the option, and DatasetInvalid.
    """
    for item in fields(options):
        if getattr(options, item.name) is not None and item.name not in OPTIONS:
            raise InvalidArgument(
                f"{item.name} is not for frames of a scanner: {', '.join(OPTIONS)} are", field=item.name
            )
    place, first, give_up_s = urlsplit(address), None, time.monotonic() + PATIENCE_S
    try:
        connection = socket.create_connection((place.hostname or "127.0.0.1", place.port or PORT), PATIENCE_S)
    except OSError as error:
        raise NotReady(f"no OpenIGTLink server answers at {address} ({error.strerror or error})") from error
    with connection, connection.makefile("rb") as stream:
        try:
            for message, pose in _tracked(_messages(stream), options, give_up_s):
                try:
                    sweep = _frame(message, pose, options, place.netloc)
                except DatasetInvalid:
                    if first is None and time.monotonic() > give_up_s:
                        raise
                    continue
                if first is None:
                    first = sweep
                    connection.settimeout(None)  # a scan may pause
                _require_same_pixels(first, sweep)
                yield replace(sweep, images=resize_frames(sweep.images, first.width, first.height), probe=first.probe)
        except TimeoutError:
            wanted = "" if options.transform is None else f" with a TRANSFORM {options.transform} of the same time"
            raise NotReady(f"{address} has sent no IMAGE{wanted} in {PATIENCE_S:g} s") from None
        except ConnectionError:  # as if it had closed it
            return


def _messages(stream: BinaryIO) -> Iterator[Message]:
    """The messages of a server, until it closes the connection. Raises IgtlMessageInvalid, TimeoutError."""
    while len(head := stream.read(HEADER_BYTES)) == HEADER_BYTES:
        header = unpack_header(head)
        if header.body_bytes > MOST_BYTES:
            raise IgtlMessageInvalid(f"a message may have at most {MOST_BYTES} bytes, got {header.body_bytes}")
        if len(body := stream.read(header.body_bytes)) < header.body_bytes:
            return
        yield unpack_message(header, body)


def _tracked(
    messages: Iterator[Message], options: SourceOptions, give_up_s: float
) -> Iterator[tuple[Message, FloatArray]]:
    """Images with their transforms, [4, 4]: the identity where none is asked for. Raises TimeoutError, InvalidArgument.

    One that comes before the other waits for it.
    """
    images: dict[int, Message] = {}  # by timestamp, likewise:
    transforms: dict[int, FloatArray] = {}
    wanted, device, is_begun = options.transform, options.image_topic, False
    for message in messages:
        if not is_begun and time.monotonic() > give_up_s:
            raise TimeoutError
        at = message.timestamp
        if message.type_name == "IMAGE":
            device = device or message.device_name
            if message.device_name == device:
                images[at] = message
            elif options.image_topic is None:
                raise InvalidArgument(
                    f"image_topic is required where there are several images: {device}, {message.device_name}",
                    field="image_topic",
                )
        elif message.type_name == "TRANSFORM" and message.device_name == wanted:
            transforms[at] = unpack_matrix(message.content)
        if at in images and (wanted is None or at in transforms):
            is_begun = True
            yield images.pop(at), transforms.pop(at, np.eye(4))
        for waiting in (images, transforms):
            if len(waiting) > _MOST_WAITING:
                del waiting[next(iter(waiting))]


def _frame(message: Message, pose: FloatArray, options: SourceOptions, source: str) -> Sweep:
    """Raises DatasetInvalid, IgtlMessageInvalid, and InvalidArgument for options that do not fit."""
    image = unpack_image(message.content)
    sweep = tracked_sweep(
        image.pixels[None],
        pose[None],
        image.matrix,
        np.zeros(1, np.int64),
        Path(source),
        crop=options.crop,
        fan=options.fan,
        calibration=message.device_name,
        chain=Chain(),
        notes=(),
        times_s=np.array([message.timestamp / TICKS_PER_S]) if message.timestamp else None,
    )
    if options.image_size is None:
        return sweep
    return replace(sweep, images=resize_frames(sweep.images, *parse_image_size(options.image_size)))


def _require_same_pixels(first: Sweep, sweep: Sweep) -> None:
    before, after = (np.array([one.region.lateral_mm, one.region.axial_mm]) for one in (first, sweep) if one.region)
    if np.abs(after / before - 1.0).max() > SCALE_TOLERANCE:
        raise DatasetInvalid(
            f"{sweep.source}: a pixel is {after[0]:.5g} x {after[1]:.5g} mm, it was {before[0]:.5g} x {before[1]:.5g}: "
            "the depth was changed, which takes another recording"
        )
