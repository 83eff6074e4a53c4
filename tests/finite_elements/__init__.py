"""Finite-element solutions of plane-stress problems, to measure the error of lattice rules."""
