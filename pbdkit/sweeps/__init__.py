"""Many runs of one experiment with some of its parameters varied, and one dataset of them all."""
