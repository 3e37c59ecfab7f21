"""Files of every kind: pictures, lens surfaces, archives, ray files and tables, read with bounds and written whole."""
