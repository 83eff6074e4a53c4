"""What is said of a run before its first step: its spectrum, its lag, warnings, its memory."""

from __future__ import annotations
