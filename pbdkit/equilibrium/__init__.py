"""Where the steps converge to, without making them, and how far from there a state can be."""
