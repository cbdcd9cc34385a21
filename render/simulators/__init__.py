"""Sensors inside simulators: one module a simulator, each needing the extra of its name."""
