"""Predictions about a run before its first step: spectrum, lag, warnings, best relaxation and
memory."""

from __future__ import annotations
