"""The searches for phi: one file, one search. `morph_core.catalogue` finds them by name."""
