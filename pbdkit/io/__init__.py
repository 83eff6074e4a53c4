"""From the states of a run to its dataset: recorded, in memory or in a file, and shown.

What keeps the bytes of results and of unfinished runs: files, seals and the run store.
"""

from __future__ import annotations
