"""A sensor fitted to measured flat fields: boards, offsets, wiggling, photon transfer and noise."""
