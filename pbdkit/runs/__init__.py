"""One run of a scene: what takes it from state to state, and what is kept of it."""
