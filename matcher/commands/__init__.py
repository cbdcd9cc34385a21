"""Commands that match, calibrate, sweep, design, drive and plan.

Heavy imports stand inside the functions, so that ``phasemark --help`` answers at once.
"""
