"""State machines of Hypothesis, each with a model in memory: a random sequence of calls, and after
each call what a user may rely on. `tests/test_state_machines.py` makes some steps of each, and
`tests/reliability/state_machines.py` any number."""
