"""Experiments: reading and validation of experiment files.

`reading` parses YAML and keeps the position of every value for messages; `experiment` validates
experiments with pydantic; their parts are defined in `bodies`, `motions`, `boundary_conditions` and
`solver`; `loading` and `shipped` find experiments by file and by name, and `schema` returns their
JSON Schema.
"""

from __future__ import annotations
