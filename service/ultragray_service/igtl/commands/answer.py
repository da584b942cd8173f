"""Answers the commands of one connection."""

from __future__ import annotations

from collections.abc import Mapping

from ultragray.contract import shown
from ultragray.errors import UltragrayError
from ultragray_service.errors import IgtlMessageInvalid
from ultragray_service.igtl.commands.contents import Command, pack_command, pack_string, unpack_command, unpack_string
from ultragray_service.igtl.commands.markup import Outcome, Reply, Request, read_request
from ultragray_service.igtl.commands.scanner import Scanner
from ultragray_service.igtl.messages import Message

_ASKS, _ANSWERS = "CMD_", "ACK_"  # beginnings of the names of devices whose STRING is a command, and a reply
_SET, _GET = "SetUsParameter", "GetUsParameter"


async def answer(scanner: Scanner, message: Message) -> Message:
    """The reply to a COMMAND, or to a STRING of a device CMD_…; it says what was wrong with the command, if so.

    Raises IgtlMessageInvalid where the message holds no command.
    """
    if message.type_name == "COMMAND":
        command = unpack_command(message.content)
        reply = await _reply(scanner, command.name, command.text)
        content = pack_command(Command(command.number, command.name or reply.name, reply.xml))
        return _message("RTS_COMMAND", message, message.device_name, content, reply.metadata)
    if not message.device_name.startswith(_ASKS):
        raise IgtlMessageInvalid(
            f"STRING is understood as a command, of a device called {_ASKS}1 or the like, got "
            f"{shown(message.device_name)}",
            field="header",
        )
    reply = await _reply(scanner, "", unpack_string(message.content))
    device_name = _ANSWERS + message.device_name[len(_ASKS) :]
    return _message("STRING", message, device_name, pack_string(reply.xml), reply.metadata)


async def _reply(scanner: Scanner, name: str, text: str) -> Reply:
    try:
        request = read_request(name, text)
        return await _obey(scanner, request)
    except IgtlMessageInvalid as error:
        return Reply(name, error=error.detail)


async def _obey(scanner: Scanner, request: Request) -> Reply:
    """Raises IgtlMessageInvalid for an unknown command and for one without parameters."""
    known = {name.casefold(): name for name in (_SET, _GET)}
    name = known.get(request.name.casefold())
    if name is None:
        raise IgtlMessageInvalid(f"the command must be {_SET} or {_GET}, got {shown(request.name)}", field="body")
    if not request.parameters:
        raise IgtlMessageInvalid(f'{name} must hold an element <Parameter Name="…"/> or more', field="body")
    outcomes = []
    for parameter, value in request.parameters.items():
        try:
            if name == _GET:
                outcome = Outcome(parameter, value=await scanner.get(parameter))
            elif value is None:
                outcome = Outcome(parameter, f"{parameter}: a Value is required")
            else:
                await scanner.set(parameter, value)
                outcome = Outcome(parameter)
        except UltragrayError as error:
            outcome = Outcome(parameter, f"{parameter}: {error.detail}")
        outcomes.append(outcome)
    return Reply(name, f"{name} completed", outcomes=tuple(outcomes))


def _message(type_name: str, asked: Message, device_name: str, content: bytes, metadata: Mapping[str, str]) -> Message:
    return Message(type_name, device_name, content, asked.timestamp, asked.version, asked.message_id, metadata)
