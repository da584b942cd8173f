"""The code blocks of a Markdown page in their order, with the comments that steer their test (see README.md)."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

SHELL = {"console", "bash"}
PARSED = {"json", "toml", "yaml"}
INERT = {"text", "html", "javascript", "ini", "proto", "xml", "c", "csharp", "cmake", "http"}
LANGUAGES = {*SHELL, "python", *PARSED, *INERT}

_STEERING = re.compile(r"^<!-- (needs|not run|serves)(?:: (.*?))? -->$", flags=re.MULTILINE)


class PageInvalid(Exception):
    """A page that does not keep to the convention."""


@dataclass(frozen=True)
class Block:
    """A fenced block, and what the comments before it say."""

    line: int  # of its first line of code, counted from 1
    language: str
    code: str
    not_run: str | None = None  # the reason
    serves: bool = False

    def script(self):
        """The commands of a shell block, for bash. A console block's output is left out."""
        if self.language == "bash":
            return self.code
        commands = []
        for line in self.code.splitlines():
            if commands and _goes_on(commands[-1]):
                commands[-1] += f"\n{line}"
            elif line.startswith("$ "):
                commands.append(line[2:])
        return "\n".join(commands) + "\n"


def _goes_on(command):
    """Whether the next line belongs to a command: after a backslash, or in quotes that are still open."""
    if command.endswith("\\"):
        return True
    try:
        shlex.split(command, comments=True)
    except ValueError:
        return True
    return False


@dataclass(frozen=True)
class Page:
    """What a page needs, and its blocks in their order."""

    path: Path
    needs: tuple[str, ...]
    blocks: tuple[Block, ...]

    @property
    def runs(self):
        return [block for block in self.blocks if block.language not in INERT]


@dataclass
class _Steering:
    """The comments since the last block."""

    not_run: str | None = None
    serves: bool = False


def read_page(path):
    """The page of a Markdown file. Raises PageInvalid for a block without a language that we know."""
    text = path.read_text(encoding="utf-8")
    needs, blocks, steering = [], [], _Steering()
    for token in MarkdownIt("commonmark").parse(text):
        line = (token.map or [0])[0] + 1
        if token.type == "html_block":
            for word, value in _STEERING.findall(token.content):
                if word == "needs":
                    needs.append(value)
                elif word == "not run":
                    if not value:
                        raise PageInvalid(f"{path}:{line}: a block that is not run says why")
                    steering.not_run = value
                else:
                    steering.serves = True
        elif token.type == "code_block":
            raise PageInvalid(f"{path}:{line}: an indented code block; fence it and name its language")
        elif token.type == "fence":
            language = token.info.strip()
            if language not in LANGUAGES:
                raise PageInvalid(f"{path}:{line}: a block in {language!r}; known are {', '.join(sorted(LANGUAGES))}")
            blocks.append(Block(line + 1, language, token.content, steering.not_run, steering.serves))
            if language in SHELL and not blocks[-1].script().strip():
                raise PageInvalid(f"{path}:{line}: a block without a command; one of output alone is text")
            steering = _Steering()
    return Page(path, tuple(needs), tuple(blocks))
