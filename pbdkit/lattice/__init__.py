"""Particles on rasters: sites, neighbourhoods, cells and selections of a lattice.

`fill` finds the sites and cells inside the outline of a body. `raster` stores particles in padded
arrays, with one raster for each sublattice. `neighbourhood` determines the slots, which are the
constant relative positions of neighbours, and the bonds along them. `cells` determines the polygons
on which strains and stiffnesses are evaluated.
"""
