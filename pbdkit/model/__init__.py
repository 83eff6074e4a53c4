"""The experiment: read, checked, and kept with the places where it was written."""

from __future__ import annotations
