"""Files that are whole or not there: atomic writes, HDF5, folders with a marker, and the guard of reading."""
