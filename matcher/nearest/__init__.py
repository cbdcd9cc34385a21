"""The nearest images of a bank."""
