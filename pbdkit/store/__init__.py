"""The store of an unfinished run: everything that is needed to go on with it, safe on disk."""
