"""Measured frames: readers of every accepted form, and a simulated recording."""
