"""What stands in the world: the parts, the catalogue, and meshes from files."""
