"""The lens for other programs: sampled surfaces, solids and archives.  Writes files, traces no light."""
