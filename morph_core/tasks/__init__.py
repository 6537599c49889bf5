"""The tasks: one file, one task. `morph_core.catalogue` finds them, and those of other packages, by name."""
