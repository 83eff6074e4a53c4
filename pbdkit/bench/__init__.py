"""Speed against error: methods measured at sizes, each in a process of its own."""
