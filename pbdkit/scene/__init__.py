"""An experiment on its lattice, ready for stepping.

`build_scene` puts body and frame on rasters and creates what the experiment uses: constants of the
rule and the fracture model, leader groups, loads, obstacles and particle operations. `checks`
issues warnings about scenes that can be built but may not be what the user intends.
`memory_estimate` detects scenes that are too large, before anything is allocated.
"""
