"""What the camera is: its parameters, presets, files, correlation and range noise."""
