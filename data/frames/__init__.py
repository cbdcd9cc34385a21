"""Sets of simulated frames: the file and how it is built."""
