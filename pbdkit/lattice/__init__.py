"""Particles on rasters: sites, neighbourhoods, cells and selections of a lattice."""
