"""The scene: what an experiment comes to on its lattice, ready to be stepped."""
