"""Studies: one plan of tasks, methods and seeds, run by a launcher, compared in a report."""
