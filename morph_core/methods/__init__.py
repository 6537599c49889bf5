"""The methods: one file, one method. `morph_core.catalogue` finds them by name."""
