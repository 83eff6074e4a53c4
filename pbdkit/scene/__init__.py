"""Scene of an experiment: body, frame, leaders, loads and obstacles on a lattice, ready for
stepping.
"""
