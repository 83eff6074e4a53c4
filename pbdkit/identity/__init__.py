"""What a rule is physically, on its lattice and neighbours: from its answer to plane waves."""
