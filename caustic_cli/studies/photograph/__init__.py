"""A photograph of a caustic: where its screen is (`camera`, `card`), what it shows of the picture (`comparison`), and what it says
about the part that was made (`model`, `inference`)."""
