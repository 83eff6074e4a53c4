"""A body that answers to the mouse: what is done to it is what an experiment file can say."""
