"""What is kept: plans, grids, banks and frames on disk, written atomically and read with care."""
