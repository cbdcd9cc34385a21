"""From phasor images to frames, PHYSICS section 4: taps, electrons, noise, stray light and motion."""
