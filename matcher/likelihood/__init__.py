"""Maximum likelihood: pixels compared, images modelled, views refined, background estimated."""
