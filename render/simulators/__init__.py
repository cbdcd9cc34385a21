"""Sensors inside simulators: one module a simulator, each needing the extra of its name."""

NEEDS_GYMNASIUM = "TofObservation needs the package gymnasium: pip install -e '.[mujoco]' in the clone of phasemark"
