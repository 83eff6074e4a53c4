"""Recording of runs as datasets, result files and their seals, checkpoints of unfinished runs, and
exports.
"""

from __future__ import annotations
