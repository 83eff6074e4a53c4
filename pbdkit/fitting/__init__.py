"""Parameters from measurements: how a state changes with them, and which fit what was measured."""
