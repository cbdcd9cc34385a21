"""Banks of model images: the file and how it is built."""
