"""What keeps the bytes of results and of unfinished runs: files, seals and the run store."""
