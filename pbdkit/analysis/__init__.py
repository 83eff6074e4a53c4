"""What a step is to small displacements: the step operator, its spectrum, plane waves."""
