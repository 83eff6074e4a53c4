"""Which components are installed, and where each comes from."""
