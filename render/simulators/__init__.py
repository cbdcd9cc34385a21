"""Sensors inside simulators: one module a simulator, each needing the extra of its name."""

NEEDS_MUJOCO = "sensors in MuJoCo need the package mujoco: pip install -e '.[mujoco]' in the clone of phasemark"
NEEDS_GYMNASIUM = "TofObservation needs the package gymnasium: pip install -e '.[mujoco]' in the clone of phasemark"
