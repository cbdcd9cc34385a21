"""HTML pages and how objects show themselves in notebooks."""
