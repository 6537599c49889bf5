"""The studio around `morph_core`: web server, 3-D viewer, command line, studies, films, and exports."""
