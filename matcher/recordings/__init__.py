"""Recordings in time: stamps, whether the camera stood still, and tables of estimates."""
