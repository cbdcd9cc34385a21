"""Plans of banks and frame sets, and the axes of their grids."""
