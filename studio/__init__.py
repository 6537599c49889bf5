"""The browser studio around `morph_core`: backend, 3-D viewer, geometry and export."""
