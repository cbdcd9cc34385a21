"""Where a known object stands, from histograms of a direct sensor at several poses (PHYSICS section 11)."""
