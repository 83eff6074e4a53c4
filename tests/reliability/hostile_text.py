"""Malformed texts, bytes and settings in place of an experiment file, by accident or intention."""
# ruff: noqa: E501  (rows of words)

from __future__ import annotations

import io
import json
import zlib
from random import Random
from typing import Any

from ruamel.yaml import YAML

WORDS = [
    "&a x", "*a", "<<: *a", "<<: {a: 1}", "!!python/name:os.system x", "!!binary aGk=", "!x y", ".nan",
    "-.inf", "1e400", "1e-400", "0x" + "F" * 40, "0o17", "1_000", "010", "12:30:45", "2020-01-01",
    "no", "~", "null", "True", "'", '"', "|", ">", "- - - -", "? a", ": b", "%YAML 1.1", "---", "...",
    "\t", "\x07", "\x1b[2J", "\0", "\x85", "\u2028", "\ufeff", "\u202e", "é", "ä" * 500, "\U0001f600",
    "\\ud800", '"\\ud800"', "{" * 40, "[" * 1000, "{a: " * 500, "- " * 300, "x" * 100_000, "9" * 5000,
    "1" + "0" * 400, "[" + "1, " * 5000 + "1]", "#", "a: &a [*a]", "'" + "\n" * 1000 + "'", "type",
]  # fmt: skip
FILES = [
    b"", b"\n", b"\xef\xbb\xbf", b"\xff\xfe", b"\x89PNG\r\n\x1a\n" + bytes(100),
    b"\x89HDF\r\n\x1a\n" + bytes(100), b"CDF\x01" + bytes(50), b"PK\x03\x04" + bytes(60),
    b"%PDF-1.7\n", b"<?xml version='1.0'?><a/>", b"[project]\nname = 'x'\n", b"a,b\n1,2\n",
    b"import os\nos.system('true')\n", b"#!/bin/sh\ntrue\n", b"{\n", b"[]", b"null", b"3", b"'x'",
    b"\x1f\x8b" + zlib.compress(b"name: x"), b"---\n---\n", b"a" * (2**20 + 1), b"- " * 5000,
]  # fmt: skip


def to_yaml(draw: Random, data: Any) -> str:
    """Return the data as a text: JSON is YAML, too."""
    if draw.random() < 0.5:
        return json.dumps(data, indent=draw.choice([None, 1]))
    stream = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    try:
        yaml.dump(data, stream)
    except (UnicodeError, ValueError):  # half characters
        return json.dumps(data)
    return stream.getvalue()


def hostile_text(draw: Random, text: str) -> bytes:
    """The text after one to four accidents; now and then another kind of file."""
    if draw.random() < 0.04:
        return draw.choice(FILES)
    for _ in range(draw.choice([1, 1, 2, 4])):
        text = draw.choice(ACCIDENTS)(draw, text)
    content = bytearray(text.encode("utf-8", "surrogatepass"))
    for _ in range(draw.choice([0, 0, 0, 1, 5])):
        if content:
            content[draw.randrange(len(content))] = draw.randrange(256)
    return bytes(content[: 2**20 + 10])


def hostile_setting(draw: Random) -> str:
    """Return a value for the option `--set`."""
    paths = [
        "steps",
        "leaders.1.until",
        "leaders.0",
        "rule",
        "rule.K.x",
        "body.columns",
        "",
        ".",
        "x",
    ]
    return draw.choice([*paths, "a." * 200]) + draw.choice(["=", ""]) + draw.choice(WORDS)


def _cut(draw: Random, text: str) -> str:
    return text[: draw.randrange(len(text) + 1)]


def _insert(draw: Random, text: str) -> str:
    at = draw.randrange(len(text) + 1)
    return text[:at] + draw.choice(WORDS) + text[at:]


def _value(draw: Random, text: str) -> str:
    """Another value behind a colon."""
    places = [n for n, c in enumerate(text) if c == ":"]
    if not places:
        return text
    at = draw.choice(places) + 1
    ends = [k for k in (text.find(c, at) for c in ",}]\n") if k >= 0]
    return f"{text[:at]} {draw.choice(WORDS)}{text[min(ends, default=len(text)) :]}"


def _line(draw: Random, text: str) -> str:
    """A line twice, gone, elsewhere, or further in."""
    lines = text.split("\n")
    a, b = draw.randrange(len(lines)), draw.randrange(len(lines))
    match draw.randrange(4):
        case 0:
            lines.insert(b, lines[a])
        case 1:
            del lines[a]
        case 2:
            lines[a], lines[b] = lines[b], lines[a]
        case 3:
            lines[a] = draw.choice([" ", "  ", "\t", "- "]) + lines[a]
    return "\n".join(lines)


def _piece(draw: Random, text: str) -> str:
    """Return the text with a piece moved."""
    a, b, c = sorted(draw.randrange(len(text) + 1) for _ in range(3))
    return text[:a] + text[b:c] + text[a:b] + text[c:]


def _repeat(draw: Random, text: str) -> str:
    a, b = sorted(draw.randrange(len(text) + 1) for _ in range(2))
    return text[:b] + text[a:b] * draw.choice([1, 3, 30]) + text[b:]


def _digits(draw: Random, text: str) -> str:
    """A digit becomes more, or a sign."""
    places = [n for n, c in enumerate(text) if c.isdigit()]
    if not places:
        return text
    at = draw.choice(places)
    return text[:at] + draw.choice(["9", "99", "0", "-", "e9", "e-9", ".", "000"]) + text[at + 1 :]


ACCIDENTS = [_cut, _insert, _value, _value, _line, _line, _piece, _repeat, _digits, _digits]
