"""The files of a multipart/form-data body, as they come."""

from __future__ import annotations

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from ultragray.errors import InvalidArgument


class FileParts:
    """Turns blocks of the body into the names and the bytes of its files."""

    def __init__(self, content_type: str) -> None:
        """Raises InvalidArgument for a Content-Type without a boundary."""
        _, parameters = parse_options_header(content_type)
        boundary = parameters.get(b"boundary", b"")
        self._events: list[str | bytes] = []
        self._header_name, self._header_value = bytearray(), bytearray()
        self._disposition = b""
        self._complete = False
        try:
            self._parser = MultipartParser(
                boundary,
                {
                    "on_part_begin": self._begin_part,
                    "on_header_field": self._take_header_name,
                    "on_header_value": self._take_header_value,
                    "on_header_end": self._end_header,
                    "on_headers_finished": self._end_headers,
                    "on_part_data": self._take_data,
                    "on_end": self._end,
                },
            )
        except FormParserError as error:
            raise InvalidArgument(f"Content-Type has no boundary that can be used: {error}") from error
        if not boundary:
            raise InvalidArgument("Content-Type multipart/form-data must have a boundary", field="Content-Type")

    def feed(self, block: bytes) -> list[str | bytes]:
        """The content of the block, in order: the name of each file (str), then its bytes.

        Raises InvalidArgument for a damaged body and for a part that is no file.
        """
        try:
            self._parser.write(block)
        except FormParserError as error:
            raise InvalidArgument(f"the body is no multipart/form-data: {error}", field="body") from error
        events, self._events = self._events, []
        return events

    def finish(self) -> None:
        """Raises InvalidArgument where the body ended too early."""
        if not self._complete:
            raise InvalidArgument("the body is truncated: its last boundary is missing", field="body")

    def _begin_part(self) -> None:
        self._disposition = b""

    def _take_header_name(self, data: bytes, start: int, end: int) -> None:
        self._header_name += data[start:end]

    def _take_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header_value += data[start:end]

    def _end_header(self) -> None:
        if self._header_name.lower() == b"content-disposition":
            self._disposition = bytes(self._header_value)
        self._header_name.clear()
        self._header_value.clear()

    def _end_headers(self) -> None:
        _, parameters = parse_options_header(self._disposition)
        name = parameters.get(b"filename")
        if name is None:
            field = parameters.get(b"name", b"").decode(errors="replace")[:80]
            raise InvalidArgument(
                f"each part must be a file with a filename, {field!r} is none (options are query parameters)",
                field="body",
            )
        self._events.append(name.decode(errors="replace"))

    def _take_data(self, data: bytes, start: int, end: int) -> None:
        self._events.append(data[start:end])

    def _end(self) -> None:
        self._complete = True
