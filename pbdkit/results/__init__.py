"""From the states of a run to its dataset: recorded, in memory or in a file, and shown."""
