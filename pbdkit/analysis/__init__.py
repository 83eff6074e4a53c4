"""What is known of a run before its first step: the step operator, its spectrum, predictions."""
