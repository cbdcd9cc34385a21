"""Direct sensors: from a scene to histograms, and from these to the targets a chip reports (PHYSICS section 11)."""
