"""Films and stills of runs, drawn without a display and encoded with ffmpeg."""
