"""Logging on stderr: a line for people on a terminal, else one JSON object a line with the id of its request."""

from __future__ import annotations

import json
import logging
import re
import sys
import uuid
from contextvars import ContextVar
from datetime import datetime, timezone

from opentelemetry import trace

request_id: ContextVar[str] = ContextVar("request_id", default="")

_DIM, _RED, _YELLOW = 2, 31, 33  # of ANSI
_ACCEPTED_REQUEST_ID = re.compile(r"[A-Za-z0-9._:/+=-]{1,128}")


def choose_request_id(offered: str | None) -> str:
    """The id that the client offered where it is fit to be logged, else a new one."""
    if offered and _ACCEPTED_REQUEST_ID.fullmatch(offered):
        return offered
    return uuid.uuid4().hex


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON; `extra={"fields": {...}}` adds keys."""

    def format(self, record: logging.LogRecord) -> str:
        document = {
            "time": datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if current := request_id.get():
            document["request_id"] = current
        if (span := trace.get_current_span().get_span_context()).is_valid:
            document["trace_id"] = trace.format_trace_id(span.trace_id)
        document.update(getattr(record, "fields", {}))
        if record.exc_info:
            document["exception"] = self.formatException(record.exc_info)
        return json.dumps(document, ensure_ascii=False, default=str)


class HumanFormatter(logging.Formatter):
    """A record as a line for people: the time of day, the level where it is not usual, and the sentence."""

    def __init__(self, *, in_colour: bool) -> None:
        super().__init__()
        self._in_colour = in_colour

    def format(self, record: logging.LogRecord) -> str:
        time = datetime.fromtimestamp(record.created).astimezone().strftime("%H:%M:%S")
        level = "" if record.levelno == logging.INFO else f"{record.levelname.lower()}: "
        if record.levelno >= logging.WARNING:
            level = self._coloured(level, _YELLOW if record.levelno == logging.WARNING else _RED)
        sentence = "".join(
            one if one.isprintable() else ascii(one)[1:-1] for one in _sentence(record)
        )  # paths are theirs
        line = f"{self._coloured(time, _DIM)} {level}{sentence}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line

    def _coloured(self, text: str, code: int) -> str:
        return f"\x1b[{code}m{text}\x1b[0m" if self._in_colour else text


def _sentence(record: logging.LogRecord) -> str:
    """The message; of a request, whose facts are fields, these in words."""
    fields = getattr(record, "fields", {})
    if "duration_ms" not in fields:
        return record.getMessage()
    what = " ".join(str(fields[name]) for name in ("method", "path") if name in fields)
    return f"{what}: {fields['status']} in {fields['duration_ms']:.0f} ms"


def is_for_people(log_format: str) -> bool:
    """Whether the log goes to people: `human`, or `auto` where stderr is a terminal."""
    return log_format == "human" or (log_format == "auto" and sys.stderr.isatty())


def configure_logging(level: str, log_format: str = "json") -> None:
    """Send every logger of the process, uvicorn's and grpc's included, through one handler.

    `log_format`: `human`, `json`, or `auto` as `is_for_people` decides.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        HumanFormatter(in_colour=sys.stderr.isatty()) if is_for_people(log_format) else JsonFormatter()
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    logging.getLogger("uvicorn").setLevel(max(logging.WARNING, root.level))
    # It says so of each WebSocket that was refused with an answer, which anyone could fill the log with.
    logging.getLogger("uvicorn.error").addFilter(
        lambda record: record.getMessage() != "ASGI callable returned without completing handshake."
    )
