"""Experiments: reading and validating files, with the position of every value in its file."""

from __future__ import annotations
