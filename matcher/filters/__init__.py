"""Filters over the frames of one position."""
