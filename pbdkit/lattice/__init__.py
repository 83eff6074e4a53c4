"""Particles on rasters: sites, neighbourhoods, cells and selections of a lattice.

`fill` finds the sites and cells inside the outline of a body, `raster` stores particles in padded
arrays with one raster for each sublattice, `neighbourhood` determines neighbours as constant slots
and the bonds along them, and `cells` the polygons on which strains and stiffnesses are evaluated.
"""
