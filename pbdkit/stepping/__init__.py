"""The stepper: from the state at one step to the state at the next."""
