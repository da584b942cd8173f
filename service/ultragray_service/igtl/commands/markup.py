"""The XML of commands and replies, as PLUS has it.

<Command Name="SetUsParameter"><Parameter Name="DepthMm" Value="40"/></Command>
<CommandReply Name="SetUsParameter" Status="SUCCESS" Message="…"><Parameter Name="DepthMm" Success="true"/>…
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

from ultragray.contract import shown
from ultragray_service.errors import IgtlMessageInvalid

MAX_COMMAND_BYTES = 4096
MAX_PARAMETERS = 32  # of one command


@dataclass(frozen=True)
class Request:
    """A command: its name, and its parameters with the values that they are given."""

    name: str
    parameters: Mapping[str, str | None]


@dataclass(frozen=True)
class Outcome:
    """The end of one parameter: an error, or else the value that was asked for."""

    parameter: str
    error: str = ""
    value: str | None = None


@dataclass(frozen=True)
class Reply:
    """The reply to a command. It failed where it has an error, or where a parameter has one."""

    name: str
    message: str = ""
    error: str = ""
    outcomes: tuple[Outcome, ...] = ()

    @property
    def errors(self) -> str:
        """Every error, in one text; empty: success."""
        return "; ".join(filter(None, [self.error, *(outcome.error for outcome in self.outcomes)]))

    @property
    def status(self) -> str:
        return "FAIL" if self.errors else "SUCCESS"

    @property
    def xml(self) -> str:
        root = ElementTree.Element("CommandReply", Name=_plain(self.name), Status=self.status)
        root.set("Message", _plain(self.errors or self.message))
        if self.errors:
            root.set("Error", _plain(self.errors))
        for outcome in self.outcomes:
            found = ElementTree.SubElement(root, "Parameter", Name=outcome.parameter)
            found.set("Success", "false" if outcome.error else "true")
            if outcome.value is not None:
                found.set("Value", _plain(outcome.value))
        return ElementTree.tostring(root, encoding="unicode")

    @property
    def metadata(self) -> dict[str, str]:
        """The reply as messages of version 2 carry it beside the XML."""
        found = {one.parameter: "FAIL" if one.error else one.value or "SUCCESS" for one in self.outcomes}
        return {**found, "Status": self.status, **({"Error": self.errors} if self.errors else {})}


def read_request(name: str, text: str) -> Request:
    """The command in an XML text. `name` is its name as the message has it; empty: the text has it.

    Raises IgtlMessageInvalid for a text that is none. It may define no entities, which could grow without bounds.
    """
    root = _root(text)
    own_name = root.get("Name", "")
    if own_name and name and own_name.casefold() != name.casefold():
        raise _invalid(f"the message calls the command {shown(name)}, its XML {shown(own_name)}")
    if len(root) > MAX_PARAMETERS:
        raise _invalid(f"a command may have at most {MAX_PARAMETERS} parameters, got {len(root)}")
    parameters: dict[str, str | None] = {}
    for element in root:
        parameter = element.get("Name", "")
        if element.tag != "Parameter" or not parameter:
            raise _invalid(f'Command must hold elements <Parameter Name="…"/>, got {shown(element.tag)}')
        if parameter in parameters:
            raise _invalid(f"each parameter may be named once, got {shown(parameter)} twice")
        parameters[parameter] = element.get("Value")
    return Request(name or own_name, parameters)


def _root(text: str) -> ElementTree.Element:
    size = len(text.encode())
    if size > MAX_COMMAND_BYTES:
        raise _invalid(f"a command may have at most {MAX_COMMAND_BYTES} bytes, got {size}")
    if "<!DOCTYPE" in text:
        raise _invalid("a command has no DOCTYPE")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _invalid(f'a command must be XML such as <Command Name="GetUsParameter">…</Command>: {error}') from None
    if root.tag != "Command":
        raise _invalid(f"the XML of a command must be an element Command, got {shown(root.tag)}")
    return root


def _invalid(detail: str) -> IgtlMessageInvalid:
    return IgtlMessageInvalid(detail, field="body")


def _plain(text: str) -> str:
    """The text without characters that XML cannot hold."""
    return "".join(one if one.isprintable() else "?" for one in text)
