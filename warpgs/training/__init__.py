"""Training: the schedule, the step, densification and pruning."""
