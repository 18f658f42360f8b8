"""Many trainings as one table: ablations, captures and seeds, on one machine or a Ray cluster."""
