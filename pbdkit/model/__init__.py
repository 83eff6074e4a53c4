"""Experiments: reading and validation of experiment files.

- `reading` parses YAML and stores the position of every value for messages.
- `experiment` validates experiments with pydantic.
- `bodies`, `motions`, `boundary_conditions` and `solver` define the parts of experiments.
- `loading` and `shipped` find experiments by file and by name.
- `schema` returns the JSON Schema of experiments.
"""

from __future__ import annotations
