"""The memory of the machine, and what files from elsewhere may take of it."""
