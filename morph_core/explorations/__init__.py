"""The ways to explore z: one file, one exploration. `morph_core.catalogue` finds them by name."""
