"""One line that says what foreign code raised, whatever it raised."""

from __future__ import annotations

import traceback

from pbdkit.interfaces.answers import AnswerError
from pbdkit.interfaces.naming import did_you_mean

LONGEST = 400


def worded(error: BaseException, package: str = "") -> str:
    """``Type: message``, on one line, without control characters, cut where it is long.

    With `package`, the place in the code of that package is added where the traceback has one.
    """
    try:
        message = str(error)
    except Exception:  # a plugin's own error class can fail to say what it is
        message = "(its message cannot be had)"
    kind = type(error).__name__
    if isinstance(error, AnswerError):
        return one_line(message)
    told = one_line(f"{kind}: {message}" if message else kind)
    return told + remedy(error) + _place(error, package)


def remedy(error: BaseException) -> str:
    """What elementwise functions are to do instead, where the fault is a frequent one."""
    if isinstance(error, ValueError) and "truth value of an array" in str(error):
        return "; choose with `pbdkit.where` in the place of `if`, `and` and `or`"
    if isinstance(error, AttributeError) and type(error.obj).__name__ == "Parameters":
        return did_you_mean(str(error.name), getattr(error.obj, "_fields", ()))
    return ""


def one_line(text: str) -> str:
    """The words of the text, printable ones, cut where it is long."""
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= LONGEST else words[: LONGEST - 3] + "..."


def _place(error: BaseException, package: str) -> str:
    frames = [
        (frame.f_code.co_filename, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if package and str(frame.f_globals.get("__name__")).split(".")[0] == package
    ]
    if not frames:
        return ""
    file, line = frames[-1]
    return f" ({file.replace(chr(92), '/').rsplit('/', 1)[-1]}, line {line})"
